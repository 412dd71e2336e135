"""Tables of trained agents, where pages ask for them: ``<!-- agents: sacfd, equi_sacfd -->``."""

import re
from fnmatch import fnmatchcase

from website import measured
from website.markdown import table

MARK = re.compile(r"<!-- agents: ([\w*, ]+) -->")


def filled(markdown: str) -> str:
    """Return a page with tables of the agents in the place of its marks.

    A mark names baselines, ``*`` stands for any characters.
    """
    return MARK.sub(lambda match: _table(match[1].split(", ")), markdown)


def _table(patterns: list[str]) -> str:
    rows = [
        [
            f"[{measured.bare(card['env'])}](../tasks/{measured.bare(card['env'])}.md#trained-agents)",
            f"`{card['baseline']}`",
            f"`{card['preset']}`",
            measured.percent(card["success"]),
            " to ".join(map(measured.percent, card["interval"])),
            str(card["episodes"]),
        ]
        for card in measured.cards()
        if any(fnmatchcase(card["baseline"], pattern) for pattern in patterns)
    ]
    head = ["task", "baseline", "preset", "success:", "interval:", "episodes:"]
    return "Agents to load:\n\n" + table(head, rows) if rows else ""
