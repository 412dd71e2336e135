"""What was measured of an environment, for its page: expert, speed, trained agents."""

from collections.abc import Iterable, Sequence
from typing import Any

from website import measured
from website.markdown import picture, table
from website.measured import Row

ARMS = {"kuka": "KUKA", "panda": "Panda", "ur5": "UR5, jaw", "ur5_robotiq": "UR5, 2F-85"}
"""Names of the arms, in the order of the tables."""
EXPERT = "Success and mean length of the expert, which knows the scene (`env.unwrapped.expert_action()`)."
HEAD = ["arm", "parameters", "success", "steps", "episodes"]
HOW = '??? info "How this was measured"'
MEDIA = ((".gif", "film"), ("-curve.png", "curve"))
"""Endings of an agent's pictures, and what they show."""


def expert(name: str) -> Sequence[str]:
    """Return success and length on each arm that was measured.

    :param name: of the environment, without namespace and version
    """
    rows = [row for row in measured.rows("experts", name) if not row.get("snap")]
    found = sorted(rows, key=lambda row: list(ARMS).index(row["robot"]))
    if not found:
        return []
    cells = [_on_arm(row) for row in found]
    return [EXPERT, table(HEAD, cells, numbers=3), *_measurements(found)]


def speed(name: str) -> Sequence[str]:
    """Return steps a second."""
    found = measured.rows("speed", name)
    return [*map(_rate, found), *_measurements(found)]


def agents(name: str) -> Sequence[str]:
    """Return the trained agents with their curves and films."""
    return [_agent(card) for card in measured.cards() if measured.bare(card["env"]) == name]


def _on_arm(row: Row) -> list[str]:
    """Return arm, parameters that were not the default, success, steps, episodes."""
    steps = f"{float(row['mean_steps']):.1f}" if row["mean_steps"] else ""
    changed = f"`{row['env_kwargs']}`" if row.get("env_kwargs") else ""
    success = measured.share(row["success"], row["episodes"])
    return [ARMS[row["robot"]], changed, success, steps, row["episodes"]]


def _rate(row: Row) -> str:
    rate = f"**{float(row['steps_per_second']):,.0f} steps a second** in one process, the expert acting"
    times = row["times_reference"]
    return rate + (f", {float(times):.1f} times the original release's." if times else ".")


def _agent(card: dict[str, Any]) -> str:
    success, low, high = (
        measured.share(value, card["episodes"]) for value in (card["success"], *card["interval"])
    )
    baseline, name = card["baseline"], measured.bare(card["env"])
    told = (
        f"Preset `{card['preset']}`, seed {card['seed']}: success **{success}** "
        f"over {card['episodes']} episodes ({low} to {high})."
    )
    enjoy = f"    bulletarm-zoo enjoy --published {card['env']} --baseline {baseline}"
    how = {key: str(card.get(key, "")) for key in ("command", "machine", "date", "commit")}
    return "\n\n".join([f"### {baseline}", told, *_media(card, name), enjoy, *_measurements([how])])


def _media(card: dict[str, Any], name: str) -> Sequence[str]:
    stem = f"{card['folder']}-{card['baseline']}"
    return [
        picture(f"../images/agents/{stem}{ending}", f"{name}, {card['baseline']}: {what}", what)
        for ending, what in MEDIA
        if (measured.ROOT / "docs" / "images" / "agents" / f"{stem}{ending}").exists()
    ]


def _measurements(found: Iterable[Row]) -> Sequence[str]:
    """Return how figures came about, each way once, folded."""
    ways = dict.fromkeys(
        f"`{row['command']}`<br>{row['machine']}, {row['date']}, commit {row['commit']}" for row in found
    )
    return [HOW + "".join(f"\n\n    {way}" for way in ways)] if ways else []
