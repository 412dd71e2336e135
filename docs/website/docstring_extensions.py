"""What Griffe, which reads the code for the API pages, has to be told of our docstrings."""

import re
from typing import Any

import griffe

from website.docstrings import LABEL

ROLE = re.compile(r":(?:attr|class|data|exc|func|meth|mod):`(~?)([\w.]+)`")


class NamedTuples(griffe.Extension):
    """Gives named tuples the constructor that their docstrings tell the parameters of."""

    def on_class(self, *, cls: griffe.Class, **_: Any) -> None:
        """Add the constructor."""
        if not any(str(base).endswith("NamedTuple") for base in cls.bases):
            return
        kind = griffe.ParameterKind.positional_or_keyword
        told = [griffe.Parameter("self", kind=kind)]
        told += [
            griffe.Parameter(name, kind=kind, annotation=item.annotation, default=item.value)
            for name, item in cls.attributes.items()
            if item.annotation is not None and "property" not in item.labels
        ]
        cls.set_member(
            "__init__", griffe.Function("__init__", parameters=griffe.Parameters(*told), parent=cls)
        )


class Markup(griffe.Extension):
    """Makes links of the roles in a package's docstrings, ``:class:`Name```, which Markdown does not know.

    What has a heading of its own becomes a link, the rest code. What a task tells under a label becomes a
    paragraph.
    """

    def on_package(self, *, pkg: griffe.Module, **_: Any) -> None:
        """Rewrite the docstrings of a package."""
        self._rewrite(pkg)

    def _rewrite(self, item: griffe.Object) -> None:
        if item.docstring is not None:
            told = LABEL.sub(r"\n**\1:** ", item.docstring.value)
            item.docstring.value = ROLE.sub(lambda match: _link(item, *match.groups()), told)
        for member in item.members.values():
            if isinstance(member, griffe.Object):  # what is imported is rewritten where it stands
                self._rewrite(member)


def _link(item: griffe.Object, short: str, name: str) -> str:
    shown = name.rpartition(".")[2] if short else name
    target = _find(item, name)
    return f"[`{shown}`][{target}]" if target else f"`{shown}`"


def _find(item: griffe.Object, name: str) -> str | None:
    """Return the path under which something has a heading; None if it has none."""
    try:
        found = item.modules_collection[_path(item, name)]
        found = found.final_target if isinstance(found, griffe.Alias) else found
    except (KeyError, griffe.AliasResolutionError, griffe.NameResolutionError):
        return None
    has_heading = all(part.docstring and not part.is_private for part in (found, *_parents(found)))
    return str(found.path) if has_heading else None


def _path(item: griffe.Object, name: str) -> str:
    first, dot, rest = name.partition(".")
    if first in item.modules_collection.members:
        return name
    return item.resolve(first) + dot + rest


def _parents(item: griffe.Object) -> list[griffe.Object]:
    return [] if item.parent is None else [item.parent, *_parents(item.parent)]
