"""Tables in the terminal and in Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

UNLIMITED = 1000  # characters, wider than any table of numbers


def print_table(
    columns: Sequence[str], rows: Sequence[Sequence[str]], markdown: bool = False, wrap: bool = False
) -> None:
    """
    Print a table.

    :param columns: Heads of the columns
    :param rows: One cell a column
    :param markdown: Whether to print Markdown
    :param wrap: Whether cells are text, aligned left and wrapped to the terminal's width, not numbers
    """
    if markdown:
        print(markdown_table(columns, rows, "---" if wrap else "---:"))
        return
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
    """
    Write a table for a Markdown page.

    :param columns: Heads of the columns
    :param rows: One cell a column
    :param rule: What aligns the other columns: by default to the right, as numbers
    :param text_columns: How many columns from the left are text
    :return: Its lines
    """
    rules = ["---"] * text_columns + [rule] * (len(columns) - text_columns)
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (columns, rules, *rows))
