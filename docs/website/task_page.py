"""The page of a task, generated from its class and its environment."""

from collections.abc import Iterable, Sequence

import gymnasium
from gymnasium import spaces

from bulletarm_gym.config import Context, EnvConfig, ParameterError
from bulletarm_gym.env import ManipulationEnv
from website import actions, figures
from website.catalogue import CONTROL_NAMES, Shown, relatives
from website.docstrings import parameters
from website.environments_page import observed
from website.markdown import image, section, table

MORE_PARAMETERS = """
`surface` selects [another surface](../environments.md#surfaces), `control`
[another control](../environments.md#parameters).
"""


SNIPPET = """```python
import bulletarm_gym
import gymnasium

env = gymnasium.make("{env_id}")
observation, info = env.reset(seed=0)
action = env.unwrapped.expert_action()
observation, reward, terminated, truncated, info = env.step(action)
```

"""


def page(one: Shown) -> str:
    """Return the Markdown of the page of an environment."""
    env = gymnasium.make(one.env_id)
    base: ManipulationEnv = env.unwrapped  # type: ignore[assignment]
    text = "".join(_parts(one, base))
    env.close()
    return text


def _parts(one: Shown, env: ManipulationEnv) -> Iterable[str]:
    title = f"{one.title}, {one.setting}"
    yield f"---\ntitle: {title}\ndescription: {one.summary}\n---\n\n# {title}\n\n"
    yield f"{one.summary}\n\n" + SNIPPET.format(env_id=one.env_id)
    yield _images(one, "", "at the start and solved") + "\n" + _identity(one, env) + "\n"
    yield section("Task", *(f"**{label}:** {text}" for label, text in one.facts.items()))
    yield section("Observation", _observation(env), *_heightmaps(one))
    yield section("Action", *actions.describe(env))
    yield section("Parameters", _parameters(env))
    yield section("Expert", *figures.expert(one.name))
    yield section("Speed", *figures.speed(one.name))
    yield section("Trained agents", *figures.agents(one.name))


def _images(one: Shown, suffix: str, what: str) -> str:
    path = f"../images/tasks/{one.image}{suffix}.webp"
    return image(path, f"{one.name}: {what}", "pair") + "\n"


def _heightmaps(one: Shown) -> Sequence[str]:
    legend = "The heightmap at the start and at the end: 0 (dark) to 0.2 m (bright) above the surface."
    return _images(one, "-heightmap", "the heightmap at the start and at the end"), legend


def _identity(one: Shown, env: ManipulationEnv) -> str:
    control = one.kwargs["control"]
    others = [f"[{other.title}, {other.setting}]({other.name}.md)" for other in relatives(one)]
    path = f"{one.task.__module__}.{one.task.__qualname__}"
    lines = {
        "Id": f"`{one.env_id}`",
        "Control": f"[{CONTROL_NAMES[control]}](../environments.md#{control.replace('_', '-')})",
        "Surface": f"[{one.kwargs['surface']}](../environments.md#surfaces)",
        "Source": one.origin,
        "Reward": "1 on success, else 0 ([sparse](../environments.md))",
        "End of an episode": _ends(one, env),
        "`info`": ", ".join(f"`{key}`" for key in env.reset(seed=0)[1]),
        "Class": f"[`{one.task.__name__}`][{path}]",
        "Same task": "; ".join(others),
    }
    return table(["", ""], [[f"**{name}**", text] for name, text in lines.items() if text])


def _ends(one: Shown, env: ManipulationEnv) -> str:
    if one.task.single_step:
        return "every action"
    return f"success, an invalid scene, or {env.config.max_steps} steps"


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
