"""The page of a task, made from its class and from the environment."""

import inspect
from collections.abc import Iterable, Sequence
from typing import Any

import gymnasium
from gymnasium import spaces

from bulletarm_gym.config import EnvConfig, accepted
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.robots import ROBOTS
from bulletarm_gym.sensors import SENSORS
from website import actions, measured
from website.catalogue import Shown, relatives
from website.docstrings import parameters, sentence
from website.markdown import picture, section, table

ARMS = {"kuka": "KUKA", "panda": "Panda", "ur5": "UR5, jaw", "ur5_robotiq": "UR5, 2F-85"}
"""Names of the arms, in the order of the tables."""


def page(one: Shown) -> str:
    """Return the Markdown of the page of an environment."""
    env = gymnasium.make(one.entry.env_id)
    base: ManipulationEnv = env.unwrapped  # type: ignore[assignment]
    text = "".join(_parts(one, base))
    env.close()
    return text


def _parts(one: Shown, env: ManipulationEnv) -> Iterable[str]:
    yield f"---\ntitle: {one.title}, {one.setting}\ndescription: {one.summary}\n---\n\n# {one.name}\n\n"
    yield f"{one.summary}\n\n" + _pictures(one, "", "at reset and solved") + "\n"
    yield _identity(one, env) + "\n" + _snippet(one)
    yield section("Task", *(f"**{label}:** {text}" for label, text in one.facts.items()))
    seen = "What the agent sees at reset and at the end; bright is high" + (
        "." if one.entry.control == "open_loop" else " in value, that is far from the gripper."
    )
    yield section("Observation", _observation(env), _pictures(one, "-heightmap", "the heightmap at both"), seen)
    yield section("Action", *actions.describe(env))
    yield section("Parameters", _parameters(env))
    yield section("Expert", *_expert(one))
    yield section("Speed", *_speed(one))
    yield section("Trained agents", *(_agent(one, card) for card in _cards(one)))


def _pictures(one: Shown, suffix: str, what: str) -> str:
    path = f"../images/tasks/{one.picture}{suffix}.webp"
    return picture(path, f"{one.name}: {what}", "pair") + "\n"


def _identity(one: Shown, env: ManipulationEnv) -> str:
    others = [f"[{other.title}, {other.setting}]({other.name}.md)" for other in relatives(one)]
    path = f"{one.task.__module__}.{one.task.__qualname__}"
    lines = {
        "Id": f"`{one.entry.env_id}`",
        "Control, surface": f"[{one.setting.partition(' on ')[0]}]({_control_page(one)}), "
        f"[{one.entry.surface}](../environments.md#surfaces)",
        "From": one.origin,
        "Ends": f"at success, in an invalid scene, or after {env.config.max_steps} steps",
        "Class": f"[`{one.task.__name__}`][{path}]",
        "Same task": ", ".join(others),
    }
    if one.task.one_decision:
        lines["Ends"] = "after every action"
    return table(["", ""], [[f"**{name}**", text] for name, text in lines.items() if text])


def _control_page(one: Shown) -> str:
    return f"../environments.md#{one.entry.control.replace('_', '-')}"


def _snippet(one: Shown) -> str:
    return f'```python\nimport bulletarm_gym, gymnasium\n\nenv = gymnasium.make("{one.entry.env_id}")\n```\n\n'


def _observation(env: ManipulationEnv) -> str:
    kinds = {name: SENSORS[source] for name, source, _ in env.config.sensors}
    rows = [
        [f"`{name}`", f"`{_box(space)}`", _meaning(kinds[name])]
        for name, space in env.observation_space.items()  # type: ignore[attr-defined]
    ]
    return table(["name", "space", "meaning"], rows)


def _box(space: spaces.Box) -> str:
    low, high = space.low.min(), space.high.max()
    shape = ", ".join(map(str, space.shape)) + ("," if len(space.shape) == 1 else "")
    return f"Box({low:g}, {high:g}, ({shape}), {space.dtype})"


def _meaning(sensor: type[Any]) -> str:
    return f"{sentence(sensor)} {sentence(sensor.space)}"


def _parameters(env: ManipulationEnv) -> str:
    takes = accepted(env.config.control, env.task.defaults, tuple(ROBOTS))
    meaning = parameters(EnvConfig)
    rows = [
        [f"`{name}`", f"`{value!r}`", meaning[name], takes[name]]
        for name, value in env.config.parameters().items()
    ]
    more = "`surface` puts the task on [other ground](../environments.md#surfaces), `control` under another control."
    return table(["name", "default", "meaning", "takes"], rows) + "\n" + more


def _expert(one: Shown) -> Sequence[str]:
    by_arm = {row["robot"]: row for row in measured.rows("experts", one.name)}
    found = [by_arm[arm] for arm in ARMS if arm in by_arm]
    if not found:
        return []
    rows = [
        [ARMS[row["robot"]], measured.percent(row["success"]), f"{float(row['mean_steps']):.1f}", row["episodes"]]
        for row in found
    ]
    told = "Success and mean length of the expert that solves the task by what it knows of the scene (`env.unwrapped.expert_action()`)."
    return [told, table(["arm", "success:", "steps:", "episodes:"], rows), *_measurements(found)]


def _speed(one: Shown) -> Sequence[str]:
    found = measured.rows("speed", one.name)
    told = [_rate(row) for row in found]
    return [*told, *_measurements(found)]


def _rate(row: measured.Row) -> str:
    rate = f"**{float(row['steps_per_second']):,.0f} steps a second** in one process"
    times = row["times_reference"]
    return rate + (f", {float(times):.1f} times the original release's." if times else ".")


def _measurements(found: Iterable[measured.Row]) -> Sequence[str]:
    """Return how figures came about, each way once."""
    lines = dict.fromkeys(
        f"`{row['command']}`  \n{row['machine']}, {row['date']}, commit {row['commit']}" for row in found
    )
    return [f'??? info "How this was measured"\n\n    ' + "\n\n    ".join(map(_indented, lines))] if lines else []


def _indented(text: str) -> str:
    return text.replace("\n", "\n    ")


def _cards(one: Shown) -> list[dict[str, Any]]:
    return [card for card in measured.cards() if measured.bare(card["env"]) == one.name]


def _agent(one: Shown, card: dict[str, Any]) -> str:
    low, high = card["interval"]
    stem = f"{card['folder']}-{card['baseline']}"
    shown = [
        picture(f"../images/agents/{stem}{ending}", f"{one.name}, {card['baseline']}: {what}", kind)
        for ending, what, kind in ((".gif", "film", "film"), ("-curve.png", "curve", "curve"))
        if (measured.ROOT / "docs" / "images" / "agents" / f"{stem}{ending}").exists()
    ]
    told = (
        f"`{card['baseline']}`, preset `{card['preset']}`, seed {card['seed']}: success "
        f"**{measured.percent(card['success'])}** over {card['episodes']} episodes "
        f"({measured.percent(low)} to {measured.percent(high)})."
    )
    enjoy = f"    bulletarm-zoo enjoy --published {one.entry.env_id} --baseline {card['baseline']}"
    return "\n\n".join([f"### {card['baseline']}", told, *shown, enjoy, *_measurements([_strings(card)])])


def _strings(card: dict[str, Any]) -> measured.Row:
    return {name: str(card.get(name, "")) for name in ("command", "machine", "date", "commit")}
