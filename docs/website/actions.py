"""Tables of the numbers of an action, computed with the environment."""

import math
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from bulletarm_gym.env import ManipulationEnv
from website.markdown import table

CLOSE_LOOP = {
    "p": ("opening of the gripper, 0 closed to 1 open", ""),
    "x": ("translation of the fingertips along world x", "m"),
    "y": ("translation along world y", "m"),
    "z": ("translation along world z, upwards", "m"),
    "r": ("rotation of the gripper about the vertical", "rad"),
}
OPEN_LOOP = {
    "p": ("primitive: pick below 0, else place", ""),
    "x": ("world x of the fingertips", "m"),
    "y": ("world y of the fingertips", "m"),
    "z": ("world z of the fingertips", "m"),
    "r": ("rotation of the gripper about z", "rad"),
    "rr": ("rotation about the rotated y axis", "rad"),
    "rrr": ("rotation about the rotated x axis", "rad"),
}
MEANINGS = {"close_loop": CLOSE_LOOP, "open_loop": OPEN_LOOP}


def describe(env: ManipulationEnv) -> Sequence[str]:
    """Return the action space, and a table of the numbers of an action with their values at -1 and 1."""
    sequence = env.config.action_sequence
    env.reset(seed=0)
    rows = [
        [str(index), f"`{sequence[index]}`", *_number(env, sequence, index)] for index in range(len(sequence))
    ]
    space = f"`Box(-1, 1, ({len(sequence)},), float32)`, one number for each character of `{sequence}`."
    return [space, table(["index", "number", "meaning", "at -1", "at 1"], rows)]


def _number(env: ManipulationEnv, sequence: str, index: int) -> list[str]:
    """Return the meaning of a number and its values at -1 and 1."""
    rotations = sequence[: index + 1].count("r")
    key = "r" * rotations if sequence[index] == "r" else sequence[index]
    meaning, unit = MEANINGS[env.config.control][key]
    ends = [_value(_decoded(env, index, end), sequence[index], rotations - 1) for end in (-1.0, 1.0)]
    return [meaning, *(_shown(end, unit) for end in ends)]


def _decoded(env: ManipulationEnv, index: int, number: float) -> Any:
    action = np.zeros(env.action_space.shape or (), np.float32)
    action[index] = number
    return env.decode_action(action)


def _value(move: Any, character: str, rotation: int) -> float | str:
    """Return the part of a decoded action with the meaning of a character.

    :param rotation: index of the rotation, for the character r
    """
    parts = [
        getattr(move, part.name) for part in fields(move)
    ]  # opening or primitive, translation or position, rotation or rotations
    if character == "p":
        return parts[0]  # type: ignore[no-any-return]
    if character in "xyz":
        return float(parts[1]["xyz".index(character)])
    return float(np.atleast_1d(parts[2])[rotation])


def _shown(value: float | str, unit: str) -> str:
    if isinstance(value, str):
        return value
    degrees = f" ({math.degrees(value):.0f}°)" if unit == "rad" else ""
    return f"{value:.3g} {unit}".strip() + degrees
