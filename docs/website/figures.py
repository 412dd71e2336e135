"""Measurements of an environment for its page: expert, speed, trained agents."""

from collections.abc import Iterable, Sequence
from typing import Any

from website import measured
from website.markdown import image, table
from website.measured import Row

ARMS = {"kuka": "KUKA", "panda": "Panda", "ur5": "UR5, jaw", "ur5_robotiq": "UR5, 2F-85"}
"""Names of the arms, in the order of the tables."""
EXPERT = "Success rate and mean number of steps of the expert, which uses the poses of all objects."
HEAD = ["arm", "parameters", "success", "steps", "episodes"]
HOW = '??? info "How this was measured"'
RENAMED = {
    "bulletarm-zoo check ": "python tools/measure_experts.py --env ",
    "bulletarm-zoo speed ": "python tools/measure_speed.py ",
    " --reference": " --reference docs/data/reference_rates.csv",
}
"""Present commands for earlier ones in the data."""
MEDIA = ((".gif", "video"), ("-curve.png", "curve"))
"""Endings of the image files of an agent, and their content."""


def expert(name: str) -> Sequence[str]:
    """Return the success rate and the episode length on each measured arm.

    :param name: of the environment, without namespace and version
    """
    rows = [row for row in measured.rows("experts", name) if not row.get("snap")]
    found = sorted(rows, key=lambda row: list(ARMS).index(row["robot"]))
    if not found:
        return []
    cells = [_on_arm(row) for row in found]
    return [EXPERT, table(HEAD, cells, numbers=3), *_measurements(found)]


def speed(name: str) -> Sequence[str]:
    """Return the number of steps per second."""
    found = measured.rows("speed", name)
    return [*map(_rate, found), *_measurements(found)]


def agents(name: str) -> Sequence[str]:
    """Return the trained agents with their learning curves and videos."""
    return [_agent(card) for card in measured.cards() if measured.bare(card["env"]) == name]


def _on_arm(row: Row) -> list[str]:
    """Return the arm, the changed parameters, success rate, steps and episodes."""
    steps = f"{float(row['mean_steps']):.1f}" if row["mean_steps"] else ""
    changed = f"`{row['env_kwargs']}`" if row.get("env_kwargs") else ""
    success = measured.share(row["success"], row["episodes"])
    return [ARMS[row["robot"]], changed, success, steps, row["episodes"]]


def _rate(row: Row) -> str:
    figure = f"{float(row['steps_per_second']):,.0f}"
    rate = f"**{figure} steps per second** in one process with the actions of the expert"
    times = row["times_reference"]
    return rate + (f", {float(times):.1f} times the speed of the original release." if times else ".")


def _agent(card: dict[str, Any]) -> str:
    success, low, high = (
        measured.share(value, card["episodes"]) for value in (card["success"], *card["interval"])
    )
    baseline, name = card["baseline"], measured.bare(card["env"])
    summary = (
        f"Preset `{card['preset']}`, seed {card['seed']}: success rate **{success}** "
        f"in {card['episodes']} episodes (95 % interval {low} to {high})."
    )
    enjoy = f"    bulletarm-zoo enjoy --published {card['env']} --baseline {baseline}"
    how = {key: str(card.get(key, "")) for key in ("command", "machine", "date", "commit")}
    return "\n\n".join([f"### {baseline}", summary, *_media(card, name), enjoy, *_measurements([how])])


def _media(card: dict[str, Any], name: str) -> Sequence[str]:
    stem = f"{card['folder']}-{card['baseline']}"
    return [
        image(f"../images/agents/{stem}{ending}", f"{name}, {card['baseline']}: {what}", what)
        for ending, what in MEDIA
        if (measured.ROOT / "docs" / "images" / "agents" / f"{stem}{ending}").exists()
    ]


def _measurements(found: Iterable[Row]) -> Sequence[str]:
    """Return the commands, machines and dates of figures in a fold, each once."""
    sources = dict.fromkeys(
        f"`{_command(row)}`<br>{row['machine']}, {row['date']}, commit {row['commit']}" for row in found
    )
    return [HOW + "".join(f"\n\n    {source}" for source in sources)] if sources else []


def _command(row: Row) -> str:
    command = row["command"]
    for earlier, present in RENAMED.items():
        command = command.replace(earlier, present)
    return command
