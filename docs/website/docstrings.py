"""What docstrings say, in pieces."""

import inspect
import re
from typing import Any

LABELS = ("Description", "Randomisation", "Success", "Validity", "Expert")
"""What the docstring of a task tells, in this order."""
LABEL = re.compile(rf"^({'|'.join(LABELS)}): ", re.MULTILINE)
FIELD = re.compile(r"^:param (\w+): (.*?)(?=^:|\Z)", re.MULTILINE | re.DOTALL)
ROLE = re.compile(r":\w+:`~?([\w.]+)`")


def parameters(item: Any) -> dict[str, str]:
    """Return what a docstring says of each parameter."""
    return {name: one_line(text) for name, text in FIELD.findall(inspect.cleandoc(item.__doc__ or ""))}


def one_line(text: str) -> str:
    """Return text in one line of Markdown: roles and double ticks become code."""
    text = ROLE.sub(lambda match: f"`{match[1].rpartition('.')[2]}`", " ".join(text.split()))
    return text.replace("``", "`")
