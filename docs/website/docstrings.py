"""Parts of docstrings."""

import inspect
import re
from typing import Any

LABELS = ("Description", "Randomisation", "Success", "Validity", "Expert")
"""Labels in the docstring of a task, in this order."""
LABEL = re.compile(rf"^({'|'.join(LABELS)}): ", re.MULTILINE)
FIELD = re.compile(r"^:param (\w+): (.*?)(?=^:|\Z)", re.MULTILINE | re.DOTALL)
ROLE = re.compile(r":\w+:`~?([\w.]+)`")


def parameters(item: Any) -> dict[str, str]:
    """Return the description of each parameter in a docstring."""
    return {name: one_line(text) for name, text in FIELD.findall(inspect.cleandoc(item.__doc__ or ""))}


def one_line(text: str) -> str:
    """Return text as one line of Markdown, with roles and double backticks replaced by code."""
    text = ROLE.sub(lambda match: f"`{match[1].rpartition('.')[2]}`", " ".join(text.split()))
    return text.replace("``", "`")
