"""State of an environment, and the types of the values in it."""

import dataclasses
import zlib
from typing import Any

from bulletarm_gym.geometry import Pose
from bulletarm_gym.robots import RobotState
from bulletarm_gym.scene import Scene
from bulletarm_gym.simulation import WorldState
from bulletarm_gym.simulation.properties import Properties

SCENE_PARAMETERS = ("workspace", "object_scale_range", "num_objects", "close_loop_tray")
"""Parameters that determine the bodies of a scene and where they can be."""


@dataclasses.dataclass(frozen=True)
class EnvState:
    """State of an environment, from which it continues exactly; picklable.

    :param sensors: memories of the sensors, by name
    :param memory: the task's memory
    :param control: the control's memory
    :param steps: number of steps since the reset
    :param ended: whether the episode has terminated or been truncated
    :param generator: state of the generator that seeds later episodes
    :param made_of: task, arm, sizes and whatever else an environment must have in common with the state
    """

    world: WorldState
    robot: RobotState
    cast: tuple[int, ...]
    sensors: dict[str, Any]
    memory: Any
    control: Any
    steps: int
    ended: bool
    episode_seed: int
    generator: dict[str, Any]
    made_of: dict[str, Any]


def check_fits(state: Any, made_of: dict[str, Any]) -> None:
    """Check that a state belongs to an environment of the same task, arm and objects.

    :param made_of: values that the environment and the state must have in common, by name
    :raises ValueError: they differ, or ``state`` is not an :class:`EnvState`
    """
    if not isinstance(state, EnvState):
        advice = ". Use bulletarm_gym.vector.reset_to_states() for one state per member"
        raise ValueError(
            f"state must be an EnvState from get_state(), got a {type(state).__name__}"
            f"{advice if isinstance(state, list | tuple) else ''}"
        )
    other = [name for name, value in made_of.items() if state.made_of.get(name) != value]
    if other:
        needed, got = (", ".join(f"{n}={made.get(n)!r}" for n in other) for made in (made_of, state.made_of))
        raise ValueError(f"state must be of an environment with {needed}, got one with {got}")


STATE_TYPES: dict[str, type] = {
    kind.__name__: kind for kind in (bytes, list, dict, Pose, Properties, WorldState, RobotState, EnvState)
}
"""Types that files of states name, by name: the fixed ones and those that imported tasks declare."""


def declare_state_types(kinds: tuple[type, ...]) -> None:
    """Add the types of a task's memory to :data:`STATE_TYPES`.

    :param kinds: dataclasses and named tuples, made from their fields alone
    :raises ValueError: an entry is something else, or another type has its name
    """
    if not (isinstance(kinds, tuple) and all(map(_is_record, kinds))):
        raise ValueError(f"memory_types must be a tuple of dataclasses and named tuples, got {kinds!r}")
    for kind in kinds:
        known = STATE_TYPES.setdefault(kind.__name__, kind)
        if _path(known) != _path(kind):
            raise ValueError(
                f"memory_types must have names of their own, got {_path(kind)} next to {_path(known)}. "
                "Rename one of them."
            )
        STATE_TYPES[kind.__name__] = kind  # a module that is reloaded replaces its types


def scene_facts(scene: Scene) -> dict[str, Any]:
    """Return names and JSON values that a state must have in common with a scene."""
    names = [body.spec.name for body in scene.world.bodies]
    return {
        **{name: getattr(scene.config, name) for name in SCENE_PARAMETERS},
        "robot": scene.robot.model.name,
        "bodies": f"{len(names)}, crc {zlib.crc32(repr(names).encode()):08x}",
    }


def field_names(kind: type) -> tuple[str, ...]:
    """Return the names of a dataclass's or named tuple's fields, in the order of the constructor."""
    if dataclasses.is_dataclass(kind):
        return tuple(field.name for field in dataclasses.fields(kind))
    names: tuple[str, ...] = getattr(kind, "_fields", ())
    return names


def _is_record(kind: Any) -> bool:
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        return all(field.init for field in dataclasses.fields(kind))
    return isinstance(kind, type) and issubclass(kind, tuple) and hasattr(kind, "_fields")


def _path(kind: type) -> str:
    return f"{kind.__module__}:{kind.__qualname__}"
