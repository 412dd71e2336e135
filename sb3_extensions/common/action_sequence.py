"""Meaning of the numbers of an action, one character for each number."""

from dataclasses import dataclass

ROTATION_VECTOR = "uvr"
"""Names of three r's: the components of a rotation vector about the world's x, y and z axes."""


@dataclass(frozen=True)
class ActionSequence:
    """
    Names of the numbers of an action: ``p`` (gripper), ``x``, ``y``, ``z`` (translation) and ``r`` (rotation
    about z). Three r's are a rotation vector about the world's x, y and z axes.

    :param symbols: at most one each of ``pxyz``, and zero, one or three ``r``, in any order; x requires y
    :param action_dim: length of an action
    :raises ValueError: if ``symbols`` is another sequence
    """

    symbols: str
    action_dim: int

    def __post_init__(self) -> None:
        p, x, y, z, rotations = (self.symbols.count(symbol) for symbol in "pxyzr")
        is_complete = p + x + y + z + rotations == len(self.symbols) == self.action_dim
        if not (is_complete and max(p, x, y, z) <= 1 and x == y and rotations in (0, 1, 3)):
            raise ValueError(
                f"action_sequence must have {self.action_dim} characters: at most one each of p, x, y and z, "
                f"both x and y or neither, zero, one or three r, got {self.symbols!r}"
            )

    @property
    def names(self) -> str:
        """Different characters for all numbers, ``u``, ``v`` and ``r`` for three r's."""
        rotations = iter(ROTATION_VECTOR if self.symbols.count("r") > 1 else "r")
        return "".join(next(rotations) if symbol == "r" else symbol for symbol in self.symbols)

    def __contains__(self, name: str) -> bool:
        return name in self.names

    def indices(self, names: str) -> list[int]:
        """Return the indices of the numbers with these names. Names that the action lacks are skipped."""
        return [self.names.index(name) for name in names if name in self.names]
