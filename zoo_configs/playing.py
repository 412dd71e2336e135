"""Keys to actions, for people who move a gripper themselves."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt

Action = npt.NDArray[np.float32]

# Which number of an action a key changes, by its character in action_sequence and, of several r's, which one.
MOVES = {
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
GRIP = "g"
EXPERT = "x"
NEW_EPISODE = "n"
QUIT = "."
HELP = """  w s  back and forth (x)      a d  left and right (y)     r f  up and down (z)
  q e  turn                    i k, j l  tilt              g    close or open; open loop: pick or place
  x    let the expert do it    n    new episode            .    end"""
CLOSE_LOOP_STRIDE = 0.4  # of the farthest move: 2 cm, 18 degrees
OPEN_LOOP_STRIDE = 0.05  # of half the range: 1 cm of a workspace of 0.4 m
OPEN_LOOP_TURN = 0.25  # of half the range of angles: 22.5 degrees of a half rotation
START_Z = -0.8  # of an open-loop target: 3 cm over the floor


class Pilot(ABC):
    """
    Turns keys into actions.

    :param env: The environment
    :param stride: Share that a key moves
    """

    def __init__(self, env: gym.Env[Any, Any], stride: float) -> None:
        self.env, self.stride = env, stride
        self.sequence: str = env.get_wrapper_attr("action_sequence")
        self.reset()

    @abstractmethod
    def reset(self) -> None:
        """Begin an episode."""

    @abstractmethod
    def press(self, key: str, observation: dict[str, Any]) -> Action | None:
        """
        Press a key.

        :param key: One of ``MOVES`` or ``GRIP``
        :param observation: What is seen
        :return: The action; None if there is none yet
        """

    @abstractmethod
    def follow(self, action: Action) -> None:
        """
        Go on from what somebody else does.

        :param action: Their action
        """

    def show(self, observation: dict[str, Any]) -> None:  # noqa: B027 (in close loop the gripper shows it)
        """
        Show in the window where the gripper would go.

        :param observation: What is seen
        """

    def index(self, key: str) -> int | None:
        """
        Which number of an action a key changes.

        :param key: One of ``MOVES``
        :return: Its place; None if actions have no such number
        """
        character, which, _ = MOVES[key]
        places = [place for place, name in enumerate(self.sequence) if name == character]
        return places[which] if which < len(places) else None

    def takes(self, key: str) -> bool:
        """
        Whether a key does something here.

        :param key: Any character
        :return: Whether it moves or grips
        """
        return key == GRIP or (key in MOVES and self.index(key) is not None)

    def holds(self, observation: dict[str, Any]) -> bool:
        """
        Whether the gripper holds something.

        :param observation: What is seen; where it does not say it, the scene does
        :return: Whether it does
        """
        if "holding" in observation:
            return bool(observation["holding"][0])
        return self.env.get_wrapper_attr("scene").held is not None

    def _set_primitive(self, action: Action, value: float) -> Action:
        if "p" in self.sequence:
            action[self.sequence.index("p")] = value
        return action


class CloseLoopPilot(Pilot):
    """Every key is a step; the gripper stays as it was."""

    def reset(self) -> None:
        """Begin an episode, with an open gripper."""
        self.opening = 1.0

    def press(self, key: str, observation: dict[str, Any]) -> Action | None:
        """Move by the stride, or close or open the gripper."""
        action = np.zeros(len(self.sequence), np.float32)
        if key == GRIP:
            self.opening = -self.opening
        elif (index := self.index(key)) is not None:
            action[index] = self.stride * MOVES[key][2]
        return self._set_primitive(action, self.opening)

    def follow(self, action: Action) -> None:
        """Keep the gripper as they leave it."""
        self.opening = 1.0 if action[self.sequence.index("p")] > 0 else -1.0


class OpenLoopPilot(Pilot):
    """Keys move a target; the gripper goes there when it is to pick or to place."""

    def reset(self) -> None:
        """Begin an episode, with the target in the middle."""
        self.target = np.zeros(len(self.sequence), np.float32)
        if "z" in self.sequence:
            self.target[self.sequence.index("z")] = START_Z

    def press(self, key: str, observation: dict[str, Any]) -> Action | None:
        """Move the target by the stride, or pick or place there."""
        if key == GRIP:
            return self._set_primitive(self.target.copy(), 1.0 if self.holds(observation) else -1.0)
        index = self.index(key)
        if index is not None:
            turns = MOVES[key][0] == "r"
            moved = self.target[index] + (OPEN_LOOP_TURN if turns else self.stride) * MOVES[key][2]
            self.target[index] = np.clip(moved, -1.0, 1.0)
        return None

    def follow(self, action: Action) -> None:
        """Stay where their target was."""
        self.target = np.array(action, np.float32)

    def show(self, observation: dict[str, Any]) -> None:
        """Mark the target in the window."""
        action = self._set_primitive(self.target.copy(), 1.0 if self.holds(observation) else -1.0)
        move = self.env.get_wrapper_attr("decode_action")(action)
        self.env.get_wrapper_attr("viewer").mark(move.position, move.rotation[0])

    def place(self, size: int) -> tuple[int, int]:
        """
        Where the target is in a heightmap.

        :param size: Pixels of its side
        :return: Row and column
        """
        x, y = (float(self.target[self.sequence.index(axis)]) for axis in "xy")
        return (min(int((x + 1) / 2 * size), size - 1), min(int((y + 1) / 2 * size), size - 1))

    @property
    def yaw(self) -> float | None:
        """The gripper's yaw at the target (rad); None where actions have none."""
        if "r" not in self.sequence:
            return None
        return float(self.env.get_wrapper_attr("decode_action")(self.target).rotation[0])


def make_pilot(env: gym.Env[Any, Any], stride: float | None = None) -> Pilot:
    """
    Return who turns keys into actions of an environment.

    :param env: One of our environments
    :param stride: Share that a key moves; None takes the control's own
    :return: The pilot
    """
    if env.get_wrapper_attr("config").control == "open_loop":
        return OpenLoopPilot(env, stride or OPEN_LOOP_STRIDE)
    return CloseLoopPilot(env, stride or CLOSE_LOOP_STRIDE)
