"""A quick environment with the interface of the closed-loop ids: a finger that must come near a block."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import FilterObservation

TOY_ID = "BulletArm/CloseLoopToy-v0"
STEP = 0.05  # m an action of 1 moves
REACH = 0.06  # m at which the block is reached
MAX_STEPS = 6


class ToyEnv(gym.Env[dict[str, Any], np.ndarray]):
    """The block lies at ``self.offset`` from the finger; the heightmap, 0.45 m wide, shows it."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}  # noqa: RUF012
    made: list[ToyEnv] = []  # noqa: RUF012

    def __init__(self, obs_size=128, action_sequence="pxyzr", render_mode=None):
        if obs_size < 48:
            raise ValueError(f"obs_size must be at least 48, got {obs_size}")
        self.obs_size, self.action_sequence, self.render_mode = obs_size, action_sequence, render_mode
        self.x, self.size = action_sequence.index("x"), len(action_sequence)
        image = spaces.Box(0, 0.4, (1, obs_size, obs_size), np.float32)
        holding = spaces.Box(0, 1, (1,), np.float32)
        self.observation_space = spaces.Dict({"heightmap": image, "holding": holding})
        self.action_space = spaces.Box(-1, 1, (self.size,), np.float32)
        self.seeds: list[int | None] = []
        ToyEnv.made.append(self)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.seeds.append(seed)
        self.offset = self.np_random.uniform(-0.15, 0.15, 2)
        self.steps = 0
        return self._observe(), self._info()

    def step(self, action):
        self.offset = self.offset - STEP * np.asarray(action)[self.x : self.x + 2]
        self.steps += 1
        success = self._info()["is_success"]
        return self._observe(), float(success), success, self.steps >= MAX_STEPS, self._info()

    def expert_action(self):
        action = np.zeros(self.size, np.float32)
        action[self.x : self.x + 2] = np.clip(self.offset / STEP, -1, 1)
        return action

    def get_state(self):
        return self.offset, self.steps, self.np_random.bit_generator.state

    def set_state(self, state):
        self.offset, self.steps, self.np_random.bit_generator.state = state

    def render(self):
        return np.full((60, 80, 3), 90, np.uint8)

    def _info(self):
        return {"is_success": bool(np.linalg.norm(self.offset) < REACH)}

    def _observe(self):
        image = np.full((1, self.obs_size, self.obs_size), 0.2, np.float32)
        row, column = ((self.offset / 0.45 + 0.5) * self.obs_size).astype(int).clip(2, self.obs_size - 3)
        image[0, row - 2 : row + 3, column - 2 : column + 3] = 0.1
        return {"heightmap": image, "holding": np.zeros(1, np.float32)}


def without_holding(env):
    """Wrap an environment by a function, as files of rl_zoo3 can."""
    return FilterObservation(env, ["heightmap"])
