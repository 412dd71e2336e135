"""Pieces of Markdown."""

from collections.abc import Iterable, Sequence


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table; a head that ends in a colon aligns its column to the right."""
    rule = ["---:" if name.endswith(":") else "---" for name in head]
    lines = [[name.rstrip(":") for name in head], rule, *rows]
    return "\n".join("| " + " | ".join(_cell(cell) for cell in line) + " |" for line in lines) + "\n"


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
