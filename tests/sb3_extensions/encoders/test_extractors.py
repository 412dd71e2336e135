"""Encoders and feature extractors of images, of numbers, and of images with numbers and smaller images."""

import functools

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib import CrossQ
from stable_baselines3 import PPO, SAC
from torch import nn

from sb3_extensions.encoders.cnn import CnnEncoder, count_halvings, encoded_size
from sb3_extensions.encoders.extractors import CnnExtractor, EquivariantEncoder, EquivariantExtractor
from sb3_extensions.encoders.mlp_extractor import MlpExtractor
from sb3_extensions.encoders.observation import StackedImage
from sb3_extensions.equivariant.groups import Group
from sb3_extensions.equivariant.layers import EquivariantConv2d
from sb3_extensions.replay.buffer import ExpertReplayBuffer
from sb3_extensions.replay.quantisation import Quantiser
from sb3_extensions.sacfd.policies import EquivariantPolicy, MultiInputPolicy

SIZE = 16
CNN = functools.partial(CnnExtractor, channels=[4, 8, 8])
REGULAR = functools.partial(EquivariantExtractor, n=4, channels=[2, 4, 4])
INVARIANT = functools.partial(REGULAR, output="invariant")


def heights(*shape, high=0.4):
    return spaces.Box(0, high, shape, np.float32)


def observation_space(**others):
    return spaces.Dict({"heightmap": heights(1, SIZE, SIZE), "holding": heights(1, high=1), **others})


def with_small_images():
    """Return a space with an in-hand image, and a float and a uint8 image of a third size."""
    colour = spaces.Box(0, 255, (3, 8, 8), np.uint8)
    return observation_space(in_hand=heights(3, 10, 10), touch=heights(1, 8, 8, high=1), colour=colour)


SPACES = {
    "scene": observation_space(),
    "colours": observation_space(scene=spaces.Box(0, 255, (3, SIZE, SIZE), np.uint8)),
    "small images": with_small_images(),
}


def sample(space, batch=3):
    """Return observations as Stable-Baselines3 passes them to extractors: uint8 images are in [0, 1]."""
    space.seed(0)
    drawn = [space.sample() for _ in range(batch)]
    stacked = {key: th.from_numpy(np.stack([each[key] for each in drawn])).float() for key in space}
    return {key: stacked[key] / 255 if space[key].dtype == np.uint8 else stacked[key] for key in space}


def test_default_channels_are_the_papers():
    """128 pixels: 16 to 256 channels, 8 to 128 regular fields; a smaller image drops the widest halvings."""
    cnn = [layer.out_channels for layer in CnnEncoder(2, 128).layers if isinstance(layer, nn.Conv2d)]
    assert cnn == [16, 32, 64, 128, 256, 256, 128]
    for size, expected in ((128, [8, 16, 32, 64, 128, 64, 64]), (64, [8, 16, 32, 128, 64, 64])):
        layers = EquivariantEncoder(2, size, Group("cyclic", 8)).layers
        assert [x.out_type.size // 8 for x in layers if isinstance(x, EquivariantConv2d)] == expected


@pytest.mark.parametrize("size, encoded", [(5, 6), (25, 32), (84, 96)])
def test_images_of_any_size_are_resized_and_encoded_equivariantly(size, encoded):
    assert encoded_size(size) == encoded
    channels = (8,) * (count_halvings(size) + 2)
    image = th.rand(2, 3, size, size)
    encoder = EquivariantEncoder(3, size, Group("cyclic", 4), channels)
    with th.no_grad():
        plain = CnnEncoder(3, size, channels)(image)
        features = encoder(image).unflatten(1, (8, 4))
        turned = encoder(th.rot90(image, 1, (-2, -1))).unflatten(1, (8, 4))
    assert plain.shape == (2, 8) and plain.std() > 0 and features.std() > 0
    th.testing.assert_close(turned, features.roll(1, dims=2), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(
    ("standardise", "above_ground", "quantise", "levels"),
    [
        (None, None, None, 1e6),
        ((0.1, 0.03), None, "uint16", 65535),
        (None, (0.2, 0.1), "uint8", 255),
        ((0.1, 0.03), (0.2, 0.1), "uint8", 255),
    ],
)
def test_stack_scales_images_and_repeats_numbers(standardise, above_ground, quantise, levels):
    others = {"extra": spaces.Box(-5, 5, (2,), np.float32), "stage": spaces.Discrete(4)}
    space = observation_space(**others, colour=spaces.Box(0, 255, (3, SIZE, SIZE), np.uint8))
    stack = StackedImage(space, quantise, standardise=standardise, above_ground=above_ground)
    observations = {**sample(space), "stage": th.eye(4)[:3]}
    image, seen = stack(observations), observations["heightmap"]
    farthest = seen.amax(dim=(1, 2, 3), keepdim=True)
    height = farthest - seen if above_ground else seen
    mean, deviation = standardise or (0.0, 0.4)
    expected = [observations["colour"], (height - mean) / deviation]
    if above_ground:
        expected.append(((farthest - 0.2) / 0.1).expand_as(seen))
    for key in ("extra", "holding", "stage"):
        expected.append(observations[key][..., None, None].expand(-1, -1, SIZE, SIZE))
    assert stack.channels == image.shape[1]
    th.testing.assert_close(image, th.cat(expected, dim=1), atol=0.4 / levels / 0.03 + 1e-5, rtol=0)


def test_single_images_and_images_without_bounds_are_accepted():
    image = th.rand(2, 3, SIZE, SIZE)
    bounds = np.float32([[[0.4]], [[1.0]]]) * np.ones((2, SIZE, SIZE), np.float32)
    single = StackedImage(spaces.Box(0 * bounds, bounds, dtype=np.float32), "uint8")
    heightmap = image[:, :2] * th.tensor(bounds)
    th.testing.assert_close(single(heightmap), image[:, :2], atol=0.51 / 255, rtol=0)
    colour = StackedImage(spaces.Box(0, 255, (3, SIZE, SIZE), np.uint8), "uint8", standardise=(0.5, 0.25))
    th.testing.assert_close(colour(image), (image - 0.5) / 0.25)
    unbounded = observation_space(heightmap=heights(1, SIZE, SIZE, high=np.inf))
    observations = sample(observation_space())
    assert th.equal(StackedImage(unbounded, None)(observations)[:, :1], observations["heightmap"])


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
def test_features_equal_those_of_stored_images(dtype):
    space = observation_space()
    seen, extractor = sample(space), CNN(space, quantise=dtype)
    rounded = Quantiser(space["heightmap"], dtype).round_trip(seen["heightmap"])
    assert not th.equal(seen["heightmap"], rounded)
    assert th.equal(extractor(seen), extractor({**seen, "heightmap": rounded}))


@pytest.mark.parametrize("group, n", [("cyclic", 4), ("cyclic", 8), ("dihedral", 4)])
@pytest.mark.parametrize("space", SPACES.values(), ids=SPACES)
def test_outputs_are_equivariant_or_invariant(space, group, n):
    regular = EquivariantExtractor(space, group, n, [4, 4, 4])
    invariant = EquivariantExtractor(space, group, n, [4, 4, 4], output="invariant")
    invariant.load_state_dict(regular.state_dict())
    observations = sample(space)
    features = regular(observations)
    assert features.shape == (3, regular.features_dim) and features.std() > 0
    for element in (e for e in range(regular.out_type.group.order) if e % n % (n // 4) == 0):
        turned = dict(observations)
        for name in ("heightmap", "scene") if "scene" in space.spaces else ("heightmap",):
            image = observations[name].flip(-1) if element >= n else observations[name]
            turned[name] = th.rot90(image, element % n // (n // 4), (-2, -1))
        matrix = th.tensor(regular.out_type.matrix(element)).float()
        assert th.allclose(regular(turned), features @ matrix.T, atol=1e-5)
        assert th.allclose(invariant(turned), invariant(observations), atol=1e-5)


@pytest.mark.parametrize("make", [CNN, REGULAR, INVARIANT], ids=["cnn", "regular", "invariant"])
def test_features_of_small_images_are_appended(make):
    """They are rounded and standardised, and never cropped."""
    make = functools.partial(make, quantise="uint16", standardise=(0.1, 0.05), crop=12)
    plain, space = make(observation_space()), with_small_images()
    extractor = make(space, small_image_features=5)
    extractor.load_state_dict(plain.state_dict(), strict=False)
    assert extractor.features_dim == plain.features_dim + 2 * 5  # two sizes
    stacks = [extractor.stack, *(stack for stack, _ in extractor.small_images)]
    assert [(stack.channels, stack.size) for stack in stacks] == [(2, 12), (3, 10), (1 + 3, 8)]
    observations = sample(space)
    rounded = Quantiser(space["in_hand"], "uint16").round_trip(observations["in_hand"])
    assert th.allclose(stacks[1](observations), (rounded - 0.1) / 0.05, atol=1e-6)
    features = extractor(observations)
    assert th.equal(features[:, :-10], plain({key: observations[key] for key in observation_space()}))
    for key, places in (("in_hand", slice(-10, -5)), ("touch", slice(-5, None)), ("colour", slice(-5, None))):
        other = extractor({**observations, key: observations[key].flip(-1)})
        changed = ~th.isclose(other, features, atol=1e-7).all(dim=0)
        assert changed[places].any()
        changed[places] = False
        assert not changed.any()


def image_alone():
    env = gym.make("ToyReach-v0")
    return gym.wrappers.TransformObservation(env, lambda obs: obs["heightmap"], heights(1, SIZE, SIZE))


def with_extractor(extractor_class, **kwargs):
    classes = {"features_extractor_class": extractor_class, "features_extractor_kwargs": kwargs}
    return {**classes, "net_arch": [8]}


EQUIVARIANT = {"n": 4, "channels": [2, 4, 4]}
POLICY_KWARGS = {"features_extractor_kwargs": EQUIVARIANT, "action_sequence": "ryxzp"}


@pytest.mark.parametrize(
    "algorithm, policy, policy_kwargs",
    [
        (PPO, "MultiInputPolicy", with_extractor(CnnExtractor, channels=[4, 8, 8])),
        (CrossQ, "MlpPolicy", with_extractor(EquivariantExtractor, **EQUIVARIANT)),
        (SAC, MultiInputPolicy, with_extractor(CnnExtractor, channels=[4, 8, 8])),
        (SAC, EquivariantPolicy, {**POLICY_KWARGS, "share_features_extractor": True}),
    ],
)
def test_extractors_and_policies_serve_other_algorithms(algorithm, policy, policy_kwargs, tmp_path):
    settings = {"learning_starts": 4, "buffer_size": 16, "replay_buffer_class": ExpertReplayBuffer}
    settings = {"n_steps": 4, "n_epochs": 1} if algorithm is PPO else settings
    env = image_alone() if policy == "MlpPolicy" else "ToyReach-v0"
    settings |= {"policy_kwargs": policy_kwargs, "batch_size": 4, "seed": 0, "device": "cpu"}
    model = algorithm(policy, env, **settings)
    before = model.policy.parameters_to_vector()
    after = model.learn(8).policy.parameters_to_vector()
    assert np.isfinite(after).all() and not np.array_equal(after, before)
    model.save(tmp_path / "model")
    observation = model.get_env().reset()
    loaded = algorithm.load(tmp_path / "model", device="cpu")
    actions = [each.predict(observation, deterministic=True)[0] for each in (model, loaded)]
    np.testing.assert_array_equal(*actions)


@pytest.mark.slow
@pytest.mark.parametrize("extractor_class", [CnnExtractor, EquivariantExtractor])
def test_compiled_extractor_has_the_same_features(extractor_class):
    extractor = extractor_class(observation_space(), channels=[4, 4, 4])
    compiled = extractor_class(observation_space(), channels=[4, 4, 4], compile=True)
    compiled.load_state_dict(extractor.state_dict())
    for batch in (4, 7):
        observations = sample(observation_space(), batch)
        assert th.allclose(compiled(observations), extractor(observations), atol=1e-4)


def test_features_of_numbers_depend_on_every_number():
    state = spaces.Box(-np.inf, np.inf, (7,), np.float32)
    extractor = MlpExtractor(spaces.Dict({"state": state, "holding": heights(1)}), layers=[32, 16])
    observations = {"state": th.randn(3, 7), "holding": th.ones(3, 1)}
    features = extractor(observations)
    assert features.shape == (3, extractor.features_dim) == (3, 16)
    for key, values in observations.items():
        for column in th.eye(values.shape[1]):
            assert not th.equal(extractor({**observations, key: values + column}), features)
    assert th.equal(extractor(dict(reversed(observations.items()))), features)
    plain, standardised = MlpExtractor(state), MlpExtractor(state, standardise=[0.5, 0.1])
    standardised.load_state_dict(plain.state_dict())
    numbers = th.rand(4, 7)
    th.testing.assert_close(standardised(numbers), plain((numbers - 0.5) / 0.1))
