"""YAML as in version 1.2: ``1e-3`` is a number, ``no`` and ``12:30`` are text."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from zoo_configs.errors import refused
from zoo_configs.files import whole_file

SCALARS = {
    "null": (r"~|null|Null|NULL|None|", "~nN"),
    "bool": (r"true|True|TRUE|false|False|FALSE", "tTfF"),
    "int": (r"[-+]?[0-9]+", "-+0123456789"),
    "float": (
        r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        "-+0123456789.",
    ),
    "merge": (r"<<", "<"),
}
"""Plain scalars that are not text: pattern and first characters by tag. ``None`` is null as in Python."""


class Loader(yaml.SafeLoader):
    """Loader of plain data with the scalars of YAML 1.2."""

    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012


class Dumper(yaml.SafeDumper):
    """Dumper of plain data that quotes text which a reader of YAML 1.1 or 1.2 would not read as text."""

    def ignore_aliases(self, data: Any) -> bool:
        """Repeat equal values instead of referring to them."""
        return True


for _tag, (_pattern, _first) in SCALARS.items():
    for _class in (Loader, Dumper):
        _characters = [*_first, ""] if _tag == "null" else [*_first]
        _class.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(f"(?:{_pattern})$"), _characters)


def parse_yaml(text: str) -> Any:
    """
    Parse a YAML document.

    :param text: The document
    :return: Plain data
    :raises yaml.YAMLError: if it is not valid
    """
    return yaml.load(text, Loader)  # a subclass of SafeLoader


def read_yaml(path: Path, name: str = "") -> Any:
    """
    Read a YAML file.

    :param path: The file
    :param name: Name of the argument in the error
    :return: Plain data
    :raises CommandError: if the file is not valid YAML
    """
    with refused(f"{name}: {path} cannot be read".removeprefix(": ")):
        return parse_yaml(path.read_text(encoding="utf-8"))


def format_yaml(value: Any, inline: bool = False) -> str:
    """
    Format plain data as YAML.

    :param value: The data
    :param inline: Whether to write it in one line
    :return: The text, without a line break at its end
    """
    style: dict[str, Any] = {"default_flow_style": True, "width": float("inf")} if inline else {}
    text: str = yaml.dump(value, Dumper=Dumper, sort_keys=False, allow_unicode=True, **style)
    return text.removesuffix("\n...\n").rstrip("\n")


def write_yaml(path: Path, value: Any, comment: str = "") -> None:
    """
    Write a YAML file atomically.

    :param path: The file
    :param value: Plain data
    :param comment: First line of the file
    """
    with whole_file(path) as partial:
        header = f"# {comment}\n" if comment else ""
        partial.write_text(f"{header}{format_yaml(value)}\n", encoding="utf-8")
