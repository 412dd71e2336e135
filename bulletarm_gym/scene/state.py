"""State of an environment, and the types of the values in it."""

import dataclasses
import zlib
from collections.abc import Iterable
from typing import Any

import numpy as np

from bulletarm_gym.config import with_effect
from bulletarm_gym.geometry import Pose
from bulletarm_gym.robots import ROBOTS, RobotModel, RobotState
from bulletarm_gym.scene.scene import Scene
from bulletarm_gym.simulation import WorldState
from bulletarm_gym.simulation.shapes import BodySpec
from bulletarm_gym.simulation.state import Properties
from bulletarm_gym.simulation.urdf import mass_of

CHECKSUMS = ("arm", "object_files")
"""Checksums of a user's robot and object files."""
DECIMALS = 5
"""Number of decimals of the numbers (m, rad, kg) in checksums."""


@dataclasses.dataclass(frozen=True)
class EnvState:
    """State of an environment, from which it continues exactly; picklable.

    :param variants: number of the body that fills each object slot, in their order
    :param sensors: memories of the sensors, by name
    :param memory: the task's memory
    :param control: the control's memory
    :param steps: number of steps since the reset
    :param ended: whether the episode has terminated or been truncated
    :param episode_seed: seed of the episode
    :param generator: state of the generator that seeds later episodes
    :param made_of: task, robot, sizes and other values that the environment and the state must have in common
    :param narrowed: names and values of the parameters that options of the reset have narrowed
    :param sampled: keys and values of the sampled quantities, see :mod:`~bulletarm_gym.randomization`
    :param last_action: numbers of the last action, if actions have a delay
    """

    world: WorldState
    robot: RobotState
    variants: tuple[int, ...]
    sensors: dict[str, Any]
    memory: Any
    control: Any
    steps: int
    ended: bool
    episode_seed: int
    generator: dict[str, Any]
    made_of: dict[str, Any]
    narrowed: tuple[tuple[str, Any], ...]
    sampled: tuple[tuple[str, float], ...]
    last_action: tuple[float, ...]


def check_fits(state: Any, made_of: dict[str, Any]) -> None:
    """Raise a ValueError if a state is not of an environment with the same task, robot and objects.

    :param made_of: values that the environment and the state must have in common, by name
    """
    if not isinstance(state, EnvState):
        advice = ". Use bulletarm_gym.vector.reset_to_states() for one state per member"
        raise ValueError(
            f"state must be an EnvState from get_state(), got a {type(state).__name__}"
            f"{advice if isinstance(state, list | tuple) else ''}"
        )
    names = [*made_of, *(name for name in CHECKSUMS if name not in made_of)]
    other = [name for name in names if state.made_of.get(name) != made_of.get(name)]
    if other:
        needed, got = (", ".join(f"{n}={made.get(n)!r}" for n in other) for made in (made_of, state.made_of))
        raise ValueError(f"state must be of an environment with {needed}, got one with {got}")


def scene_facts(scene: Scene) -> dict[str, Any]:
    """Return names and JSON values that a state must have in common with a scene."""
    config, model = scene.config, scene.robot.model
    bodies = [body.spec.name for body in scene.world.bodies]
    names = [name for name in with_effect("scene") if name != "object_set"]  # a folder may have moved
    facts = {name: getattr(config, name) for name in names}
    facts |= {"robot": model.name, "bodies": f"{len(bodies)}, crc {zlib.crc32(repr(bodies).encode()):08x}"}
    known = ROBOTS.get(model.name)
    arm = _checksum(_arm_numbers(model))
    if known is None or _checksum(_arm_numbers(known)) != arm:
        facts["arm"] = arm
    if isinstance(config.object_set, str):
        specs = [spec for obj in scene.all_objects for spec in obj.slot.variants]
        facts["object_files"] = _checksum(map(_object_numbers, specs))
    return facts


def _checksum(parts: Iterable[Any]) -> str:
    rounded = [np.round(np.asarray(part, np.float64), DECIMALS) + 0.0 for part in parts]  # -0.0 becomes 0.0
    return f"crc {zlib.crc32(b''.join(part.tobytes() for part in rounded)):08x}"


def _arm_numbers(model: RobotModel) -> list[Any]:
    """Return the numbers of a robot on which motions depend."""
    chain, gripper = model.chain, model.gripper
    masses = [mass_of(link) for link in model.urdf.findall("link")]
    fingers = (gripper.stroke, gripper.force, gripper.speed, gripper.friction)
    return [*chain.frames, chain.limits, model.posture, model.torques, masses, fingers]


def _object_numbers(spec: BodySpec) -> list[float]:
    """Return the numbers of an object on which its motion depends."""
    frame, _ = spec.mass_properties
    frictions = (spec.friction, spec.rolling_friction, spec.spinning_friction)
    return [*spec.extents, *frame.position, spec.mass, *frictions]


STATE_TYPES: dict[str, type] = {
    kind.__name__: kind for kind in (bytes, list, dict, Pose, Properties, WorldState, RobotState, EnvState)
}
"""Types in files of states, by name: built-in types and types that imported tasks declare."""


def declare_state_types(kinds: tuple[type, ...]) -> None:
    """Add the types of a task's memory to :data:`STATE_TYPES`.

    :param kinds: dataclasses and named tuples that can be constructed from their fields
    :raises ValueError: an entry is something else, or another type has its name
    """
    if not (isinstance(kinds, tuple) and all(map(_is_record, kinds))):
        raise ValueError(f"memory_types must be a tuple of dataclasses and named tuples, got {kinds!r}")
    for kind in kinds:
        known = STATE_TYPES.setdefault(kind.__name__, kind)
        paths = [f"{each.__module__}:{each.__qualname__}" for each in (kind, known)]
        if paths[0] != paths[1]:
            raise ValueError(f"memory_types must have distinct names, got {' and '.join(paths)}. Rename one.")
        STATE_TYPES[kind.__name__] = kind  # a module that is reloaded replaces its types


def _is_record(kind: Any) -> bool:
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        return all(field.init for field in dataclasses.fields(kind))
    return isinstance(kind, type) and issubclass(kind, tuple) and hasattr(kind, "_fields")


def field_names(kind: type) -> tuple[str, ...]:
    """Return the names of the fields of a dataclass or named tuple, in the order of the constructor."""
    if dataclasses.is_dataclass(kind):
        return tuple(field.name for field in dataclasses.fields(kind))
    names: tuple[str, ...] = getattr(kind, "_fields", ())
    return names
