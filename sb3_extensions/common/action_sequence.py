"""Meaning of the numbers of an action, one character for each number."""

from __future__ import annotations

from dataclasses import dataclass

ACTION_SYMBOLS = "pxyzr"
ROTATION_VECTOR = "uvr"
"""Names of three r's: the components of a rotation vector about the world's x, y and z axes."""


@dataclass(frozen=True)
class ActionSequence:
    """
    Names of the numbers of an action: ``p`` (gripper), ``x``, ``y``, ``z`` (translation) and ``r`` (rotation
    about z). Three r's are a rotation vector about the world's x, y and z axes.

    :param symbols: at most one each of ``pxyz``, and zero, one or three ``r``, in any order; x requires y
    :param action_dim: length of an action
    :raises ValueError: if ``symbols`` has another length, or unknown, repeated or missing characters
    """

    symbols: str
    action_dim: int

    def __post_init__(self) -> None:
        counts = {symbol: self.symbols.count(symbol) for symbol in ACTION_SYMBOLS}
        rotations = counts.pop("r")
        problem = None
        if len(self.symbols) != self.action_dim:
            problem = f"have {self.action_dim} characters, the length of an action"
        elif not set(self.symbols) <= set(ACTION_SYMBOLS):
            problem = f"contain the characters of {ACTION_SYMBOLS!r} only"
        elif max(counts.values()) > 1:
            problem = "not repeat a character of 'pxyz'"
        elif rotations not in (0, 1, 3):
            problem = "contain zero, one or three r"
        elif counts["x"] != counts["y"]:
            problem = "contain both x and y, or neither"
        if problem is not None:
            raise ValueError(f"action_sequence must {problem}, got {self.symbols!r}")

    @property
    def names(self) -> str:
        """Different characters for all numbers, ``u``, ``v`` and ``r`` for three r's."""
        rotations = iter(ROTATION_VECTOR if self.symbols.count("r") > 1 else "r")
        return "".join(next(rotations) if symbol == "r" else symbol for symbol in self.symbols)

    def __contains__(self, name: str) -> bool:
        return name in self.names

    def places(self, names: str) -> list[int]:
        """Return the indices of the numbers with these names. Names that the action lacks are skipped."""
        return [self.names.index(name) for name in names if name in self.names]
