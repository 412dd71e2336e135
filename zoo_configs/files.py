"""Files that are written atomically, and YAML 1.2: ``1e-3`` is a number, ``no`` and ``12:30`` are text."""

import contextlib
import os
import re
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml
from yaml.constructor import ConstructorError

from zoo_configs.errors import CommandError, refused


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Provide a temporary file, with the same suffix, that replaces ``path`` if the block succeeds."""
    partial = path.with_name(f".{uuid.uuid4().hex}{path.suffix}")  # short, as a long name can be the limit
    with made_folder(path.parent):
        try:
            yield partial
            os.replace(partial, path)
        except OSError as error:
            error.filename = error.filename or str(path)  # the error of a full disk has no file name
            raise
        finally:
            partial.unlink(missing_ok=True)


@contextmanager
def made_folder(path: Path) -> Iterator[None]:
    """Create a folder with its parents, and remove those that are empty after the block."""
    created = [folder for folder in (path, *path.parents) if not folder.exists()]
    path.mkdir(parents=True, exist_ok=True)
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # not empty, so neither are its parents
            for folder in created:
                folder.rmdir()


def check_writable(path: Path, name: str) -> None:
    """Raise ``CommandError`` if a file cannot be written; ``name`` is the argument that it comes from."""
    if path.is_dir():
        raise CommandError(f"{name} must be a file, got the folder {path}")
    folder = next(parent for parent in path.absolute().parents if parent.exists())
    try:
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise CommandError(f"{name}: {path} cannot be written: {error.strerror}") from error


def print_written(*paths: Path) -> None:
    """Print the files that a command has written."""
    print("\n".join(["Written:", *(f"  {path}" for path in paths)]))


SCALARS = {
    "null": (r"~|null|Null|NULL|None|", "~nN"),
    "bool": (r"true|True|TRUE|false|False|FALSE", "tTfF"),
    "int": (r"[-+]?[0-9]+(_[0-9]+)*", "-+0123456789"),  # 1_000 in files of rl_zoo3
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

    def compose_mapping_node(self, anchor: Any) -> Any:
        """Compose a mapping; raise ``yaml.YAMLError`` for a repeated key, whose first value would be lost."""
        node = super().compose_mapping_node(anchor)
        keys = [(key.tag, key.value) for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        if twice := sorted({name for tag, name in keys if keys.count((tag, name)) > 1}):
            where = node.start_mark
            raise ConstructorError(None, None, f"each key must be there once, got {', '.join(twice)}", where)
        return node


Loader.add_constructor("tag:yaml.org,2002:int", lambda _, node: int(node.value))  # 010 is 10, not octal


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
    """Return the plain data of a YAML document; raise ``yaml.YAMLError`` if it is not valid."""
    return yaml.load(text, Loader)  # a subclass of SafeLoader


def read_yaml(path: Path, name: str = "") -> Any:
    """Read a YAML file; raise ``CommandError``, with the name of the argument, if it is not valid."""
    with refused(f"{name}: {path} cannot be read".removeprefix(": ")):
        return parse_yaml(path.read_text(encoding="utf-8"))


def format_yaml(value: Any, inline: bool = False) -> str:
    """Format plain data as YAML, in one line if ``inline``, without a line break at its end."""
    style: dict[str, Any] = {"default_flow_style": True, "width": float("inf")} if inline else {}
    text: str = yaml.dump(value, Dumper=Dumper, sort_keys=False, allow_unicode=True, **style)
    return text.removesuffix("\n...\n").rstrip("\n")


def write_yaml(path: Path, value: Any, comment: str = "") -> None:
    """Write plain data to a YAML file atomically, after a comment as its first line."""
    with whole_file(path) as partial:
        header = f"# {comment}\n" if comment else ""
        partial.write_text(f"{header}{format_yaml(value)}\n", encoding="utf-8")
