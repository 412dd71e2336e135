"""Pieces of Markdown."""

from collections.abc import Iterable, Sequence

from zoo_configs.drawing.tables import markdown_table


def table(head: Sequence[str], rows: Iterable[Sequence[str]], numbers: int = 0) -> str:
    """Return a table.

    :param numbers: how many columns from the right hold numbers
    """
    cells = [[_cell(cell) for cell in row] for row in rows]
    return markdown_table(head, cells, text_columns=len(head) - numbers) + "\n"


def section(title: str, *parts: str) -> str:
    """Return a section, nothing if all of its parts are empty."""
    told = [part.strip() for part in parts if part.strip()]
    return f"## {title}\n\n" + "\n\n".join(told) + "\n\n" if told else ""


def picture(path: str, alt: str, kind: str) -> str:
    """Return a picture that is loaded when it is scrolled to.

    :param path: relative to the page
    :param kind: its class in the style sheet
    """
    return f"![{alt}]({path}){{ .{kind} loading=lazy }}"


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")
