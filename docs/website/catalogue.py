"""What there is to show: the environments, in groups of kindred tasks."""

import inspect
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from bulletarm_gym.registry import COMPOSED, ENTRIES, OWN, Entry, load
from bulletarm_gym.tasks import Task
from website.docstrings import LABEL, LABELS

GROUPS = {
    "Reach, pick, push, open": ("picking", "pushing", "drawer"),
    "Build": ("stacking",),
    "Pack and sort": ("packing", "palletizing", "covid", "sorting"),
    "Clutter": ("clutter",),
}
"""Headings of the gallery and the modules of their tasks."""
PREFIX = re.compile(r"^(OpenLoop|CloseLoop)(Ramp|Bump)?")
WORD = re.compile(r"(?<=[a-z])(?=[A-Z0-9])")


@dataclass(frozen=True)
class Shown:
    """An environment that has a page.

    :param entry: its line in the table of environments
    """

    entry: Entry

    @property
    def name(self) -> str:
        """Its id without namespace and version; its page is called so."""
        return self.entry.name

    @property
    def picture(self) -> str:
        """What the names of its pictures begin with."""
        return self.entry.env_id.rpartition("/")[2]

    @property
    def stem(self) -> str:
        """The task in its name."""
        return PREFIX.sub("", self.name)

    @property
    def setting(self) -> str:
        """Control and surface, in words; the flat floor is not named."""
        surface = "" if self.entry.surface == "flat" else f" on {self.entry.surface}s"
        return self.entry.control.replace("_", " ") + surface

    @property
    def title(self) -> str:
        """Its task in words."""
        return WORD.sub(" ", self.stem)

    @cached_property
    def task(self) -> type[Task]:
        """Its class."""
        return load(self.entry.task)  # type: ignore[no-any-return]

    @property
    def group(self) -> str:
        """The heading it stands under."""
        module = self.task.__module__.rpartition(".")[2]
        return next(heading for heading, modules in GROUPS.items() if module in modules)

    @property
    def origin(self) -> str:
        """Where the task comes from."""
        if self.entry in OWN:
            return "not in the paper"
        if self.entry in COMPOSED:
            return "a task of the paper under another control or on other ground"
        return "the paper"

    @property
    def summary(self) -> str:
        """What is to be done, in a sentence."""
        return _clean(_docstring(self.task)[0].partition("\n\n")[0])

    @property
    def facts(self) -> dict[str, str]:
        """What the docstring of its class tells under a label; where it tells nothing, that of its base."""
        found: dict[str, str] = {}
        for base in self.task.__mro__[: self.task.__mro__.index(Task)]:
            found = {**_labelled(base), **found}
        return {label: found[label] for label in LABELS if label in found}


SHOWN = tuple(map(Shown, ENTRIES))
"""All environments, in the order of their table."""


def grouped() -> dict[str, list[Shown]]:
    """Return the environments under their headings, those of one task side by side."""
    groups: dict[str, list[Shown]] = {heading: [] for heading in GROUPS}
    for one in SHOWN:
        groups[one.group].append(one)
    return {heading: sorted(members, key=_order) for heading, members in groups.items()}


def relatives(one: Shown) -> Sequence[Shown]:
    """Return the environments of the same task: another control, other ground or other defaults."""
    return [other for other in SHOWN if other != one and (other.stem == one.stem or other.task is one.task)]


def _order(one: Shown) -> tuple[int, int]:
    """Tasks in the order of the table, each with all its environments."""
    stems = [other.stem for other in SHOWN]
    return stems.index(one.stem), SHOWN.index(one)


def _docstring(task: type[Any]) -> tuple[str, ...]:
    """Return the docstring of a class, split at its labels: what precedes them, label, text, label ..."""
    return tuple(LABEL.split(inspect.cleandoc(task.__doc__ or "")))


def _labelled(task: type[Any]) -> dict[str, str]:
    _, *parts = _docstring(task)
    return {label: _text(text) for label, text in zip(parts[::2], parts[1::2], strict=True)}


def _text(text: str) -> str:
    """Return the lines up to the next thing that is told, such as what all else is like."""
    own = re.split(r"\n\n|\nEverything else is", text)[0]
    return _clean(own)


def _clean(text: str) -> str:
    """Return text without roles, in Markdown's code."""
    return re.sub(r":\w+:`~?([\w.]+)`|``([^`]+)``", _code, text).strip()


def _code(match: re.Match[str]) -> str:
    role, code = match.groups()
    return f"`{code or role.rpartition('.')[2]}`"
