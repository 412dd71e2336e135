"""A reaching task of a few pixels, with an expert and exact state, for the learners' tests."""

from collections.abc import Callable
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv

ENV_ID = "ToyReach-v0"
SIZE = 16  # pixels
REACH = 0.15  # m
STEP = 0.3  # m at an action of 1
MAX_HEIGHT = 0.4  # m


class ToyReach(gym.Env[dict[str, np.ndarray], np.ndarray]):
    """
    Moves a point to a target in a square of 2 m. The heightmap, centred on the point, has a bump there.

    :param max_steps: episodes are truncated after as many steps
    :param size: pixels a side of the heightmap
    :param render_mode: not used
    :param expert_failures: in how many of the first episodes the expert stands still
    :param in_hand_size: pixels a side of a smaller image, of what is at the point; 0: there is none
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"]}
    action_space = spaces.Box(-1.0, 1.0, (5,), np.float32)  # p, x, y, z, r: only x and y move

    def __init__(
        self,
        max_steps: int = 10,
        expert_failures: int = 0,
        render_mode: str | None = None,
        size: int = SIZE,
        in_hand_size: int = 0,
    ) -> None:
        self.render_mode = render_mode
        self.size = size
        self.in_hand_size = in_hand_size
        parts = {
            "heightmap": spaces.Box(0.0, MAX_HEIGHT, (1, size, size), np.float32),
            "holding": spaces.Box(0.0, 1.0, (1,), np.float32),
        }
        if in_hand_size:
            parts["in_hand"] = spaces.Box(0.0, MAX_HEIGHT, (1, in_hand_size, in_hand_size), np.float32)
        self.observation_space = spaces.Dict(parts)
        self.max_steps = max_steps
        self.expert_failures = expert_failures
        self.episodes = 0
        self.steps = 0
        self.offset = np.zeros(2)  # from the point to the target, m

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.episodes += 1
        self.steps = 0
        self.offset = self.np_random.uniform(-0.9, 0.9, size=2)
        return self._observation(), self._info()

    def step(self, action: np.ndarray) -> Any:
        self.offset = np.clip(self.offset - STEP * np.clip(action[1:3], -1, 1), -1, 1)
        self.steps += 1
        success = self._info()["is_success"]
        truncated = not success and self.steps >= self.max_steps
        return self._observation(), float(success), success, truncated, self._info()

    def _info(self) -> dict[str, Any]:
        return {"is_success": bool(np.abs(self.offset).max() < REACH)}

    def _observation(self) -> dict[str, np.ndarray]:
        grid = np.linspace(-1, 1, self.size)
        x, y = np.meshgrid(grid, grid, indexing="ij")
        squared_distance = (x - self.offset[0]) ** 2 + (y - self.offset[1]) ** 2
        heightmap = MAX_HEIGHT * np.exp(-squared_distance / 0.1)[None].astype(np.float32)
        observation = {"heightmap": heightmap, "holding": np.array([self.steps % 2], dtype=np.float32)}
        if self.in_hand_size:
            middle = slice((self.size - self.in_hand_size) // 2, (self.size + self.in_hand_size) // 2)
            observation["in_hand"] = heightmap[:, middle, middle]
        return observation

    def expert_action(self) -> np.ndarray:
        action = np.zeros(5, dtype=np.float32)
        if self.episodes > self.expert_failures:
            action[1:3] = np.clip(self.offset / STEP, -1, 1)
        return action

    def get_state(self) -> dict[str, Any]:
        return {
            "rng": self.np_random.bit_generator.state,
            "episodes": self.episodes,
            "steps": self.steps,
            "offset": self.offset.copy(),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        self.np_random.bit_generator.state = state["rng"]
        self.episodes, self.steps = state["episodes"], state["steps"]
        self.offset = state["offset"].copy()


class ImageOnly(gym.ObservationWrapper):
    """Leaves nothing but the heightmap."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.observation_space = env.observation_space["heightmap"]

    def observation(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        return observation["heightmap"]


if ENV_ID not in gym.registry:
    gym.register(ENV_ID, entry_point=ToyReach)

MakeEnv = Callable[..., VecEnv]
# Encoder and head small enough for tests that learn.
SMALL_CNN: dict[str, Any] = {"features_extractor_kwargs": {"channels": [8, 16, 32]}, "net_arch": [32]}
SMALL_EQUIVARIANT: dict[str, Any] = {"features_extractor_kwargs": {"n": 4, "channels": [2, 4, 8]}}


@pytest.fixture
def papers() -> dict[str, Any]:
    """Arguments with which SACfD and TQCfD do what the paper's learners do, and nothing besides."""
    ours_off = {"exploration": 0.0, "self_imitation": None, "bc_limit": 1.0}
    return {"n_steps": 1, "ent_coef": "auto_0.01", "backup_entropy": True, "bc_weight": 1.0, **ours_off}


@pytest.fixture
def make_toy() -> MakeEnv:
    """Makes a vector environment of the toy task: ``make_toy(n_envs, seed, image_only, **env_kwargs)``."""

    def make(n_envs: int = 1, seed: int | None = 0, image_only: bool = False, **env_kwargs: Any) -> VecEnv:
        wrapper = ImageOnly if image_only else None
        return make_vec_env(ENV_ID, n_envs, seed, env_kwargs=env_kwargs, wrapper_class=wrapper)

    return make


@pytest.fixture(params=["MultiInputPolicy", "EquivariantPolicy"])
def policy(request: pytest.FixtureRequest) -> tuple[str, dict[str, Any]]:
    """Name and small ``policy_kwargs`` of each policy."""
    return request.param, SMALL_CNN if request.param == "MultiInputPolicy" else SMALL_EQUIVARIANT
