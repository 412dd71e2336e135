"""Which number of an action is what: the names that environments give to the numbers of their actions."""

from __future__ import annotations

from dataclasses import dataclass

ACTION_SYMBOLS = "pxyzr"


@dataclass(frozen=True)
class ActionSequence:
    """
    The numbers of an action by one character each: ``p`` (gripper), ``x``, ``y``, ``z`` (translation) and
    ``r`` (rotation about z).

    :param symbols: each of ``pxyzr`` at most once, in any order; x and y together or neither
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
        elif len(set(self.symbols)) < len(self.symbols):
            problem = "repeats a character"
        elif ("x" in self.symbols) != ("y" in self.symbols):
            problem = "needs both x and y, or neither"
        if problem is not None:
            raise ValueError(f"action_sequence={self.symbols!r} {problem}")

    def __contains__(self, symbol: str) -> bool:
        return symbol in self.symbols

    def places(self, symbols: str) -> list[int]:
        """
        Where numbers stand in the action.

        :param symbols: their names, in any order
        :return: an index for each of them that the action has
        """
        return [self.symbols.index(symbol) for symbol in symbols if symbol in self.symbols]
