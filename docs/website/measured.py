"""Measurements of environments: tables in ``docs/data``, and the cards of the trained agents."""

import csv
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT / "docs" / "data"
AGENTS = ROOT / "zoo_configs" / "published"
MANY = 100
"""Number of episodes above which success rates have three digits."""
Row = dict[str, str]


def rows(table: str, env: str) -> list[Row]:
    """Return the rows of a table for an environment.

    :param table: name of the file in ``docs/data``, without its ending
    :param env: id without namespace and version
    :return: rows, empty if the table does not exist
    """
    return [row for row in _table(DATA / f"{table}.csv") if row["env"] == env]


def cards() -> Iterator[dict[str, Any]]:
    """Yield the cards of all trained agents, each with the name of its ``folder``."""
    for path in sorted(AGENTS.glob("*/*/card.json")):
        card = json.loads(path.read_text(encoding="utf-8"))
        yield {**card, "folder": path.parent.parent.name}


def bare(env_id: str) -> str:
    """Return an id without namespace and version."""
    return env_id.rpartition("/")[2].removesuffix("-v0")


def share(value: float | str, episodes: int | str) -> str:
    """Return a success rate with two digits, or three if there are many episodes."""
    return f"{float(value):.{3 if int(episodes) > MANY else 2}f}"


def _table(path: Path) -> list[Row]:
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))
