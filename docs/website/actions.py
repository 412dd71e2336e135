"""What the numbers of an action mean, read off the environment."""

import math
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from bulletarm_gym.env import ManipulationEnv
from website.markdown import table

CLOSE_LOOP = {
    "p": ("opening of the gripper, closed to open", ""),
    "x": ("move of the fingertips along the world's x axis", "m"),
    "y": ("move along y", "m"),
    "z": ("move along z, up", "m"),
    "r": ("turn of the gripper about the vertical", "rad"),
}
OPEN_LOOP = {
    "p": ("pick below 0, place from 0 on", ""),
    "x": ("of the fingertips, in the world", "m"),
    "y": ("of the fingertips, in the world", "m"),
    "z": ("of the fingertips, in the world", "m"),
    "r": ("turn of the gripper about z", "rad"),
    "rr": ("tilt about its turned y axis", "rad"),
    "rrr": ("tilt about its turned x axis", "rad"),
}
MEANINGS = {"close_loop": CLOSE_LOOP, "open_loop": OPEN_LOOP}


def describe(env: ManipulationEnv) -> Sequence[str]:
    """Return the space of the actions, and a table of their numbers with what -1 and +1 stand for."""
    sequence = env.config.action_sequence
    env.reset(seed=0)
    rows = [
        [str(index), f"`{sequence[index]}`", *_number(env, sequence, index)] for index in range(len(sequence))
    ]
    space = f"`Box(-1, 1, ({len(sequence)},), float32)`, a number each for the characters of `{sequence}`."
    return [space, table(["", "number", "meaning", "at -1", "at +1"], rows)]


def _number(env: ManipulationEnv, sequence: str, index: int) -> list[str]:
    """Return meaning, and both ends in units."""
    turns = sequence[: index + 1].count("r")
    key = "r" * turns if sequence[index] == "r" else sequence[index]
    meaning, unit = MEANINGS[env.config.control][key]
    ends = [_value(_decoded(env, index, end), sequence[index], turns - 1) for end in (-1.0, 1.0)]
    return [meaning, *(_shown(end, unit) for end in ends)]


def _decoded(env: ManipulationEnv, index: int, number: float) -> Any:
    action = np.zeros(env.action_space.shape or (), np.float32)
    action[index] = number
    return env.decode_action(action)


def _value(move: Any, character: str, turn: int) -> float | str:
    """Return the part of a decoded action that a character stands for.

    :param turn: which of the turns
    """
    parts = [getattr(move, part.name) for part in fields(move)]  # opening or primitive, place, turn or turns
    if character == "p":
        return parts[0]  # type: ignore[no-any-return]
    if character in "xyz":
        return float(parts[1]["xyz".index(character)])
    return float(np.atleast_1d(parts[2])[turn])


def _shown(value: float | str, unit: str) -> str:
    if isinstance(value, str):
        return value
    degrees = f" ({math.degrees(value):.0f}°)" if unit == "rad" else ""
    return f"{value:.3g} {unit}".strip() + degrees
