"""Tables of trained agents at marks in pages: ``<!-- agents: sacfd, equi_sacfd -->``."""

import re
from fnmatch import fnmatchcase
from typing import Any

from website import measured
from website.markdown import table

HEAD = ["task", "baseline", "preset", "success", "interval", "episodes"]
MARK = re.compile(r"<!-- agents: ([\w*, ]+) -->")


def filled(markdown: str) -> str:
    """Return a page with tables of the agents instead of its marks.

    A mark lists names of baselines, in which ``*`` matches any characters.
    """
    return MARK.sub(lambda match: _table(match[1].split(", ")), markdown)


def _table(patterns: list[str]) -> str:
    rows = [
        _row(card)
        for card in measured.cards()
        if any(fnmatchcase(card["baseline"], pattern) for pattern in patterns)
    ]
    return "Agents to load:\n\n" + table(HEAD, rows, numbers=3) if rows else ""


def _row(card: dict[str, Any]) -> list[str]:
    name, episodes = measured.bare(card["env"]), card["episodes"]
    success, low, high = (measured.share(value, episodes) for value in (card["success"], *card["interval"]))
    page = f"[{name}](../tasks/{name}.md#trained-agents)"
    return [page, f"`{card['baseline']}`", f"`{card['preset']}`", success, f"{low} to {high}", str(episodes)]
