"""Functions that return Markdown."""

from collections.abc import Iterable, Sequence

from zoo_configs.drawing.tables import markdown_table


def table(head: Sequence[str], rows: Iterable[Sequence[str]], numbers: int = 0) -> str:
    """Return a table.

    :param numbers: number of columns, from the right, that hold numbers
    """
    cells = [[_cell(cell) for cell in row] for row in rows]
    return markdown_table(head, cells, text_columns=len(head) - numbers) + "\n"


def section(title: str, *parts: str) -> str:
    """Return a section, or an empty text if all parts are empty."""
    texts = [part.strip() for part in parts if part.strip()]
    return f"## {title}\n\n" + "\n\n".join(texts) + "\n\n" if texts else ""


def image(path: str, alt: str, kind: str) -> str:
    """Return an image that is loaded when it becomes visible.

    :param path: relative to the page
    :param kind: class in the style sheet
    """
    return f"![{alt}]({path}){{ .{kind} loading=lazy }}"


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")
