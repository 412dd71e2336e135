"""The page of a task, made from its class and from the environment."""

from collections.abc import Iterable, Sequence

import gymnasium
from gymnasium import spaces

from bulletarm_gym.config import CLOSE_LOOP, Context, EnvConfig, ParameterError
from bulletarm_gym.env import ManipulationEnv
from website import actions, figures
from website.catalogue import Shown, relatives
from website.docstrings import parameters
from website.environments_page import observed
from website.markdown import picture, section, table

MORE_PARAMETERS = """
`surface` puts the task on [other ground](../environments.md#surfaces), `control` under
[another control](../environments.md#parameters).
"""


def page(one: Shown) -> str:
    """Return the Markdown of the page of an environment."""
    env = gymnasium.make(one.entry.env_id)
    base: ManipulationEnv = env.unwrapped  # type: ignore[assignment]
    text = "".join(_parts(one, base))
    env.close()
    return text


def _parts(one: Shown, env: ManipulationEnv) -> Iterable[str]:
    title = f"{one.title}, {one.setting}"
    yield f"---\ntitle: {title}\ndescription: {one.summary}\n---\n\n# {title}\n\n"
    yield f"{one.summary}\n\n" + _pictures(one, "", "at reset and solved") + "\n"
    yield _identity(one, env) + "\n" + _snippet(one)
    yield section("Task", *(f"**{label}:** {text}" for label, text in one.facts.items()))
    yield section("Observation", _observation(env), *_heightmaps(one))
    yield section("Action", *actions.describe(env))
    yield section("Parameters", _parameters(env))
    yield section("Expert", *figures.expert(one.name))
    yield section("Speed", *figures.speed(one.name))
    yield section("Trained agents", *figures.agents(one.name))


def _pictures(one: Shown, suffix: str, what: str) -> str:
    path = f"../images/tasks/{one.picture}{suffix}.webp"
    return picture(path, f"{one.name}: {what}", "pair") + "\n"


def _heightmaps(one: Shown) -> Sequence[str]:
    bright = "far from the gripper" if one.entry.control == CLOSE_LOOP else "high"
    told = f"The heightmap at reset and at the end; bright is {bright}."
    return _pictures(one, "-heightmap", "the heightmap at reset and at the end"), told


def _identity(one: Shown, env: ManipulationEnv) -> str:
    control = one.entry.control
    others = [f"[{other.title}, {other.setting}]({other.name}.md)" for other in relatives(one)]
    path = f"{one.task.__module__}.{one.task.__qualname__}"
    lines = {
        "Id": f"`{one.entry.env_id}`",
        "Control": f"[{control.replace('_', ' ')}](../environments.md#{control.replace('_', '-')})",
        "Surface": f"[{one.entry.surface}](../environments.md#surfaces)",
        "From": one.origin,
        "Ends": _ends(one, env),
        "Class": f"[`{one.task.__name__}`][{path}]",
        "Same task": "; ".join(others),
    }
    return table(["", ""], [[f"**{name}**", text] for name, text in lines.items() if text])


def _ends(one: Shown, env: ManipulationEnv) -> str:
    if one.task.single_step:
        return "after every action"
    return f"at success, in an invalid scene, or after {env.config.max_steps} steps"


def _snippet(one: Shown) -> str:
    code = f'import bulletarm_gym, gymnasium\n\nenv = gymnasium.make("{one.entry.env_id}")'
    return f"```python\n{code}\n```\n\n"


def _observation(env: ManipulationEnv) -> str:
    meanings = observed(env.config.control)
    rows = [
        [f"`{name}`", f"`{_box(space)}`", meanings[name]]
        for name, space in env.observation_space.items()  # type: ignore[attr-defined]
    ]
    return table(["name", "space", "meaning"], rows)


def _box(space: spaces.Box) -> str:
    low, high = space.low.min(), space.high.max()
    shape = ", ".join(map(str, space.shape)) + ("," if len(space.shape) == 1 else "")
    return f"Box({low:g}, {high:g}, ({shape}), {space.dtype})"


def _parameters(env: ManipulationEnv) -> str:
    context, meaning = Context(env.config.control, env.task.defaults), parameters(EnvConfig)
    rows = [
        [f"`{name}`", f"`{value!r}`", meaning[name], _accepted(name, context)]
        for name, value in env.config.parameters().items()
    ]
    return table(["name", "default", "meaning", "accepted values"], rows) + MORE_PARAMETERS


def _accepted(name: str, context: Context) -> str:
    """Return the description of the accepted values of a parameter, from the error for a wrong value."""
    try:
        EnvConfig.of(context, {name: object()})
    except ParameterError as error:
        return str(error).removeprefix(f"{name} must be ").partition(", got <object")[0]
    raise AssertionError(f"{name} must not accept every value")
