"""What MkDocs and Griffe call."""

import subprocess
from pathlib import Path

import griffe
import pytest

import bulletarm_gym
from website import hooks
from website.docstring_extensions import Markup, NamedTuples

MODULE = '''"""A module."""

from typing import NamedTuple


class Shape(NamedTuple):
    """A shape, as :func:`draw` draws it, by :class:`_Pen` and :class:`~numpy.ndarray`.

    :param width: how wide (m)
    """

    width: float
    height: float = 1.0

    @property
    def area(self) -> float:
        """Its area (m^2), of a :class:`~shapes.Shape`."""
        return self.width * self.height


class _Pen:
    """A pen.

    Description: it is
    blue.
    Success: it draws.
    """


def draw() -> None:
    """Draw."""
'''


@pytest.fixture
def shapes(tmp_path: Path) -> griffe.Object:
    (tmp_path / "shapes.py").write_text(MODULE)
    extensions = griffe.load_extensions(NamedTuples(), Markup())
    module = griffe.load("shapes", search_paths=[tmp_path], extensions=extensions)
    assert isinstance(module, griffe.Object)
    return module


def test_roles_become_links_where_there_is_a_heading(shapes: griffe.Object) -> None:
    told = shapes["Shape"].docstring.value
    assert told.startswith("A shape, as [`draw`][shapes.draw] draws it, by `_Pen` and `ndarray`.")
    assert "of a [`Shape`][shapes.Shape]." in shapes["Shape.area"].docstring.value


def test_what_a_task_tells_stands_in_paragraphs(shapes: griffe.Object) -> None:
    told = shapes["_Pen"].docstring.value
    assert told == "A pen.\n\n\n**Description:** it is\nblue.\n\n**Success:** it draws."


def test_named_tuples_have_a_constructor(shapes: griffe.Object) -> None:
    parameters = shapes["Shape"].parameters
    assert [parameter.name for parameter in parameters] == ["self", "width", "height"]
    assert str(parameters["width"].annotation) == "float" and str(parameters["height"].default) == "1.0"


def test_navigation_has_every_page() -> None:
    first, *groups = hooks.navigation()
    pages = [
        page for group in groups for entries in group.values() for entry in entries for page in entry.values()
    ]
    assert first == "tasks/index.md"
    assert sorted(pages) == sorted(
        f"tasks/{env_id.removeprefix('BulletArm/').removesuffix('-v0')}.md"
        for env_id in bulletarm_gym.ENV_IDS
    )


@pytest.mark.parametrize(
    ("origin", "address"),
    [
        ("git@example.org:someone/arms.git", "https://example.org/someone/arms"),
        ("https://example.org/someone/arms.git", "https://example.org/someone/arms"),
        ("https://token@example.org/someone/arms", None),
        ("/home/someone/arms", None),
    ],
)
def test_repository_is_what_was_cloned_if_public(
    origin: str, address: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hooks, "ROOT", tmp_path)
    for command in (["init", "--quiet"], ["remote", "add", "origin", origin]):
        subprocess.run(["git", "-C", str(tmp_path), *command], check=True)
    assert hooks.repository({}) == address
    assert hooks.repository({"urls": {"Repository": "https://example.org/x"}}) == "https://example.org/x"
