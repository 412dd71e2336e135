"""Conversion of keys to actions."""

import numpy as np

from bulletarm_gym.config import OPEN_LOOP
from bulletarm_gym.env import Action, ManipulationEnv

BINDINGS = {
    "w": ("x", 0, -1.0),
    "s": ("x", 0, 1.0),
    "a": ("y", 0, -1.0),
    "d": ("y", 0, 1.0),
    "r": ("z", 0, 1.0),
    "f": ("z", 0, -1.0),
    "q": ("r", 0, 1.0),
    "e": ("r", 0, -1.0),
    "i": ("r", 1, 1.0),
    "k": ("r", 1, -1.0),
    "j": ("r", 2, 1.0),
    "l": ("r", 2, -1.0),
}
"""Character of the action sequence, its number among equal characters, and direction, for each key."""
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
        self.reset()

    def reset(self) -> None:
        """Begin an episode with an open gripper, or with the target in the middle."""
        start = {"z": START_Z} if self.has_target else {"p": 1.0}
        self._last = np.array([start.get(name, 0.0) for name in self._sequence], np.float32)

    def accepts(self, key: str) -> bool:
        """Return True if a key has a function in this environment."""
        return key == GRIPPER or self._index(key) is not None

    def _index(self, key: str) -> int | None:
        """Return the index of the number in an action that a key changes, or None."""
        character, number, _ = BINDINGS.get(key, ("", 0, 0.0))
        found = [index for index, name in enumerate(self._sequence) if name == character]
        return found[number] if number < len(found) else None

    def press(self, key: str) -> Action | None:
        """Return the action of an accepted key, or None if the key moves the target."""
        if not self.has_target:
            return self._move_gripper(key)
        if key == GRIPPER:
            return self.target()
        character, _, direction = BINDINGS[key]
        index = self._index(key)
        self._last[index] = np.clip(self._last[index] + STRIDE[character] * direction, -1.0, 1.0)
        return None

    def _move_gripper(self, key: str) -> Action:
        opening = 1.0 if (self._last[self._is_primitive] > 0.0).any() else -1.0
        action = np.zeros(len(self._sequence), np.float32)
        action[self._is_primitive] = -opening if key == GRIPPER else opening
        if key != GRIPPER:
            action[self._index(key)] = STEP * BINDINGS[key][2]
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
