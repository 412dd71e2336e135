"""The environments in groups of similar tasks."""

import inspect
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from bulletarm_gym.registry import COMPOSED, ENVIRONMENTS, NAMESPACE, OWN, load
from bulletarm_gym.tasks import Task
from website.docstrings import LABEL, LABELS

GROUPS = {
    "Reach, pick, push, open": ("picking", "pushing", "drawer"),
    "Build": ("stacking",),
    "Pack and sort": ("packing", "palletizing", "covid", "sorting"),
    "Clutter": ("clutter",),
}
"""Headings of the gallery, and the modules of their tasks."""
CONTROL_NAMES = {"close_loop": "closed loop", "open_loop": "open loop"}
PREFIX = re.compile(r"^(OpenLoop|CloseLoop)(Ramp|Bump)?")
WORD = re.compile(r"(?<=[a-z])(?=[A-Z0-9])")


@dataclass(frozen=True)
class Shown:
    """An environment with a page.

    :param kwargs: names or import paths of its components
    """

    env_id: str
    kwargs: Mapping[str, Any]

    @property
    def name(self) -> str:
        """Id without namespace and version, the name of the page."""
        return self.env_id.removeprefix(f"{NAMESPACE}/").removesuffix("-v0")

    @property
    def image(self) -> str:
        """Prefix of the names of the image files."""
        return self.env_id.rpartition("/")[2]

    @property
    def stem(self) -> str:
        """Name of the task."""
        return PREFIX.sub("", self.name)

    @property
    def setting(self) -> str:
        """Control and surface in words; the flat surface is omitted."""
        surface = self.kwargs["surface"]
        return CONTROL_NAMES[self.kwargs["control"]] + ("" if surface == "flat" else f" on {surface}s")

    @property
    def title(self) -> str:
        """Name of the task in words."""
        return WORD.sub(" ", self.stem)

    @cached_property
    def task(self) -> type[Task]:
        """Class of the task."""
        return load(self.kwargs["task"])  # type: ignore[no-any-return]

    @property
    def group(self) -> str:
        """Heading in the gallery."""
        module = self.task.__module__.rpartition(".")[2]
        return next(heading for heading, modules in GROUPS.items() if module in modules)

    @property
    def origin(self) -> str:
        """Source of the task."""
        if self.env_id in OWN:
            return "not in the paper"
        if self.env_id in COMPOSED:
            return "a task of the paper with another control or surface"
        return "in the paper"

    @property
    def summary(self) -> str:
        """Goal of the task in one sentence."""
        return _clean(_docstring(self.task)[0].partition("\n\n")[0])

    @property
    def facts(self) -> dict[str, str]:
        """Labelled paragraphs of the docstring of the class; a base class provides missing ones."""
        found: dict[str, str] = {}
        for base in self.task.__mro__[: self.task.__mro__.index(Task)]:
            found = {**_labelled(base), **found}
        return {label: found[label] for label in LABELS if label in found}


SHOWN = tuple(Shown(env_id, kwargs) for env_id, kwargs in ENVIRONMENTS.items())
"""All environments, in the order of their table."""


def grouped() -> dict[str, list[Shown]]:
    """Return the environments by heading, the environments of one task next to each other."""
    groups: dict[str, list[Shown]] = {heading: [] for heading in GROUPS}
    for one in SHOWN:
        groups[one.group].append(one)
    return {heading: sorted(members, key=_order) for heading, members in groups.items()}


def relatives(one: Shown) -> Sequence[Shown]:
    """Return the other environments of the same task: with another control, surface or other defaults."""
    return [other for other in SHOWN if other != one and (other.stem == one.stem or other.task is one.task)]


def _order(one: Shown) -> tuple[int, int]:
    """Return the position of an environment, next to the other environments of its task."""
    stems = [other.stem for other in SHOWN]
    return stems.index(one.stem), SHOWN.index(one)


def _docstring(task: type[Any]) -> tuple[str, ...]:
    """Return the docstring of a class split at its labels: preceding text, label, text, label, ..."""
    return tuple(LABEL.split(inspect.cleandoc(task.__doc__ or "")))


def _labelled(task: type[Any]) -> dict[str, str]:
    _, *parts = _docstring(task)
    return {label: _text(text) for label, text in zip(parts[::2], parts[1::2], strict=True)}


def _text(text: str) -> str:
    """Return the text of a label, up to a blank line or a sentence on the rest of the class."""
    own = re.split(r"\n\n|\nEverything else is", text)[0]
    return _clean(own)


def _clean(text: str) -> str:
    """Return text with roles and double backticks replaced by Markdown code."""
    return re.sub(r":\w+:`~?([\w.]+)`|``([^`]+)``", _code, text).strip()


def _code(match: re.Match[str]) -> str:
    role, code = match.groups()
    return f"`{code or role.rpartition('.')[2]}`"
