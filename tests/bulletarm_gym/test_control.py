"""Controls use only quantities of a real robot, and experts respect their limits."""

import dataclasses
import math
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from bulletarm_gym.control import CloseLoop, Control, DeltaMove, RobotInterface
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.experts import CLOSED, Waypoint
from bulletarm_gym.experts.approach import Tracker
from bulletarm_gym.geometry import Pose
from bulletarm_gym.observations import View
from bulletarm_gym.robots import Robot
from bulletarm_gym.scene import Scene, SceneObject
from bulletarm_gym.simulation import Body, World
from bulletarm_gym.tasks import Task

Make = Callable[..., ManipulationEnv]
PICKING = "BulletArm/CloseLoopBlockPicking-v0"
SIMULATED = (Scene, World, SceneObject, Body, Robot, Task)


class SmallSteps(CloseLoop):
    """Closed-loop control with a fifth of the limits."""

    max_translation = 0.01
    max_rotation = math.pi / 20.0


def reachable(thing: Any, seen: set[int]) -> Iterator[Any]:
    """Yield an object and all objects that its attributes lead to; of interface and view, the public ones."""
    if id(thing) in seen:
        return
    seen.add(id(thing))
    yield thing
    parts: list[Any] = list(thing) if isinstance(thing, tuple | list) else []
    if isinstance(thing, RobotInterface | View):
        parts += [getattr(thing, name) for name in dir(thing) if not name.startswith("_")]
    elif type(thing).__module__.startswith("bulletarm_gym"):
        parts += vars(thing).values() if hasattr(thing, "__dict__") else []
    for part in parts:
        if not callable(part):
            yield from reachable(part, seen)


@pytest.mark.parametrize("env_id", [PICKING, "BulletArm/OpenLoopHouseBuilding1-v0"])
def test_control_reaches_no_simulated_object(make: Make, env_id: str) -> None:
    env = make(env_id)
    env.reset(seed=0)
    while env.scene.held is None:
        env.step(env.expert_action())
    assert any(isinstance(thing, Scene) for thing in reachable(env.tracker, set()))
    for start in (env.control, env.look()):
        assert not [thing for thing in reachable(start, set()) if isinstance(thing, SIMULATED)]


def test_expert_respects_the_limits_of_the_control(make: Make) -> None:
    env = make(PICKING, control=f"{__name__}:SmallSteps", max_steps=200)
    env.reset(seed=1)
    terminated = truncated = False
    while not (terminated or truncated):
        move = env.decode_action(env.expert_action())
        assert max(map(abs, move.translation)) <= 0.01 + 1e-9
        assert abs(move.rotation) <= math.pi / 20.0 + 1e-9
        *_, terminated, truncated, info = env.step(env.encode_action(move))
    assert info["is_success"]


def test_tracker_rejects_a_control_without_towards(picking: ManipulationEnv) -> None:
    class Other(Control[DeltaMove]):
        kind = "close_loop"

    Other.__abstractmethods__ = frozenset()
    other = Other(picking.config, picking.control.robot, ())  # type: ignore[abstract]
    with pytest.raises(TypeError, match=r"control must .*towards.*Other"):
        Tracker(other, picking.scene, None).towards(Waypoint(Pose.planar(0.45, 0.0, 0.2), CLOSED))


def test_memory_of_a_control_is_part_of_the_state(make: Make) -> None:
    env, other = (make("BulletArm/OpenLoopHouseBuilding1-v0", number) for number in (0, 1))
    env.reset(seed=1)
    assert env.get_state().control is None
    env.step(env.expert_action())
    state = env.get_state()
    assert len(state.control) == 5 and all(type(number) is float for number in state.control)
    other.reset(seed=2)
    other.set_state(state)
    action = [0.5, 0.1, -0.2, 0.0]
    assert other.decode_action(action) == env.decode_action(action)
    other.set_state(dataclasses.replace(state, control=None))
    assert other.decode_action(action) != env.decode_action(action)
    env.reset(seed=1)
    assert env.control.memory is None
