"""Tables in the terminal and in Markdown."""

from collections.abc import Sequence
from typing import Literal

UNLIMITED = 1000  # characters, wider than any table of numbers


def print_table(columns: Sequence[str], rows: Sequence[Sequence[str]], wrap: bool = False) -> None:
    """Print a table; with ``wrap`` it has text, aligned left and wrapped to the width of the terminal."""
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for index, column in enumerate(columns):
        side: Literal["left", "right"] = "left" if wrap or index == 0 else "right"
        table.add_column(column, justify=side, no_wrap=index == 0, overflow="fold")
    for cells in rows:
        table.add_row(*cells)
    Console(width=None if wrap else UNLIMITED).print(table)


def markdown_table(
    columns: Sequence[str], rows: Sequence[Sequence[str]], rule: str = "---:", text_columns: int = 1
) -> str:
    """Return a Markdown table; ``rule`` aligns the columns after the first ``text_columns``."""
    rules = ["---"] * text_columns + [rule] * (len(columns) - text_columns)
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (columns, rules, *rows))
