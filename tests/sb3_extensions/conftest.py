"""Two tasks of a few pixels, with experts and exact states, for the learners' tests: reaching, close loop;
picking and placing, open loop.
"""

import math
from collections.abc import Callable
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv

ENV_ID, PICKING_ID = "ToyReach-v0", "ToyPicking-v0"
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
    :param observation: "image", or "state": two numbers, where the target is
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
        observation: str = "image",
    ) -> None:
        self.render_mode = render_mode
        self.size = size
        self.in_hand_size = in_hand_size
        self.observation = observation
        parts = {
            "heightmap": spaces.Box(0.0, MAX_HEIGHT, (1, size, size), np.float32),
            "holding": spaces.Box(0.0, 1.0, (1,), np.float32),
        }
        if in_hand_size:
            parts["in_hand"] = spaces.Box(0.0, MAX_HEIGHT, (1, in_hand_size, in_hand_size), np.float32)
        if observation == "state":
            parts = {"state": spaces.Box(-1.0, 1.0, (2,), np.float32)}
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
        if self.observation == "state":
            return {"state": self.offset.astype(np.float32)}
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


class ToyPicking(gym.Env[dict[str, np.ndarray], np.ndarray]):
    """
    A bar is to be gripped across its width, anywhere along it, and put onto a pad; a pick or place elsewhere
    changes nothing. A place may have any yaw.

    :param max_steps: episodes are truncated after as many steps
    :param size: pixels a side of the heightmap, of 0.4 m
    :param in_hand_size: pixels a side of what was where the bar was gripped
    :param action_sequence: one character for each number of an action; three r's are yaw and tilts
    :param low: what -1 is elsewhere, of each number of an action
    :param high: what 1 is elsewhere
    :param render_mode: not used
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"]}
    BAR, PAD = (0.03, 0.10, 0.05), (0.08, 0.08, 0.02)  # width, length, height, m
    AT_BAR, AT_PAD = 0.02, 0.03  # farthest from their middles, m
    TURNED = 0.5  # farthest from the bar's yaw, rad: the nearest of four yaws is near enough, not of two
    TILTED = 0.2  # greatest tilt, rad
    RANGES: ClassVar[dict[str, tuple[float, float]]] = {
        **{"p": (-1.0, 1.0), "x": (0.0, 0.4), "y": (0.0, 0.4), "z": (0.0, 0.3), "theta": (0.0, math.pi)},
        **{name: (-math.pi / 4, math.pi / 4) for name in ("phi", "psi")},
    }

    def __init__(
        self,
        max_steps: int = 4,
        size: int = 32,
        in_hand_size: int = 12,
        action_sequence: str = "pxyr",
        low: float = -1.0,
        high: float = 1.0,
        render_mode: str | None = None,
    ) -> None:
        self.render_mode = render_mode
        angles = iter(("theta", "phi", "psi"))
        self.names = [next(angles) if character == "r" else character for character in action_sequence]
        self.max_steps, self.size = max_steps, size
        self.action_space = spaces.Box(low, high, (len(self.names),), np.float32)
        in_hand = (3 if "psi" in self.names else 1, in_hand_size, in_hand_size)
        self.observation_space = spaces.Dict(
            {
                "heightmap": spaces.Box(0.0, MAX_HEIGHT, (1, size, size), np.float32),
                "in_hand": spaces.Box(0.0, MAX_HEIGHT, in_hand, np.float32),
                "holding": spaces.Box(0.0, 1.0, (1,), np.float32),
            }
        )
        self.bar, self.pad, self.yaw = np.zeros(2), np.zeros(2), 0.0
        self.in_hand = np.zeros(in_hand, np.float32)
        self.holding, self.steps = False, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.holding, self.steps = False, 0
        self.in_hand = np.zeros_like(self.in_hand)
        self.bar = self.pad = np.zeros(2)
        while np.abs(self.bar - self.pad).max() < 0.11:
            self.bar, self.pad = self.np_random.uniform(0.07, 0.33, size=(2, 2))
        self.yaw = float(self.np_random.uniform(0, math.pi))
        return self._observation(), {"is_success": False}

    def decode_action(self, action: np.ndarray) -> dict[str, float]:
        """In m and rad."""
        low, high = self.action_space.low, self.action_space.high
        shares = (np.clip(action, low, high) - low) / (high - low)
        ends = [self.RANGES[name] for name in self.names]
        return {
            name: a + share * (b - a) for name, share, (a, b) in zip(self.names, shares, ends, strict=True)
        }

    def step(self, action: np.ndarray) -> Any:
        self.steps += 1
        to = self.decode_action(action)
        success, point = False, np.array([to["x"], to["y"]])
        places = to.get("p", 1.0 if self.holding else -1.0) >= 0.0
        if places and self.holding:
            success = bool(np.linalg.norm(point - self.pad) < self.AT_PAD)
            self.holding = not success
        elif not places and not self.holding and self._grips(point, to):
            self.in_hand = self._look(point, to.get("theta", 0.0), self.in_hand.shape)
            self.holding = True
        truncated = not success and self.steps >= self.max_steps
        return self._observation(), float(success), success, truncated, {"is_success": success}

    def _grips(self, point: np.ndarray, to: dict[str, float]) -> bool:
        turn = (to.get("theta", self.yaw) - self.yaw + math.pi / 2) % math.pi - math.pi / 2
        tilt = max(abs(to.get("phi", 0.0)), abs(to.get("psi", 0.0)))
        near = np.linalg.norm(point - self.bar) < self.AT_BAR and to.get("z", 0.0) < self.BAR[2]
        return bool(near and abs(turn) < self.TURNED and tilt < self.TILTED)

    def _heights(self, points: np.ndarray) -> np.ndarray:
        """Height at points (..., 2), m."""
        heights = np.zeros(points.shape[:-1], np.float32)
        things = [(self.pad, 0.0, self.PAD)] + [(self.bar, self.yaw, self.BAR)] * (not self.holding)
        for middle, yaw, (width, length, height) in things:
            x, y = np.moveaxis(points - middle, -1, 0)
            across, along = np.cos(yaw) * x + np.sin(yaw) * y, np.cos(yaw) * y - np.sin(yaw) * x
            heights[(np.abs(across) < width / 2) & (np.abs(along) < length / 2)] = height
        return heights

    def _look(self, middle: Any, yaw: float, shape: tuple[int, ...]) -> np.ndarray:
        """Heights around a point, rows and columns turned by a yaw."""
        line = (np.arange(shape[-1]) - (shape[-1] - 1) / 2) * 0.4 / self.size
        x, y = np.meshgrid(line, line, indexing="ij")
        cos, sin = np.cos(yaw), np.sin(yaw)
        heights = self._heights(np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1) + middle)
        return np.broadcast_to(heights, shape).copy()

    def _observation(self) -> dict[str, np.ndarray]:
        return {
            "heightmap": self._look(np.full(2, 0.2), 0.0, (1, self.size, self.size)),
            "in_hand": self.in_hand.copy(),
            "holding": np.array([self.holding], dtype=np.float32),
        }

    def expert_action(self) -> np.ndarray:
        x, y = self.pad if self.holding else self.bar
        to = {"p": 1.0 if self.holding else -1.0, "x": x, "y": y, "z": 0.025, "phi": 0.0, "psi": 0.0}
        to["theta"] = 0.0 if self.holding else self.yaw
        ends = [self.RANGES[name] for name in self.names]
        shares = [(to[name] - a) / (b - a) for name, (a, b) in zip(self.names, ends, strict=True)]
        low, high = self.action_space.low, self.action_space.high
        return (low + np.array(shares) * (high - low)).astype(np.float32)

    def get_state(self) -> dict[str, Any]:
        names = ("bar", "pad", "yaw", "in_hand", "holding", "steps")
        return {"rng": self.np_random.bit_generator.state, **{name: getattr(self, name) for name in names}}

    def set_state(self, state: dict[str, Any]) -> None:
        values = dict(state)
        self.np_random.bit_generator.state = values.pop("rng")
        for name, value in values.items():
            setattr(self, name, value)


class ImageOnly(gym.ObservationWrapper):
    """Leaves nothing but the heightmap."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.observation_space = env.observation_space["heightmap"]

    def observation(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        return observation["heightmap"]


class WithoutTermination(gym.Wrapper):
    """Truncates episodes that would terminate, so that all targets bootstrap if timeouts do."""

    def step(self, action: np.ndarray) -> Any:
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, False, terminated or truncated, info


if ENV_ID not in gym.registry:
    gym.register(ENV_ID, entry_point=ToyReach)
    gym.register(PICKING_ID, entry_point=ToyPicking)

MakeEnv = Callable[..., VecEnv]
# Encoder and head small enough for tests that learn.
SMALL_CNN: dict[str, Any] = {"features_extractor_kwargs": {"channels": [8, 16, 32]}, "net_arch": [32]}
SMALL_EQUIVARIANT: dict[str, Any] = {"features_extractor_kwargs": {"n": 4, "channels": [2, 4, 8]}}


@pytest.fixture
def make_toy() -> MakeEnv:
    """Makes a vector environment of the toy task: ``make_toy(n_envs, seed, image_only, **env_kwargs)``."""

    def make(
        n_envs: int = 1,
        seed: int | None = 0,
        image_only: bool = False,
        endless: bool = False,
        **env_kwargs: Any,
    ) -> VecEnv:
        wrapper = ImageOnly if image_only else (WithoutTermination if endless else None)
        return make_vec_env(ENV_ID, n_envs, seed, env_kwargs=env_kwargs, wrapper_class=wrapper)

    return make


@pytest.fixture
def make_picking() -> MakeEnv:
    """Makes a vector environment of picking and placing: ``make_picking(n_envs, seed, **env_kwargs)``."""

    def make(n_envs: int = 1, seed: int | None = 0, **env_kwargs: Any) -> VecEnv:
        return make_vec_env(PICKING_ID, n_envs, seed, env_kwargs=env_kwargs)

    return make


@pytest.fixture(params=["MultiInputPolicy", "EquivariantPolicy"])
def policy(request: pytest.FixtureRequest) -> tuple[str, dict[str, Any]]:
    """Name and small ``policy_kwargs`` of each policy."""
    return request.param, SMALL_CNN if request.param == "MultiInputPolicy" else SMALL_EQUIVARIANT
