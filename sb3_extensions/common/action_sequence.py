"""Which number of an action is what: the names that environments give to the numbers of their actions."""

from __future__ import annotations

from dataclasses import dataclass

ACTION_SYMBOLS = "pxyzr"
# What three r's are, in their order: turns about the world's x and y axes, and r about z.
TURNS = "uvr"


@dataclass(frozen=True)
class ActionSequence:
    """
    The numbers of an action by one character each: ``p`` (gripper), ``x``, ``y``, ``z`` (translation) and
    ``r`` (rotation about z). Three r's are a rotation vector, the turns about the world's x, y and z axes.

    :param symbols: each of ``pxyz`` at most once, no, one or three ``r``, in any order; x and y together or
        neither
    :param action_dim: length of an action
    :raises ValueError: if the symbols are of another number, unknown or repeated, or only one of x and y
    """

    symbols: str
    action_dim: int

    def __post_init__(self) -> None:
        problem = None
        if len(self.symbols) != self.action_dim:
            problem = f"names {len(self.symbols)} numbers, but the action space has {self.action_dim}"
        elif unknown := sorted(set(self.symbols) - set(ACTION_SYMBOLS)):
            problem = f"contains {''.join(unknown)!r}; it may contain the characters of {ACTION_SYMBOLS!r}"
        elif any(self.symbols.count(symbol) > 1 for symbol in "pxyz"):
            problem = "repeats a character"
        elif self.symbols.count("r") not in (0, 1, 3):
            problem = "needs one r or three, or none"
        elif ("x" in self.symbols) != ("y" in self.symbols):
            problem = "needs both x and y, or neither"
        if problem is not None:
            raise ValueError(f"action_sequence={self.symbols!r} {problem}")

    @property
    def names(self) -> str:
        """A character of its own for each number: of three r's the first is ``u``, the second ``v``."""
        turns = iter(TURNS if self.symbols.count("r") > 1 else "r")
        return "".join(next(turns) if symbol == "r" else symbol for symbol in self.symbols)

    def __contains__(self, name: str) -> bool:
        return name in self.names

    def places(self, names: str) -> list[int]:
        """
        Where numbers stand in the action.

        :param names: their names, in any order
        :return: an index for each of them that the action has
        """
        return [self.names.index(name) for name in names if name in self.names]
