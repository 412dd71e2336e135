"""Observations as one image, for libraries that accept nothing else."""

import pickle
import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env as check_gymnasium
from gymnasium.wrappers import FrameStackObservation
from stable_baselines3.common.env_checker import check_env as check_sb3

import bulletarm_gym  # noqa: F401
from bulletarm_gym.wrappers import ImageObservation

CLOSE, OPEN = "BulletArm/CloseLoopBlockPicking-v0", "BulletArm/OpenLoopRampBlockStacking-v0"
HALF_A_COUNT = 0.5 / 255


class Sensors(gymnasium.Env[dict[str, Any], Any]):
    """Observes an image of bytes, a smaller one of numbers, and two numbers."""

    observation_space: Any = spaces.Dict(
        colour=spaces.Box(0, 255, (3, 8, 8), np.uint8),
        depth=spaces.Box(-1.0, 1.0, (1, 4, 4), np.float32),
        pair=spaces.Box(np.array([0, -2], np.float32), np.array([1, 2], np.float32)),
    )
    action_space = spaces.Box(-1.0, 1.0, (1,))

    def reset(self, **_: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        colour = np.arange(192, dtype=np.uint8).reshape(3, 8, 8)
        return {"colour": colour, "depth": np.full((1, 4, 4), 0.5), "pair": np.array([1.0, -1.0])}, {}


def test_every_image_and_number_is_a_channel() -> None:
    env, last = ImageObservation(Sensors()), ImageObservation(Sensors(), channels_last=True)
    assert env.channels == ("colour_0", "colour_1", "colour_2", "depth", "pair_0", "pair_1")
    image, seen = env.reset()[0], Sensors().reset()[0]
    assert image in env.observation_space
    np.testing.assert_array_equal(image[:3], seen["colour"])
    np.testing.assert_array_equal(image[3:], np.broadcast_to([[[191]], [[255]], [[64]]], (3, 8, 8)))
    assert last.reset()[0] in last.observation_space
    np.testing.assert_array_equal(last.reset()[0], image.transpose(1, 2, 0))
    images = env.images({key: np.stack([value, 0 * value]) for key, value in seen.items()})
    np.testing.assert_array_equal(images[0], image)
    np.testing.assert_array_equal(images[1][:, 0, 0], [0, 0, 0, 128, 0, 128])


@pytest.mark.parametrize("env_id", [CLOSE, OPEN])
def test_image_of_an_environment(env_id: str) -> None:
    env = ImageObservation(gymnasium.make(env_id, obs_size=48))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_sb3(env)
        warnings.filterwarnings("ignore", message=".*different from the unwrapped version")
        check_gymnasium(env, skip_render_check=True)
    image, _ = env.reset(seed=0)
    inner: Any = env.unwrapped
    heightmap = inner.observe()["heightmap"][0]
    assert np.abs(image[env.channels.index("heightmap")] / 255 - heightmap / 0.4).max() < 1.01 * HALF_A_COUNT
    assert FrameStackObservation(env, 2).reset(seed=0)[0].shape == (2, *image.shape)
    env.close()


def test_resizing_keeps_means_and_positions() -> None:
    large, small = (
        gymnasium.make(OPEN, obs_size=128),
        ImageObservation(gymnasium.make(OPEN, obs_size=128), 32),
    )
    observation, _ = large.reset(seed=3)
    image, _ = small.reset(seed=3)
    blocks = observation["heightmap"][0].reshape(32, 4, 32, 4).mean(axis=(1, 3)) / 0.4
    assert np.corrcoef(blocks.ravel(), image[0].ravel())[0, 1] > 0.98
    assert abs(blocks.mean() - image[0].mean() / 255) < HALF_A_COUNT
    again = gymnasium.make(small.spec)
    assert again.observation_space == small.observation_space
    assert pickle.loads(pickle.dumps(again)).observation_space == small.observation_space


@pytest.mark.parametrize(
    ("parameters", "size", "message"),
    [({"observation": "state"}, None, "^env must .*, got 'state'"), ({}, 0, "^size must .*, got 0")],
)
def test_image_must_be_possible(parameters: dict[str, Any], size: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ImageObservation(gymnasium.make(CLOSE, **parameters), size)
