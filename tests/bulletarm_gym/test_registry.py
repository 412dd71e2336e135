"""Components of users: registered by name, stored by import path, rejected with the reason."""

import pickle
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv
from rollouts import make_env, transcript

import bulletarm_gym
from bulletarm_gym import registry
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.objects.catalogue import KINDS
from bulletarm_gym.robots import ROBOTS
from bulletarm_gym.surfaces import FlatSurface

PICKING = "BulletArm/CloseLoopBlockPicking-v0"
GRASPING = "BulletArm/CloseLoopObjectGrasping-v0"
TASK = "bulletarm_gym.tasks.picking:BlockPicking"
PARTS = """
import dataclasses
from functools import partial

import numpy as np
from gymnasium import spaces

from bulletarm_gym.objects import BodySpec, Box, Piece
from bulletarm_gym.control import CloseLoop
from bulletarm_gym.robots import KUKA
from bulletarm_gym.observations import Sensor
from bulletarm_gym.surfaces import FlatSurface
from bulletarm_gym.tasks.picking import BlockPicking

NUMBER = 3

def arm():
    return dataclasses.replace(KUKA, name="arm")

class Zero(Sensor):
    space = spaces.Box(0.0, 1.0, (1,), np.float32)

    def read(self, view):
        return np.zeros(1, np.float32)

class Raised(FlatSurface):
    slide = 0.0

class Hilly(FlatSurface):
    sloping = True

class Backwards(CloseLoop):
    sequences = ("rzyxp", "zyxp")

class Kindless(CloseLoop):
    kind = "both"

class Picking(BlockPicking):
    pass

def brick(name, scale, width=0.03, pieces=None, **values):
    pieces = (Piece(Box((0.08 * scale, width * scale, 0.04 * scale))),) if pieces is None else pieces
    return BodySpec(name, pieces, **{"mass": 0.3, **values})

light = partial(brick, mass=-1.0)
slippery = partial(brick, friction=float("nan"))
opaque = partial(brick, colour=(1.0, 0.0, 0.0))
empty = partial(brick, pieces=())
flat = partial(brick, width=0.0)

def nothing(name, scale):
    return None
"""


@pytest.fixture(autouse=True)
def my_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, own_registrations: None) -> Iterator[None]:
    """The module of a user; all registrations of a test are removed."""
    for one in (registry.ROBOTS, registry.OBJECTS, registry.SENSORS, registry.SURFACES, registry.CONTROLS):
        monkeypatch.setattr(one, "paths", {})
    (tmp_path / "my_parts.py").write_text(PARTS)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield
    sys.modules.pop("my_parts", None)


@pytest.fixture
def mine() -> str:
    """Register one component of each kind; return the task's id."""
    bulletarm_gym.register_robot("mine", "my_parts:arm")
    bulletarm_gym.register_object("tile", "my_parts:brick")
    bulletarm_gym.register_sensor("zero", "my_parts:Zero")
    bulletarm_gym.register_surface("high_ground", "my_parts:Raised")
    bulletarm_gym.register_control("back_wards", "my_parts:Backwards")
    return bulletarm_gym.register_task("Mine", "my_parts:Picking", "back_wards", "high_ground")


ENVIRONMENTS: dict[str, dict[str, Any]] = {
    PICKING: {"surface": "high_ground", "control": "back_wards", "observation": ["heightmap", "zero"]},
    GRASPING: {"object_set": ["tile", "cube", "tile"], "num_objects": 2, "object_scale_range": 0.5},
    "BulletArm/BackWardsHighGroundMine-v0": {"robot": "mine"},
}


@pytest.mark.usefixtures("mine")
@pytest.mark.parametrize("env_id", ENVIRONMENTS)
def test_registered_components_are_stored_by_their_paths(env_id: str) -> None:
    env = gymnasium.make(env_id, obs_size=16, **ENVIRONMENTS[env_id]).unwrapped
    assert isinstance(env, ManipulationEnv) and "my_parts:" in repr(env.spec)
    if env_id == GRASPING:
        names = [item.slot.name for item in env.scene.objects]
        assert names == ["my_parts:brick 0", "cube 0", "my_parts:brick 1"]
        spec = env.scene.objects[0].spec
        assert spec.mass == 0.3 and spec.extents == pytest.approx((0.02, 0.04, 0.015))  # lying
    else:
        assert env.scene.surface.slide == 0.0 and env.action_sequence == "rzyxp"
    for one in (registry.SURFACES, registry.CONTROLS, registry.OBJECTS, registry.SENSORS, registry.ROBOTS):
        one.paths.clear()  # as in a process that has not imported the user's file
    copy = pickle.loads(pickle.dumps(env))
    assert transcript(copy, 2, seed=1) == transcript(env, 2, seed=1)
    for other in (env, copy):
        other.close()


def test_spawned_workers_find_registered_components(mine: str) -> None:
    parameters = {"robot": "mine", "observation": ["heightmap", "zero"], "obs_size": 16}
    make = partial(gymnasium.make, f"bulletarm_gym:{mine}", **parameters)
    vector = AsyncVectorEnv([make], context="spawn")
    observations, _ = vector.reset(seed=0)
    with make() as env:
        expected, _ = env.reset(seed=0)
    np.testing.assert_array_equal(observations["heightmap"][0], expected["heightmap"])
    assert vector.call("action_sequence") == ("rzyxp",)
    vector.close()


@pytest.mark.parametrize("text", ["not JSON", "[1]"])
def test_foreign_text_in_the_variable_is_ignored(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(registry.VARIABLE, text)
    assert registry.published("robot") == {}


@pytest.mark.usefixtures("mine")
@pytest.mark.parametrize(("control", "prefix"), [("close_loop", "CloseLoop"), ("open_loop", "OpenLoop")])
def test_ids_name_control_and_surface(control: str, prefix: str) -> None:
    for surface, word in (("high_ground", "HighGround"), ("ramp", "Ramp"), ("tray", "Tray"), ("flat", "")):
        env_id = bulletarm_gym.register_task("Mine", TASK, control, surface)
        assert env_id == f"BulletArm/{prefix}{word}Mine-v0"
        expected = "my_parts:Raised" if surface == "high_ground" else surface
        assert gymnasium.spec(env_id).kwargs["surface"] == expected
        del gymnasium.registry[env_id]


def test_sloping_surface_has_actions_with_three_rotations() -> None:
    path = "my_parts:Hilly"
    env = make_env("BulletArm/OpenLoopBlockStacking-v0", surface=path, obs_size=16)
    assert env.config.action_sequence == "pxyzrrr"
    env.close()
    with pytest.raises(ValueError, match=rf"^surface must be .*, got '{path}'"):
        make_env("BulletArm/CloseLoopDrawerOpening-v0", surface=path)


def test_registration_is_refused() -> None:
    local = type("Local", (FlatSurface,), {"__qualname__": "test.<locals>.Local"})
    with pytest.raises(ValueError, match="local to a function"):
        bulletarm_gym.register_surface("mine", local)
    with pytest.raises(ValueError, match=r"^name must be an identifier"):
        bulletarm_gym.register_surface("two levels", FlatSurface)
    for register, names in (
        (bulletarm_gym.register_surface, ["ramp"]),
        (bulletarm_gym.register_control, ["open_loop"]),
        (bulletarm_gym.register_object, KINDS),
        (bulletarm_gym.register_robot, ROBOTS),
    ):
        for name in names:
            with pytest.raises(ValueError, match=f"^name must be unused, got '{name}'"):
                register(name, "my_parts:arm")
    bulletarm_gym.register_surface("mine", FlatSurface)
    with pytest.raises(ValueError, match=r"^name must be unused, got 'mine'"):
        bulletarm_gym.register_surface("mine", "bulletarm_gym.surfaces:RampSurface")
    for name, value in (("surface", "moon"), ("control", "remote")):
        with pytest.raises(ValueError, match=f"^{name} must be one of .*, got '{value}'"):
            bulletarm_gym.register_task("Mine", TASK, **{name: value})


@pytest.mark.parametrize(
    ("parameters", "reason"),
    [
        ({"surface": "step"}, "surface must be .*'flat', 'tray', 'ramp', 'bump'.* got 'step'"),
        ({"surface": 3}, "surface must be .*, got 3"),
        ({"surface": "my_parts:NUMBER"}, "surface must be a subclass of Surface, got "),
        ({"surface": "nowhere:X"}, "surface must be .*, got 'nowhere:X': .* cannot be imported"),
        ({"control": "remote"}, "control must be one of 'close_loop', 'open_loop'.*, got 'remote'"),
        ({"control": "my_parts:Kindless"}, "control must be .* with BlockPicking, got 'my_parts:Kindless'"),
        ({"control": "open_loop"}, "control must be .* with BlockPicking, got 'open_loop'"),
        ({"control": "builtins:dict"}, "control must be a subclass of Control, got "),
        (
            {"control": "my_parts:Backwards", "action_sequence": "pxy"},
            "action_sequence must be .*'zyxp'.*, got 'pxy'",
        ),
        ({"robot": "nowhere:x"}, "robot must be one of 'kuka', .*, got 'nowhere:x': .*No module"),
        ({"robot": "math:pi"}, "robot must be .*RobotModel.*float, got 'math:pi'"),
        ({"robot": "math:sin"}, "robot must be .* argument.*, got 'math:sin'"),
        ({"task": "bulletarm_gym.surfaces:FlatSurface"}, "task must be a subclass of Task, got "),
        ({"task": 3}, "task must be 'module:attribute', got 3"),
        ({"defaults": "max_steps"}, "defaults must be a dict, got 'max_steps'"),
    ],
    ids=str,
)
def test_component_is_rejected_with_its_parameter(parameters: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValueError, match=f"^{reason}"):
        gymnasium.make(PICKING, **parameters)


@pytest.mark.parametrize(
    ("kinds", "reason"),
    [
        (["hammer"], "object_set: kind must .*, got 'hammer'"),
        (["my_parts:nothing"], "object_set: .*BodySpec, got a NoneType"),
        (["my_parts:light"], "object_set: mass .*, got -1"),
        (["my_parts:slippery"], "object_set: friction .*, got nan"),
        (["my_parts:opaque"], "object_set: colour .*, got"),
        (["my_parts:empty"], "object_set: object 'my_parts:empty': pieces must"),
        (["my_parts:flat"], "object_set: object 'my_parts:flat': sides must"),
        (["pallet"], "object_set: .*got 'pallet'"),
        (["cube"], "num_objects must .*1 .*, got 2"),
    ],
)
def test_object_set_is_rejected_with_the_object(kinds: list[str], reason: str) -> None:
    with pytest.raises(ValueError, match=f"^{reason}"):
        make_env(GRASPING, object_set=kinds, num_objects=2)


NOTEBOOK = """
import pickle
import sys

import gymnasium

import bulletarm_gym
from my_parts import Picking, Zero


class Mine(Picking):
    pass


class Nothing(Zero):
    pass


bulletarm_gym.register_sensor("nothing", Nothing)
env_id = bulletarm_gym.register_task("Mine", Mine)
env = gymnasium.make(env_id, observation=["nothing"], obs_size=16)
assert env.reset(seed=0)[0]["nothing"] == 0.0
sys.stdout.buffer.write(pickle.dumps(env.unwrapped))
"""


def test_components_of_a_notebook_work_in_their_process(tmp_path: Path) -> None:
    """Components of ``__main__`` are usable there; another process raises an error with the reason."""
    child = subprocess.run([sys.executable, "-c", NOTEBOOK], capture_output=True, check=True, cwd=tmp_path)
    with pytest.raises(ValueError, match=r"'__main__:Mine' cannot be imported.*Define it in a module"):
        pickle.loads(child.stdout)
