"""Networks that choose what follows a pixel."""

import itertools
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from bulletarm_gym.geometry import euler_pose
from bulletarm_gym.observations import ElevationMap
from bulletarm_gym.observations.in_hand import projections
from sb3_extensions.encoders.observation import SceneView, View
from sb3_extensions.spatial_dqn.asr_heads import (
    PATCH_STAGES,
    DeicticLevel,
    EquivariantRotations,
    Level,
    PlainLevel,
    PlainRotations,
)
from sb3_extensions.spatial_dqn.codec import SpatialActionCodec
from sb3_extensions.spatial_dqn.projections import orthographic_projections, rotation_matrices

SIZE, SIDE, YAWS = 24, 12, 4
ENCODING = (6, 3, 3)
BATCH = 6
NARROW = ((4, 4, 6, 6), (16, 8))
EXACT = 1e-4  # relative to the standard deviation of the compared values
STANDARDISE = (0.01, 0.02)


@pytest.fixture(autouse=True)
def _seed() -> None:
    th.manual_seed(0)


def make_codec(sequence: str = "pxyzrrr") -> SpatialActionCodec:
    return SpatialActionCodec(SIZE, sequence, num_rotations=YAWS, num_heights=5, num_tilts=3, tilt=0.5)


def make_scene_view(channels: int, side: int = SIDE) -> SceneView:
    """Without an in-hand image if it has no channels."""
    boxes = {"heightmap": (1, SIZE, SIZE), "in_hand": (channels, side, side), "holding": (1,)}
    if channels == 0:
        del boxes["in_hand"]
    space = spaces.Dict({name: spaces.Box(0.0, 0.4, shape, np.float32) for name, shape in boxes.items()})
    return SceneView(space, quantise=None, standardise=STANDARDISE)


def make_view(channels: int = 3, side: int = SIDE) -> View:
    """Blocks, some of them held; standardised."""
    heights = th.zeros(BATCH, SIZE, SIZE)
    heights[:, 4:15, 8:20] = 0.03 + 0.05 * th.rand(BATCH, 11, 12)
    mean, deviation = STANDARDISE
    image = (heights[:, None] - mean) / deviation
    return View(image, heights, th.randn(BATCH, channels, side, side), th.arange(BATCH) % 2 == 1)


def random_indices(codec: SpatialActionCodec) -> th.Tensor:
    """Return pixels inside the blocks and random other indices."""
    pixels = [th.randint(6, 16, (BATCH,)) for _ in range(2)]
    return th.stack([*pixels, *(th.randint(n, (BATCH,)) for n in codec.shape[2:])], dim=1)


def make_level(kind: str, name: str) -> Level:
    """By the name of its class, of 6D; rotations of 3D."""
    scene_view, encoding = make_scene_view(3), ENCODING
    if kind == "PlainLevel":
        return PlainLevel(make_codec(), name, scene_view, encoding, *NARROW)
    if kind == "DeicticLevel":
        return DeicticLevel(make_codec(), name, scene_view, *NARROW)
    if kind == "PlainRotations":
        return PlainRotations(make_codec(), scene_view, encoding, (4, 4, 6), 16)
    return EquivariantRotations(make_codec(), scene_view, encoding, (4, 4, 6, 4), (4, 4, 6, 6), (16, 16))


LEVELS = [
    *[("PlainRotations", "theta"), ("EquivariantRotations", "theta")],
    *[("PlainLevel", name) for name in ("theta", "z", "phi", "psi")],
    *[("DeicticLevel", name) for name in ("z", "phi", "psi")],
]
ORDER = ["row", "column", "theta", "z", "phi", "psi"]
each_level = pytest.mark.parametrize(("kind", "name"), LEVELS)


@each_level
def test_values_depend_on_earlier_choices(kind: str, name: str) -> None:
    level, view, codec = make_level(kind, name), make_view(), make_codec()
    earlier = ORDER.index(name)
    encoding, indices = th.randn(BATCH, *ENCODING), random_indices(codec)[:, :earlier]
    with th.no_grad():
        values = level(view, encoding, indices)
        assert values.shape == (BATCH, codec.shape[earlier]) and values.dtype == th.float32
        assert values.abs().max() < 1
        for place in range(earlier):
            other = indices.clone()
            other[:, place] = (other[:, place] + 1) % codec.shape[place]
            matters = (level(view, encoding, other) != values).any(dim=1)
            # Only the level of the height rotates the heightmap around the pixel with the gripper.
            assert matters.float().mean() > 0.6, ORDER[place]


@each_level
def test_values_depend_on_the_view(kind: str, name: str) -> None:
    level, view = make_level(kind, name), make_view()
    encoding, indices = th.randn(BATCH, *ENCODING), random_indices(make_codec())[:, : ORDER.index(name)]
    with th.no_grad():
        values = level(view, encoding, indices)
        changes = {
            "in_hand": level(view._replace(in_hand=view.in_hand.flip(0)), encoding, indices),
            "heights": level(view._replace(image=-view.image, heights=0.1 - view.heights), encoding, indices),
            "places": level(view._replace(places=~view.places), encoding, indices),
            "encoding": level(view, encoding.flip(0), indices),
        }
        for what, others in changes.items():
            assert th.equal(others, values) == (what == "encoding" and kind == "DeicticLevel"), what
        for sample in range(BATCH):
            one = th.tensor([sample])
            alone = level(view.of(one), encoding[one], indices[one])
            th.testing.assert_close(alone[0], values[sample], atol=1e-6, rtol=1e-3)


def turn_back(indices: th.Tensor) -> th.Tensor:
    """Return the indices of the pixels after a rotation by 90 degrees."""
    return th.stack([SIZE - 1 - indices[:, 1], indices[:, 0], *indices.T[2:]], dim=1)


@pytest.mark.parametrize("side", PATCH_STAGES)
def test_yaws_shift_when_the_patch_rotates(side: int) -> None:
    fields = (4, 4, 6, 6, 4)[: len(PATCH_STAGES[side])]
    scene_view, view = make_scene_view(1, side), make_view(1, side)
    level = EquivariantRotations(make_codec("pxyr"), scene_view, ENCODING, fields, (4, 4, 6, 6), (16, 16))
    encoding, indices = th.randn(BATCH, *ENCODING), random_indices(make_codec("pxyr"))[:, :2]
    with th.no_grad():
        values = [level(view, encoding, indices)]
        for _ in range(4):
            indices = turn_back(indices)
            view = view._replace(image=th.rot90(view.image, 1, (-2, -1)))
            values.append(level(view, encoding, indices))
    spread = values[0].std(dim=1).mean()
    assert spread > 1e-6
    for before, after in itertools.pairwise(values):
        assert (after - before.roll(YAWS // 2, dims=1)).abs().max() < EXACT * spread
    assert (values[1] - values[0]).abs().max() > spread


@pytest.mark.parametrize("pool_encoding", [True, False])
def test_yaws_are_invariant_to_rotations_of_a_pooled_encoding(pool_encoding: bool) -> None:
    scene_view, view = make_scene_view(1), make_view(1)
    widths: Any = ((4, 4, 6, 4), (4, 4, 6, 6), (16, 16))
    level = EquivariantRotations(make_codec("pxyr"), scene_view, ENCODING, *widths, pool_encoding)
    encoding, indices = th.randn(BATCH, *ENCODING), random_indices(make_codec("pxyr"))[:, :2]
    with th.no_grad():
        values = level(view, encoding, indices)
        turned = level(view, th.rot90(encoding, 1, (-2, -1)), indices)
    assert th.equal(values, turned) == pool_encoding


@pytest.mark.parametrize("name", ["z", "phi", "psi"])
def test_values_depend_on_the_projection_of_the_candidate_only(name: str) -> None:
    """Against a loop over samples and candidates, with the environment's own projections."""
    level, view, codec = make_level("DeicticLevel", name), make_view(), make_codec()
    assert isinstance(level, DeicticLevel)
    indices = random_indices(codec)[:, : ORDER.index(name)]
    # At yaw 0 voxels are on the borders of pixels, which the environment rounds arbitrarily
    indices[:, 2:3] = 1 + indices[:, 2:3] % 3 // 2 * 2
    with th.no_grad():
        values = level(view, th.zeros(BATCH, *ENCODING), indices)
    for sample in range(BATCH):
        chosen = dict(zip(ORDER, indices[sample].tolist(), strict=False))
        for candidate, value in enumerate(codec.grids[name]):
            at = {other: codec.grids[other][chosen[other]] for other in ("theta", "z") if other in chosen}
            at |= {"phi": codec.grids["phi"][chosen["phi"]]} if "phi" in chosen else {}
            at[name] = value
            pose = euler_pose(
                ((chosen["row"] + 0.5) * 0.4 / SIZE, (chosen["column"] + 0.5) * 0.4 / SIZE, at["z"]),
                (at.get("psi", 0.0), at.get("phi", 0.0), at["theta"]),
            )
            seen = projections(ElevationMap(view.heights[sample].numpy(), (0.2, 0.2), 0.4), pose, SIDE)
            mean, deviation = STANDARDISE
            patch = th.cat([(th.as_tensor(seen) - mean) / deviation, view.in_hand[sample]])
            with th.no_grad():
                expected = level.head(level.encoder(patch[None]))[0, int(view.places[sample])]
            th.testing.assert_close(values[sample, candidate], expected, atol=1e-5, rtol=1e-3)


def test_inputs_of_plain_levels_are_rotated_patches_or_projections() -> None:
    view, codec = make_view(), make_codec()
    indices = random_indices(codec)
    for name, known in (("theta", 2), ("z", 3), ("phi", 4), ("psi", 5)):
        level = make_level("PlainLevel", name)
        assert isinstance(level, PlainLevel)
        seen = level.inputs(view, indices[:, :known])
        assert seen.shape == (BATCH, 6 if name in ("phi", "psi") else 4, SIDE, SIDE)
        th.testing.assert_close(seen[:, -3:], view.in_hand)
        if name in ("theta", "z"):
            angle = None if name == "theta" else th.as_tensor(codec.grids["theta"][indices[:, 2]])
            th.testing.assert_close(seen, level.patch(view, indices, angle))
            unturned = th.equal(seen, level.patch(view, indices))
            assert unturned == (name == "theta")
            continue
        at = {
            other: th.as_tensor(codec.grids[other][indices[:, 2 + k]]) for k, other in enumerate(codec.grids)
        }
        at = {other: value if ORDER.index(other) < known else 0 * value for other, value in at.items()}
        rotations = rotation_matrices(*(at[other].float()[:, None] for other in ("theta", "phi", "psi")))
        pose = (indices[:, 0], indices[:, 1], at["z"][:, None], rotations)
        expected = orthographic_projections(view.heights, *pose, SIDE, 0.4 / SIZE)[:, 0]
        th.testing.assert_close(seen[:, :3], (expected - STANDARDISE[0]) / STANDARDISE[1])
        assert name == "phi" or (at["phi"] != 0).any()


def test_patches_without_in_hand_image_have_the_authors_size() -> None:
    """They are as large as the authors'."""
    view = make_view()._replace(in_hand=None)
    scene_view, codec = make_scene_view(0), make_codec()
    levels = [
        PlainRotations(codec, scene_view, ENCODING, (4, 4, 6), 16),
        EquivariantRotations(codec, scene_view, ENCODING, (2, 2, 2, 2, 2), (), (16, 16)),
        PlainLevel(codec, "psi", scene_view, ENCODING, *NARROW),
        DeicticLevel(codec, "psi", scene_view, *NARROW),
    ]
    for level in levels:
        known = ORDER.index(level.name)
        assert level.patch_size == 24
        values = level(view, th.randn(BATCH, *ENCODING), random_indices(codec)[:, :known])
        assert values.shape == (BATCH, level.choices)


@pytest.mark.parametrize("side", [20, 24])
def test_fields_must_match_the_side_of_patches(side: int) -> None:
    scene_view, fields = make_scene_view(1, side), (2, 2, 2, 2)
    with pytest.raises(ValueError, match=f"patch_fields must have 5 entries for patches of {side}"):
        EquivariantRotations(make_codec(), scene_view, ENCODING, fields, (4, 4), (16,))
