"""Learners accept images of both types and numbers from sensors."""

from typing import Any

import gymnasium
import numpy as np
import pytest
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.preprocessing import is_image_space, preprocess_obs
from stable_baselines3.common.utils import obs_as_tensor

import bulletarm_gym  # noqa: F401 (registers the environments)
from sb3_extensions.encoders.extractors import CnnExtractor, EquivariantExtractor
from sb3_extensions.encoders.observation import StackedImage
from sb3_extensions.sacfd import SACfD

PICKING = "BulletArm/CloseLoopBlockPicking-v0"
COLOURS = ["heightmap", "color", "holding"]
EVERYTHING = [
    *COLOURS,
    "segmentation",
    {"name": "rgb", "size": 24},
    "state",
]
SMALL = {"channels": (4, 4, 4, 4, 8)}


def make(observation: list[Any], size: int = 48) -> gymnasium.Env[Any, Any]:
    return gymnasium.make(PICKING, observation=observation, obs_size=size)


def as_seen(space: Any, observation: dict[str, np.ndarray], turns: int = 0) -> dict[str, th.Tensor]:
    """A batch of one as networks get it, the scene turned by quarters about the fingertips."""
    turned = dict(observation)
    for name in ("heightmap", "color", "segmentation"):
        turned[name] = np.rot90(observation[name], turns, axes=(1, 2)).copy()
    batch = obs_as_tensor({name: values[None] for name, values in turned.items()}, "cpu")
    return preprocess_obs(batch, space)


def changed(name: str, values: np.ndarray) -> np.ndarray:
    """Another observation of a sensor."""
    return np.roll(values, 3, axis=-1) if values.ndim > 1 else 1 - values


@pytest.fixture(scope="module")
def seen() -> Any:
    env = make([part for part in EVERYTHING if part != "state"])
    observation, _ = env.reset(seed=1)
    yield env.observation_space, observation
    env.close()


def test_stable_baselines3_knows_the_images(seen: Any) -> None:
    space, _ = seen
    images = [name for name, part in space.spaces.items() if is_image_space(part)]
    assert set(images) == {"color", "segmentation", "rgb"}


@pytest.mark.parametrize("extractor", [CnnExtractor, EquivariantExtractor])
def test_extractors_see_every_part(extractor: Any, seen: Any) -> None:
    space, observation = seen
    th.manual_seed(0)
    network = extractor(space)
    features = network(as_seen(space, observation))
    assert features.shape == (1, network.features_dim)
    for name, values in observation.items():
        other = {**observation, name: changed(name, values)}
        assert not th.equal(network(as_seen(space, other)), features), name


def test_features_rotate_with_colours(seen: Any) -> None:
    """Behind a side camera, which does not turn with the scene, nothing would be equivariant."""
    space, observation = seen
    th.manual_seed(0)
    network = EquivariantExtractor(space, n=4, output="invariant", autocast=None).eval()
    features = [network(as_seen(space, observation, turns)) for turns in (0, 1, 2)]
    for turned in features[1:]:
        th.testing.assert_close(turned, features[0], atol=1e-4, rtol=1e-4)


def test_colours_are_not_standardised_as_heights_are(seen: Any) -> None:
    space, observation = seen
    stack = StackedImage(space, "uint8", standardise=(0.2, 0.01))
    image = stack(as_seen(space, observation))
    start = 0
    for name, part in stack.scales.items():
        channels = space[name].shape[0]
        values = image[0, start : start + channels]
        start += channels
        if name == "heightmap":
            assert values.abs().max() > 5 and part.standardise == (0.2, 0.01)
        else:
            np.testing.assert_allclose(values.numpy(), observation[name] / np.float32(255), atol=1e-6)


def test_sacfd_learns_from_colours_and_keeps_them_exactly() -> None:
    env = make(EVERYTHING)
    model = SACfD(
        "MultiInputPolicy",
        env,
        expert_episodes=2,
        learning_starts=0,
        batch_size=8,
        buffer_size=100,
        policy_kwargs={"features_extractor_kwargs": SMALL},
        device="cpu",
        seed=0,
    )
    model.learn(6)
    table = model.replay_buffer.table
    observation, _ = env.reset(seed=5)
    row = table.heads[:1]
    table.write_observations(row, {name: values[None] for name, values in observation.items()})
    for name, values in table.read_observations(row).items():
        exact = name != "heightmap"
        np.testing.assert_allclose(values[0], observation[name], atol=0 if exact else 0.2 / 255)
        assert values.dtype == observation[name].dtype
    assert model.predict(observation)[0].shape == env.action_space.shape
    env.close()


@pytest.mark.parametrize("augmentation", [{"rad": {"size": 32}}, "drq"], ids=str)
def test_equivariant_sacfd_learns_from_colours(augmentation: Any) -> None:
    env = make(COLOURS)
    model = SACfD(
        "EquivariantPolicy",
        env,
        expert_episodes=2,
        learning_starts=0,
        batch_size=8,
        buffer_size=100,
        augmentation=augmentation,
        policy_kwargs={"features_extractor_kwargs": {"n": 4, "channels": (2, 2, 2, 2, 4)}},
        device="cpu",
        seed=0,
    )
    model.learn(4)
    assert model._n_updates == 4
    env.close()


def test_stock_sac_learns_from_colours() -> None:
    env = make(COLOURS)
    model = SAC(
        "MultiInputPolicy", env, learning_starts=4, batch_size=4, buffer_size=50, device="cpu", seed=0
    )
    model.learn(8)
    assert model._n_updates == 4
    env.close()
