"""Two tasks of a few pixels, with experts and exact states, for the learners' tests: reaching, closed loop;
picking and placing, open loop.
"""

import copy
import functools
import math
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env

from sb3_extensions.ferm import FERM
from sb3_extensions.sacfd import SACfD

ENV_ID, PICKING_ID = "ToyReach-v0", "ToyPicking-v0"
REACH = 0.15  # m
STEP = 0.3  # m at an action of 1
MAX_HEIGHT = 0.4  # m


class Restorable(gym.Env[dict[str, np.ndarray], np.ndarray]):
    """Environment whose state is its generator and the attributes that ``STATE`` names."""

    STATE: tuple[str, ...] = ()

    def get_state(self):
        state = {name: copy.copy(getattr(self, name)) for name in self.STATE}
        return {"rng": self.np_random.bit_generator.state, **state}

    def set_state(self, state):
        self.np_random.bit_generator.state = state["rng"]
        for name in self.STATE:
            setattr(self, name, copy.copy(state[name]))


class ToyReach(Restorable):
    """
    Moves a point to a target in a square of 2 m. The heightmap, centred on the point, has a bump there.

    In the first ``expert_failures`` episodes the expert does not move. ``in_hand`` is the centre of the
    heightmap. With ``observation="state"`` only the position of the target is observed.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"]}
    action_space = spaces.Box(-1.0, 1.0, (5,), np.float32)  # p, x, y, z, r: only x and y move
    STATE = ("episodes", "steps", "offset")

    def __init__(
        self, max_steps=10, expert_failures=0, render_mode=None, size=16, in_hand_size=0, observation="image"
    ):
        self.render_mode, self.size, self.in_hand_size = render_mode, size, in_hand_size
        self.max_steps, self.expert_failures = max_steps, expert_failures
        parts = {
            "heightmap": spaces.Box(0.0, MAX_HEIGHT, (1, size, size), np.float32),
            "holding": spaces.Box(0.0, 1.0, (1,), np.float32),
        }
        if in_hand_size:
            parts["in_hand"] = spaces.Box(0.0, MAX_HEIGHT, (1, in_hand_size, in_hand_size), np.float32)
        if observation == "state":
            parts = {"state": spaces.Box(-1.0, 1.0, (2,), np.float32)}
        self.observation_space = spaces.Dict(parts)
        self.episodes = self.steps = 0
        self.offset = np.zeros(2)  # from the point to the target, m

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.episodes += 1
        self.steps = 0
        self.offset = self.np_random.uniform(-0.9, 0.9, size=2)
        return self._observation(), self._info()

    def step(self, action):
        self.offset = np.clip(self.offset - STEP * np.clip(action[1:3], -1, 1), -1, 1)
        self.steps += 1
        success = self._info()["is_success"]
        truncated = not success and self.steps >= self.max_steps
        return self._observation(), float(success), success, truncated, self._info()

    def _info(self):
        return {"is_success": bool(np.abs(self.offset).max() < REACH)}

    def _observation(self):
        x, y = np.meshgrid(*[np.linspace(-1, 1, self.size)] * 2, indexing="ij")
        squared_distance = (x - self.offset[0]) ** 2 + (y - self.offset[1]) ** 2
        heightmap = MAX_HEIGHT * np.exp(-squared_distance / 0.1)[None].astype(np.float32)
        middle = slice((self.size - self.in_hand_size) // 2, (self.size + self.in_hand_size) // 2)
        parts = {
            "heightmap": heightmap,
            "holding": np.array([self.steps % 2], dtype=np.float32),
            "in_hand": heightmap[:, middle, middle],
            "state": self.offset.astype(np.float32),
        }
        return {name: part for name, part in parts.items() if name in self.observation_space.spaces}

    def expert_action(self):
        action = np.zeros(5, dtype=np.float32)
        if self.episodes > self.expert_failures:
            action[1:3] = np.clip(self.offset / STEP, -1, 1)
        return action


class ToyPicking(Restorable):
    """
    A bar must be grasped across its width and placed on a pad. Other picks and places change nothing.

    A place may have any yaw. Images show 0.4 m. Actions are from ``low`` to ``high``.
    """

    metadata = ToyReach.metadata
    STATE = ("bar", "pad", "yaw", "in_hand", "holding", "steps")
    BAR, PAD = (0.03, 0.10, 0.05), (0.08, 0.08, 0.02)  # width, length, height, m
    AT_BAR, AT_PAD = 0.02, 0.03  # maximum distance from their centres, m
    TURNED = 0.5  # maximum error of the yaw, rad: four yaws on the grid suffice, two do not
    TILTED = 0.2  # greatest tilt, rad
    RANGES: ClassVar[dict[str, tuple[float, float]]] = {
        **{"p": (-1.0, 1.0), "x": (0.0, 0.4), "y": (0.0, 0.4), "z": (0.0, 0.3), "theta": (0.0, math.pi)},
        **{name: (-math.pi / 4, math.pi / 4) for name in ("phi", "psi")},
    }

    def __init__(
        self,
        max_steps=4,
        size=32,
        in_hand_size=12,
        action_sequence="pxyr",
        low=-1.0,
        high=1.0,
        render_mode=None,
    ):
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
        self.in_hand = np.zeros(in_hand, np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.holding, self.steps = False, 0
        self.in_hand = np.zeros_like(self.in_hand)
        self.bar = self.pad = np.zeros(2)
        while np.abs(self.bar - self.pad).max() < 0.11:
            self.bar, self.pad = self.np_random.uniform(0.07, 0.33, size=(2, 2))
        self.yaw = float(self.np_random.uniform(0, math.pi))
        return self._observation(), {"is_success": False}

    def _from_units(self, numbers, inverse=False):
        """Convert from the units of the action space to m and rad, or back."""
        low, high = self.action_space.low, self.action_space.high
        a, b = np.transpose([self.RANGES[name] for name in self.names])
        if inverse:
            return (low + (numbers - a) / (b - a) * (high - low)).astype(np.float32)
        return a + (np.clip(numbers, low, high) - low) / (high - low) * (b - a)

    def decode_action(self, action):
        return dict(zip(self.names, self._from_units(action).tolist(), strict=True))

    def step(self, action):
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

    def _grips(self, point, to):
        turn = (to.get("theta", self.yaw) - self.yaw + math.pi / 2) % math.pi - math.pi / 2
        tilt = max(abs(to.get("phi", 0.0)), abs(to.get("psi", 0.0)))
        near = np.linalg.norm(point - self.bar) < self.AT_BAR and to.get("z", 0.0) < self.BAR[2]
        return bool(near and abs(turn) < self.TURNED and tilt < self.TILTED)

    def _look(self, middle, yaw, shape):
        """Return heights (m) around a point in a frame rotated by a yaw."""
        line = (np.arange(shape[-1]) - (shape[-1] - 1) / 2) * 0.4 / self.size
        x, y = np.meshgrid(line, line, indexing="ij")
        cos, sin = np.cos(yaw), np.sin(yaw)
        points = np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1) + middle
        heights = np.zeros(points.shape[:-1], np.float32)
        for at, angle, (width, length, height) in [
            (self.pad, 0.0, self.PAD),
            *[(self.bar, self.yaw, self.BAR)] * (not self.holding),
        ]:
            x, y = np.moveaxis(points - at, -1, 0)
            across, along = np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x
            heights[(np.abs(across) < width / 2) & (np.abs(along) < length / 2)] = height
        return np.broadcast_to(heights, shape).copy()

    def _observation(self):
        return {
            "heightmap": self._look(np.full(2, 0.2), 0.0, (1, self.size, self.size)),
            "in_hand": self.in_hand.copy(),
            "holding": np.array([self.holding], dtype=np.float32),
        }

    def expert_action(self):
        x, y = self.pad if self.holding else self.bar
        to = {"p": 1.0 if self.holding else -1.0, "x": x, "y": y, "z": 0.025, "phi": 0.0, "psi": 0.0}
        to["theta"] = 0.0 if self.holding else self.yaw
        return self._from_units(np.array([to[name] for name in self.names]), inverse=True)


class WithoutTermination(gym.Wrapper):
    """Truncates episodes that would terminate, so that all targets bootstrap if timeouts do."""

    def step(self, action):
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, False, terminated or truncated, info


if ENV_ID not in gym.registry:
    gym.register(ENV_ID, entry_point=ToyReach)
    gym.register(PICKING_ID, entry_point=ToyPicking)

# Encoders and heads small enough for tests that learn.
SMALL = {
    "MultiInputPolicy": {"features_extractor_kwargs": {"channels": [4, 8, 8]}, "net_arch": [16]},
    "EquivariantPolicy": {"features_extractor_kwargs": {"n": 4, "channels": [2, 4, 8]}},
    "StatePolicy": {"features_extractor_kwargs": {"layers": [32, 32]}, "net_arch": {"pi": [], "qf": [32]}},
}


@pytest.fixture(autouse=True)
def _seed():
    th.manual_seed(0)


def make_envs(env_id, n_envs=1, seed=0, endless=False, **kwargs):
    wrapper = WithoutTermination if endless else None
    return make_vec_env(env_id, n_envs, seed, env_kwargs=kwargs, wrapper_class=wrapper)


@pytest.fixture(scope="session")
def make_toy():
    """Makes a vector environment of reaching: ``make_toy(n_envs, seed, endless, **env_kwargs)``."""
    return functools.partial(make_envs, ENV_ID)


@pytest.fixture(scope="session")
def make_picking():
    """Makes a vector environment of picking and placing: ``make_picking(n_envs, seed, **env_kwargs)``."""
    return functools.partial(make_envs, PICKING_ID)


@pytest.fixture(scope="session")
def make_learner(make_toy):
    """Makes a small learner of the toy task: ``make_learner(env, learner, policy, **kwargs)``."""

    def make(env=None, learner=SACfD, policy="MultiInputPolicy", policy_kwargs=None, **kwargs):
        settings = {"expert_episodes": 5, "batch_size": 16, "buffer_size": 500, "seed": 0}
        if learner is FERM:
            settings |= {"augmentation": {"drq": {"pad": 1}}, "contrastive_steps": 3}
        network = {**SMALL.get(policy, {"net_arch": [16]}), **(policy_kwargs or {})}
        if env is None:
            env = make_toy()
        return learner(policy, env, policy_kwargs=network, device="cpu", **{**settings, **kwargs})

    return make
