"""Invalid arguments of components are refused with the argument's name and value."""

from functools import partial

import numpy as np
import pytest
from gymnasium import spaces

from sb3_extensions.encoders.extractors import EquivariantExtractor
from sb3_extensions.encoders.mlp_extractor import MlpExtractor
from sb3_extensions.encoders.observation import SceneView
from sb3_extensions.equivariant.groups import FieldType, Group
from sb3_extensions.equivariant.layers import EquivariantConv2d, EquivariantLinear, GroupMaxPool
from sb3_extensions.replay.augmentation import RAD
from sb3_extensions.replay.buffer import ExpertReplayBuffer
from sb3_extensions.replay.quantisation import Quantiser
from sb3_extensions.replay.rotation import Rotation, make_augmentation
from sb3_extensions.replay.sampling import PrioritizedSampler, ShareSampler
from sb3_extensions.spatial_dqn.codec import SpatialActionCodec
from sb3_extensions.spatial_dqn.pixel_maps import EquivariantPixelMaps, PlainPixelMaps

C4, C8, D4 = Group("cyclic", 4), Group("cyclic", 8), Group("dihedral", 4)


def box(*shape, low=0.0, high=0.4):
    return spaces.Box(low, high, shape, np.float32)


def scene(**others):
    return spaces.Dict({"heightmap": box(1, 16, 16), "holding": box(1), **others})


def fields(*entries):
    return FieldType.of(*((representation, 1) for representation in entries))


def numbers(space=None, **kwargs):
    return MlpExtractor(space or spaces.Dict({"state": box(7), "holding": box(1)}), **kwargs)


def buffer(size=50, space=None, **kwargs):
    return ExpertReplayBuffer(size, space or scene(), box(3, low=-1.0, high=1.0), **kwargs)


extractor = partial(EquivariantExtractor, scene())
codec = partial(SpatialActionCodec, 32)
plain_maps = partial(PlainPixelMaps, 32, (1, 12))
maps = partial(EquivariantPixelMaps, 32, None, C4)
MIXED = fields(D4.regular, D4.sign)
COLOUR = spaces.Box(0, 255, (3, 16, 16), np.uint8)
UNBOUNDED = box(1, 8, 8, high=np.inf)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: EquivariantExtractor(box(16, 16)), "must have images"),
        (lambda: EquivariantExtractor(spaces.Dict({"holding": box(1)})), "must have images StatePolicy"),
        (lambda: EquivariantExtractor(scene(in_hand=box(1, 8, 10))), "must have images"),
        (lambda: EquivariantExtractor(scene(in_hand=UNBOUNDED)), "finite bounds"),
        (lambda: EquivariantExtractor(scene(points=box(100, 3))), "points"),
        (lambda: EquivariantExtractor(COLOUR, above_ground=(0.1, 0.1)), "above_ground 0.1"),
        (lambda: extractor(small_image_features=0), "small_image_features 0"),
        (lambda: extractor(quantise="int4"), "'int4'"),
        (lambda: extractor(channels=[4]), "channels 1"),
        (lambda: extractor(strided=3), "strided 3"),
        (lambda: extractor(autocast="fp16"), "autocast 'fp16'"),
        (lambda: extractor(group="square"), "group 'square'"),
        (lambda: extractor(n=0), "n 0"),
        (lambda: extractor(output="both"), "output 'both'"),
        (lambda: extractor(crop=20), "crop 20"),
        (lambda: extractor(standardise=(0.1, 0.0)), "standardise (0.1, 0.0)"),
        (lambda: extractor(above_ground=[0.1]), "above_ground [0.1]"),
        (lambda: extractor(compile=True), "compile no-such-compiler"),
        (lambda: numbers(scene()), "'heightmap'"),
        (lambda: numbers(spaces.Dict({"kind": spaces.Discrete(3)})), "'kind' Discrete"),
        (lambda: numbers(layers=[64, 0]), "layers [64, 0]"),
        (lambda: numbers(standardise=[0.0, 0.0]), "standardise [0.0, 0.0]"),
        (lambda: FieldType.of((C4.regular, 1), (C8.regular, 1)), "same group"),
        (lambda: FieldType.of((C4.regular, 0)), "at least one field"),
        (lambda: D4.quotient(3), "m 3"),
        (lambda: GroupMaxPool(MIXED), "regular fields"),
        (lambda: EquivariantLinear(fields(C4.regular), fields(C8.regular)), "group"),
        (lambda: EquivariantLinear(fields(D4.trivial), fields(D4.sign)), "commutes"),
        (lambda: EquivariantConv2d(MIXED, MIXED, 0), "kernel_size 0"),
        (lambda: RAD(16).check(scene()), "observation_space images 16"),
        (lambda: Rotation().check(spaces.Dict({"image": box(1, 4, 5)})), "observation_space images"),
        (lambda: make_augmentation("rda"), "augmentation rotation, rad, drq, 'rda'"),
        (lambda: make_augmentation({"rad": {"sise": 3}}), "augmentation sise"),
        (lambda: make_augmentation({"rad": {"size": 0}}), "size 0"),
        (lambda: make_augmentation({"drq": {"pad": 1.5}}), "pad integer 1.5"),
        (lambda: Rotation(probability=1.5), "probability 1.5"),
        (lambda: Rotation(action_sequence="pz"), "action_sequence 'pz'"),
        (lambda: buffer(n_steps=0), "n_steps 0"),
        (lambda: buffer(n_steps=3), "gamma None"),
        (lambda: buffer(optimize_memory_usage=True), "optimize_memory_usage True"),
        (lambda: buffer(sampler={"shares": {"expert_fraction": 1.5}}), "expert_fraction 1.5"),
        (lambda: buffer(sampler="best"), "sampler uniform, shares, prioritized, 'best'"),
        (lambda: buffer(image_dtype="float32"), "dtype 'float32'"),
        (lambda: buffer(size=1), "buffer_size 1"),
        (lambda: buffer(space=spaces.Discrete(3)), "Box Discrete"),
        (lambda: Quantiser(UNBOUNDED), "finite bounds"),
        (lambda: Quantiser(box(1, 4, 4, low=1.0, high=1.0)), "low < high"),
        (lambda: Quantiser(box(1, 4, 4, low=1000.0, high=1000.01), "uint16"), "too narrow"),
        (lambda: ShareSampler(0.7, 0.4), "expert_fraction success_fraction 0.7 + 0.4"),
        (lambda: ShareSampler(balanced_from=0), "balanced_from 0"),
        (lambda: ShareSampler(balanced_from=1.5), "balanced_from integer 1.5"),
        (lambda: ShareSampler("0.5"), "expert_fraction '0.5'"),
        (lambda: PrioritizedSampler(expert_bonus=float("nan")), "expert_bonus nan"),
        (lambda: PrioritizedSampler(exponent=1.5), "exponent 1.5"),
        (lambda: PrioritizedSampler(expert_bonus=-1.0), "expert_bonus -1"),
        (lambda: codec(num_tilts=0), "num_tilts 0"),
        (lambda: codec(num_rotations=4.0), "num_rotations integer 4.0"),
        (lambda: codec(workspace_size=0.0), "workspace_size 0"),
        (lambda: codec(heights=(0.1, 0.05)), "heights 0.05"),
        (lambda: codec(tilt=1.0), "tilt 1.0"),
        (lambda: codec(theta_bounds=(0.0, 1.0)), "theta_bounds 1.0"),
        (lambda: codec("pxr"), "action_sequence 'pxr'"),
        (lambda: codec("xyrrrr"), "action_sequence 'xyrrrr'"),
        (lambda: plain_maps([8]), "two levels, [8]"),
        (lambda: plain_maps([4, 6, 8], [4, 4]), "in_hand_channels 3 [4, 4]"),
        (lambda: maps([4, 4, 6], rotations=4), "group 8 rotations"),
        (lambda: maps([4, 4, 6], dynamic_fields=0), "dynamic_fields 0"),
        (lambda: SceneView(box(1, 16, 16)), "'heightmap' Box"),
        (lambda: SceneView(scene(), image_key="depth"), "'depth'"),
        (lambda: SceneView(scene(heightmap=box(3, 16, 16))), "heightmap"),
        (lambda: SceneView(scene(in_hand=box(12))), "must have images, in_hand"),
        (lambda: SceneView(scene(), standardise=(0.1, 0.0)), "standardise (0.1, 0.0)"),
    ],
)
def test_invalid_arguments_are_refused(make, words, monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler")
    with pytest.raises(ValueError) as refusal:
        make()
    assert all(word in str(refusal.value) for word in words.split()), refusal.value
