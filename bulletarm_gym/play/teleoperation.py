"""Conversion of keys to actions."""

import numpy as np

from bulletarm_gym.config import OPEN_LOOP
from bulletarm_gym.env import Action, ManipulationEnv

BINDINGS = {
    "sw": ("x", 0),
    "da": ("y", 0),
    "rf": ("z", 0),
    "qe": ("r", 0),
    "ik": ("r", 1),
    "jl": ("r", 2),
}
"""Character of the action sequence, and its number among equal characters, that two keys raise and lower."""
GRIPPER = "g"
"""Key that closes or opens the gripper; with an open-loop control it picks or places."""
STEP = 0.4
"""Size of a closed-loop action: 2 cm or 18 degrees."""
STRIDE = {"x": 0.05, "y": 0.05, "z": 0.05, "r": 0.25}
"""Motion of an open-loop target as a fraction of half a range: 1 cm of a workspace of 0.4 m, 22.5 degrees."""
START_Z = -0.8
"""Initial height of an open-loop target: 3 cm above the floor."""


class Teleoperation:
    """Conversion of keys to actions.

    With a closed-loop control each key is a step, and the gripper keeps its opening. With an open-loop
    control keys move a target, and :data:`GRIPPER` picks or places at the target.

    :param env: environment in which the actions are carried out
    """

    def __init__(self, env: ManipulationEnv) -> None:
        self._env = env
        self._sequence = env.config.action_sequence
        self._is_primitive = np.array([name == "p" for name in self._sequence])
        self.has_target = env.config.control == OPEN_LOOP
        self._keys: dict[str, tuple[int, float]] = {}
        for keys, (character, number) in BINDINGS.items():
            indices = [index for index, name in enumerate(self._sequence) if name == character]
            if number < len(indices):
                self._keys |= {keys[0]: (indices[number], 1.0), keys[1]: (indices[number], -1.0)}
        self.reset()

    def reset(self) -> None:
        """Begin an episode with an open gripper, or with the target in the middle."""
        start = {"z": START_Z} if self.has_target else {"p": 1.0}
        self._last = np.array([start.get(name, 0.0) for name in self._sequence], np.float32)

    def accepts(self, key: str) -> bool:
        """Return True if a key has a function in this environment."""
        return key == GRIPPER or key in self._keys

    def press(self, key: str) -> Action | None:
        """Return the action of an accepted key, or None if the key moves the target."""
        if self.has_target and key == GRIPPER:
            return self.target()
        index, direction = self._keys.get(key, (0, 0.0))
        if self.has_target:
            stride = STRIDE[self._sequence[index]]
            self._last[index] = np.clip(self._last[index] + stride * direction, -1.0, 1.0)
            return None
        opening = 1.0 if (self._last[self._is_primitive] > 0.0).any() else -1.0
        action = np.zeros(len(self._sequence), np.float32)
        action[index] = STEP * direction
        action[self._is_primitive] = -opening if key == GRIPPER else opening
        self.follow(action)
        return action

    def follow(self, action: Action) -> None:
        """Continue from the opening or the target of an action."""
        self._last = np.array(action, np.float32)

    def target(self) -> Action:
        """Return the pick at the target, or the place if the gripper holds an object."""
        is_holding = self._env.scene.held is not None
        return np.where(self._is_primitive, np.float32(1.0 if is_holding else -1.0), self._last)

    def pixel(self, size: int) -> tuple[int, int]:
        """Return row and column of the target in a heightmap with ``size`` pixels per side."""
        x, y = (float(self._last[self._sequence.index(axis)]) for axis in "xy")
        return min(int((x + 1.0) / 2.0 * size), size - 1), min(int((y + 1.0) / 2.0 * size), size - 1)
