"""States as JSON: exact, and loading one imports and runs nothing."""

import json
import math
import sys
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field, make_dataclass
from typing import Any, NamedTuple

import numpy as np
import pytest
from rollouts import advance, digest, transcript

from bulletarm_gym.demonstrations import json_state
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.geometry import Pose
from bulletarm_gym.scene import Scene
from bulletarm_gym.tasks.palletizing import NO_ROOM
from bulletarm_gym.tasks.picking import BlockPicking


@pytest.mark.parametrize(
    "value",
    [
        None,
        True,
        -3,
        2**80,
        0.1 + 0.2,
        math.inf,
        "text",
        b"\x00\xff",
        (),
        (1, (2.5, "a")),
        [1, [2]],
        {"a": (1,), 2: b"x"},
        Pose((0.1, 0.2, 0.3)),
        (Pose.planar(1.0, 2.0, 3.0, 0.4), [None]),
    ],
    ids=repr,
)
def test_values_come_back_as_they_were(value: Any) -> None:
    back = json_state.loads(json_state.dumps(value))
    assert back == value and type(back) is type(value)


def test_numpy_scalars_become_numbers() -> None:
    assert json_state.loads(json_state.dumps((np.float64(0.1), np.int64(3), np.bool_(True)))) == (
        0.1,
        3,
        True,
    )


@pytest.mark.parametrize(
    "value", [object(), {1, 2}, np.zeros(3), lambda: 0, OrderedDict()], ids=lambda value: type(value).__name__
)
def test_dumps_rejects_other_values(value: Any) -> None:
    name = type(value).__name__
    with pytest.raises(
        ValueError, match=f"^state must consist of plain values and declared types, got a {name}"
    ):
        json_state.dumps((value,))


@pytest.mark.parametrize(
    "name", ["this:x", "os:system", "builtins:eval", "bulletarm_gym.geometry:Mesh", "str"]
)
def test_loads_rejects_unknown_types(name: str) -> None:
    with pytest.raises(ValueError, match=rf"^state type must be one of .*Pose.*, got '{name}'\. Import "):
        json_state.loads(json.dumps({name: []}))


@pytest.mark.parametrize(
    "text", ["", "{}", '{"Pose": 1}', '{"Pose": [1, 2, 3]}', '{"dict": [1]}', '{"bytes": 1}']
)
def test_loads_rejects_other_texts(text: str) -> None:
    with pytest.raises(ValueError):
        json_state.loads(text)


def test_loading_imports_nothing(picking: ManipulationEnv) -> None:
    text = json_state.dumps(advance(picking, 0, 2))
    before = set(sys.modules)
    json_state.loads(text)
    with pytest.raises(ValueError, match="this:x"):
        json_state.loads('{"this:x": []}')
    assert set(sys.modules) == before


@dataclass(frozen=True)
class Count:
    """Memory of a task."""

    number: int
    places: tuple[Pose, ...]


class Undeclared(NamedTuple):
    """Memory that no task declares."""

    number: int


class Counting(BlockPicking):
    """Task that counts its steps."""

    memory_types = (Count,)

    def after_action(self, scene: Scene, rng: np.random.Generator) -> None:
        """Count."""
        number, places = (self.memory.number, self.memory.places) if self.memory else (0, ())
        self.memory = Count(number + 1, (*places, scene.robot.pose))


def test_declared_memory_is_stored() -> None:
    env = ManipulationEnv(f"{Counting.__module__}:Counting", "close_loop", obs_size=16)
    state = advance(env, 0, 3)
    back = json_state.loads(json_state.dumps(state))
    assert back == state and type(back.memory) is Count and back.memory.number == 3
    first = transcript_of(env)
    env.set_state(back)
    assert transcript_of(env) == first
    env.task.memory = Undeclared(1)
    with pytest.raises(ValueError, match=r"got a Undeclared: .*memory_types"):
        json_state.dumps(env.get_state())
    env.close()


def transcript_of(env: ManipulationEnv) -> list[str]:
    return [digest(*env.step(env.expert_action())) for _ in range(2)]


@dataclass
class Derived:
    """Memory with a field that the constructor does not take."""

    number: int = field(init=False, default=0)


@pytest.mark.parametrize("types", [(int,), (Derived,), [Count], Count, (Count(1, ()),)], ids=str)
def test_memory_types_must_be_records(types: Any) -> None:
    with pytest.raises(
        ValueError, match=r"^memory_types must be a tuple of dataclasses and named tuples, got "
    ):
        type("Own", (BlockPicking,), {"memory_types": types})


@pytest.mark.parametrize("name", ["Pose", "EnvState", "Count", "list", "bytes"])
def test_memory_types_need_names_of_their_own(name: str) -> None:
    other = make_dataclass(name, ["number"], namespace={"__module__": "elsewhere"})
    with pytest.raises(ValueError, match=rf"^memory_types must have distinct names, got elsewhere:{name} "):
        type("Own", (BlockPicking,), {"memory_types": (other,)})


def test_reloaded_types_replace_theirs() -> None:
    for _ in range(2):
        kind = make_dataclass("Reloaded", ["number"], namespace={"__module__": "elsewhere"})
        type("Own", (BlockPicking,), {"memory_types": (kind,)})
        assert type(json_state.loads(json_state.dumps(kind(1)))) is kind


MEMORIES: dict[str, Any] = {
    "CloseLoopObjectGrasping": (Pose.planar(0.4, 0.1, 0.05, 0.3),) * 2,
    "OpenLoopBoxPalletizing": NO_ROOM,
    "OpenLoopCovidTest": None,
}


@pytest.mark.parametrize("name", MEMORIES)
def test_memories_of_our_tasks_are_stored(name: str, make: Callable[..., ManipulationEnv]) -> None:
    env = make(f"BulletArm/{name}-v0", obs_size=16)
    env.reset(seed=0)
    env.task.memory = MEMORIES[name]
    state = env.get_state()
    assert json_state.loads(json_state.dumps(state)) == state


def test_failed_grasps_are_stored(make: Callable[..., ManipulationEnv]) -> None:
    env = make("BulletArm/CloseLoopObjectGrasping-v0", obs_size=16)
    env.reset(seed=0)
    env.step([-1.0, 0.0, 0.0, 0.0, 0.0])
    state = env.get_state()
    assert state.memory == (env.scene.robot.pose,)
    assert json_state.loads(json_state.dumps(state)) == state


def test_states_of_every_id_go_on_exactly(env: ManipulationEnv) -> None:
    state = advance(env, 0, 0)
    text = json_state.dumps(state)
    assert json_state.loads(text) == state
    first = transcript(env, 1)
    env.set_state(json_state.loads(text))
    assert transcript(env, 1) == first
