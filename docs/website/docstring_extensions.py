"""Extensions of Griffe for the docstrings of this project, for the pages of the API."""

import re
from typing import Any

import griffe

from website.docstrings import LABEL

ROLE = re.compile(r":(?:attr|class|data|exc|func|meth|mod):`(~?)([\w.]+)`")


class NamedTuples(griffe.Extension):
    """Adds constructors to named tuples, whose docstrings document the parameters."""

    def on_class(self, *, cls: griffe.Class, **_: Any) -> None:
        """Add the constructor."""
        if not any(str(base).endswith("NamedTuple") for base in cls.bases):
            return
        kind = griffe.ParameterKind.positional_or_keyword
        parameters = [griffe.Parameter("self", kind=kind)]
        parameters += [
            griffe.Parameter(name, kind=kind, annotation=item.annotation, default=item.value)
            for name, item in cls.attributes.items()
            if item.annotation is not None and "property" not in item.labels
        ]
        cls.set_member(
            "__init__", griffe.Function("__init__", parameters=griffe.Parameters(*parameters), parent=cls)
        )


class Markup(griffe.Extension):
    """Replaces the roles in docstrings, such as ``:class:`Name```, which are not Markdown.

    A role becomes a link if its target is on a page, else code. The text of a label in the docstring of a
    task becomes a paragraph.
    """

    def on_package(self, *, pkg: griffe.Module, **_: Any) -> None:
        """Rewrite the docstrings of a package."""
        self._rewrite(pkg)

    def _rewrite(self, item: griffe.Object) -> None:
        if item.docstring is not None:
            text = LABEL.sub(r"\n**\1:** ", item.docstring.value)
            item.docstring.value = ROLE.sub(lambda match: _link(item, *match.groups()), text)
        for member in item.members.values():
            if isinstance(member, griffe.Object):  # imported names are rewritten in their own module
                self._rewrite(member)


def _link(item: griffe.Object, short: str, name: str) -> str:
    """Return a link that is code only if no page has the object."""
    shown = name.rpartition(".")[2] if short else name
    target = _find(item, name)
    return f'<autoref optional identifier="{target}">`{shown}`</autoref>' if target else f"`{shown}`"


def _find(item: griffe.Object, name: str) -> str | None:
    """Return the path of an object of the packages, else None."""
    try:
        found = item.modules_collection[_path(item, name)]
        found = found.final_target if isinstance(found, griffe.Alias) else found
    except (KeyError, griffe.AliasResolutionError, griffe.NameResolutionError):
        return None
    return str(found.path)


def _path(item: griffe.Object, name: str) -> str:
    first, dot, rest = name.partition(".")
    if first in item.modules_collection.members:
        return name
    return item.resolve(first) + dot + rest
