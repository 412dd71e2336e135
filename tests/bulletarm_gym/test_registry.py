"""Components of users: registered by name, stored by import path, rejected with the reason."""

import pickle
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import pytest
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
SURFACES = """
import numpy as np
from bulletarm_gym.surfaces import FlatSurface

class Raised(FlatSurface):
    slide = 0.0

class Hilly(FlatSurface):
    sloping = True

NOTHING = 3
"""


@pytest.fixture(autouse=True)
def tables(monkeypatch: pytest.MonkeyPatch) -> None:
    """Forget what a test registers."""
    for one in (registry.CONTROLS, registry.SURFACES, registry.ROBOTS, registry.OBJECTS):
        monkeypatch.setattr(one, "paths", {})


@pytest.fixture
def my_surfaces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    (tmp_path / "my_surfaces.py").write_text(SURFACES)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield
    sys.modules.pop("my_surfaces", None)


@pytest.mark.usefixtures("my_surfaces", "own_registrations")
def test_a_registered_surface_is_kept_by_its_path() -> None:
    bulletarm_gym.register_surface("raised", "my_surfaces:Raised")
    env = gymnasium.make(PICKING, surface="raised", obs_size=16)
    assert env.spec is not None and env.spec.kwargs["surface"] == "my_surfaces:Raised"
    unwrapped = env.unwrapped
    assert isinstance(unwrapped, ManipulationEnv) and unwrapped.scene.surface.slide == 0.0
    registry.SURFACES.paths.clear()  # as in a process that has not imported the user's file
    copy = pickle.loads(pickle.dumps(unwrapped))
    assert transcript(copy, 2, seed=1) == transcript(unwrapped, 2, seed=1)
    for other in (env, copy):
        other.close()


@pytest.mark.usefixtures("my_surfaces", "own_registrations")
@pytest.mark.parametrize(("control", "prefix"), [("close_loop", "CloseLoop"), ("open_loop", "OpenLoop")])
def test_ids_name_control_and_surface(control: str, prefix: str) -> None:
    bulletarm_gym.register_surface("high_ground", "my_surfaces:Raised")
    for surface, word in (("high_ground", "HighGround"), ("ramp", "Ramp"), ("tray", "Tray"), ("flat", "")):
        env_id = bulletarm_gym.register_task("Mine", TASK, control, surface)
        assert env_id == f"BulletArm/{prefix}{word}Mine-v0"
        expected = "my_surfaces:Raised" if surface == "high_ground" else surface
        assert gymnasium.spec(env_id).kwargs["surface"] == expected
        del gymnasium.registry[env_id]


@pytest.mark.usefixtures("my_surfaces")
def test_ground_that_slopes_says_so() -> None:
    path = "my_surfaces:Hilly"
    env = make_env("BulletArm/OpenLoopBlockStacking-v0", surface=path, obs_size=16)
    assert env.config.action_sequence == "pxyzrrr"
    env.close()
    with pytest.raises(ValueError, match=r"^surface must be .*, got 'my_surfaces:Hilly'"):
        make_env("BulletArm/CloseLoopDrawerOpening-v0", surface=path)


def test_what_is_no_surface_is_refused(my_surfaces: None) -> None:
    for wrong, reason in (
        ("step", "'flat', 'tray', 'ramp', 'bump'.* got 'step'"),
        (3, "got 3"),
        ("my_surfaces:NOTHING", "subclass of Surface"),
        ("my_surfaces:Absent", "cannot be imported"),
        ("builtins:dict", "subclass of Surface"),
    ):
        with pytest.raises(ValueError, match=reason):
            make_env(PICKING, surface=wrong)


def test_what_cannot_be_registered() -> None:
    class Local(FlatSurface):
        pass

    with pytest.raises(ValueError, match="local to a function"):
        bulletarm_gym.register_surface("mine", Local)
    with pytest.raises(ValueError, match=r"^name must be unused, got 'ramp'"):
        bulletarm_gym.register_surface("ramp", FlatSurface)
    for kind in KINDS:
        with pytest.raises(ValueError, match=f"^name must be unused, got '{kind}'"):
            bulletarm_gym.register_object(kind, "my_objects:cup")
    for robot in ROBOTS:
        with pytest.raises(ValueError, match=f"^name must be unused, got '{robot}'"):
            bulletarm_gym.register_robot(robot, "bulletarm_gym.robots:KUKA")
    with pytest.raises(ValueError, match=r"^name must be an identifier"):
        bulletarm_gym.register_surface("two levels", FlatSurface)
    bulletarm_gym.register_surface("mine", FlatSurface)
    with pytest.raises(ValueError, match=r"^name must be unused"):
        bulletarm_gym.register_surface("mine", "bulletarm_gym.surfaces:RampSurface")
    for wrong in ({"surface": "moon"}, {"control": "remote"}):
        with pytest.raises(ValueError, match=f"^{next(iter(wrong))} must be one of .*, got "):
            bulletarm_gym.register_task("Mine", TASK, **wrong)


OBJECTS = """
from bulletarm_gym.objects import BodySpec, Box, Piece

def brick(name, scale):
    return BodySpec(name, (Piece(Box((0.08 * scale, 0.03 * scale, 0.04 * scale))),), mass=0.3)

def nothing(name, scale):
    return None

def made(name, side=0.04, pieces=None, **values):
    pieces = (Piece(Box((side, 0.04, 0.04))),) if pieces is None else pieces
    return BodySpec(name, pieces, **{"mass": 0.1, **values})

def light(name, scale):
    return made(name, mass=-1.0)

def slippery(name, scale):
    return made(name, friction=float("nan"))

def opaque(name, scale):
    return made(name, colour=(1.0, 0.0, 0.0))

def empty(name, scale):
    return made(name, pieces=())

def flat(name, scale):
    return made(name, side=0.0)
"""


@pytest.fixture
def my_objects(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    (tmp_path / "my_objects.py").write_text(OBJECTS)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield
    sys.modules.pop("my_objects", None)


@pytest.mark.usefixtures("my_objects")
def test_registered_objects_reach_a_task_of_ours() -> None:
    bulletarm_gym.register_object("block", "my_objects:brick")
    kinds = ["block", "cube", "block"]
    env = make_env(GRASPING, object_set=kinds, num_objects=2, obs_size=16, object_scale_range=0.5)
    path = "my_objects:brick"
    assert env.config.object_set == [path, "cube", path]
    assert [item.slot.name for item in env.scene.objects] == [f"{path} 0", "cube 0", f"{path} 1"]
    spec = env.scene.objects[0].spec
    assert spec.mass == 0.3 and spec.extents == pytest.approx((0.02, 0.04, 0.015))  # lying
    registry.OBJECTS.paths.clear()
    copy = pickle.loads(pickle.dumps(env))
    assert transcript(copy, 2, seed=1) == transcript(env, 2, seed=1)
    for other in (env, copy):
        other.close()


@pytest.mark.usefixtures("my_objects")
@pytest.mark.parametrize(
    ("kinds", "reason"),
    [
        (["hammer"], "^object_set: kind must be one of 'bottle_tray', .*, got 'hammer'"),
        (["my_objects:nothing"], "^object_set: .*BodySpec, got a NoneType"),
        (["my_objects:light"], "^object_set: mass of .* must be a finite number of at least 0, got -1"),
        (
            ["my_objects:slippery"],
            "^object_set: friction of .* must be a finite number of at least 0, got nan",
        ),
        (["my_objects:opaque"], "^object_set: colour of .* must be red, green, blue and alpha, got"),
        (["my_objects:empty"], "^object_set: object 'my_objects:empty': pieces must be at least one piece"),
        (["my_objects:flat"], "^object_set: object 'my_objects:flat': sides must be positive"),
        (["pallet"], "^object_set: .*got 'pallet'"),
        (["cube"], "at most 1 with this object_set"),
    ],
)
def test_sets_of_kinds_that_cannot_be(kinds: list[str], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        make_env(GRASPING, object_set=kinds, num_objects=2)


CONTROLS = """
from bulletarm_gym.control import CloseLoop

class Backwards(CloseLoop):
    sequences = ("pzyx", "pzyxr")

class Kindless(CloseLoop):
    kind = "both"
"""


@pytest.fixture
def my_controls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    (tmp_path / "my_controls.py").write_text(CONTROLS)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield
    sys.modules.pop("my_controls", None)


@pytest.mark.usefixtures("own_registrations")
def test_a_class_that_is_no_task_is_told() -> None:
    env_id = bulletarm_gym.register_task("NoTask", FlatSurface)
    with pytest.raises(ValueError, match=r"^task must be a subclass of Task, got '.*:FlatSurface'"):
        gymnasium.make(env_id)
    del gymnasium.registry[env_id]


@pytest.mark.usefixtures("my_controls", "own_registrations")
def test_a_registered_control_is_kept_by_its_path() -> None:
    bulletarm_gym.register_control("back_wards", "my_controls:Backwards")
    env_id = bulletarm_gym.register_task("Mine", TASK, "back_wards")
    assert env_id == "BulletArm/BackWardsMine-v0"
    del gymnasium.registry[env_id]
    env = gymnasium.make(PICKING, control="back_wards", obs_size=16)
    assert env.spec is not None and env.spec.kwargs["control"] == "my_controls:Backwards"
    unwrapped = env.unwrapped
    assert isinstance(unwrapped, ManipulationEnv)
    assert (unwrapped.config.control, unwrapped.action_sequence) == ("close_loop", "pzyx")
    registry.CONTROLS.paths.clear()  # as in a process that has not imported the user's file
    copy = pickle.loads(pickle.dumps(unwrapped))
    assert transcript(copy, 2, seed=1) == transcript(unwrapped, 2, seed=1)
    for other in (env, copy):
        other.close()


@pytest.mark.usefixtures("my_controls")
def test_what_is_no_control_is_refused() -> None:
    path = "my_controls:Backwards"
    for wrong, reason in (
        ("remote", "^control must be one of 'close_loop', 'open_loop'.*, got 'remote'"),
        ("my_controls:Kindless", "^control must be .* with BlockPicking, got 'my_controls:Kindless'"),
        ("builtins:dict", "subclass of Control"),
        ("open_loop", "^control must be .* with BlockPicking, got 'open_loop'"),
    ):
        with pytest.raises(ValueError, match=reason):
            make_env(PICKING, control=wrong)
    with pytest.raises(ValueError, match=f"^control must be .* with OpenLoopObjectGrasping, got '{path}'"):
        make_env("BulletArm/OpenLoopObjectGrasping-v0", control=path)
    with pytest.raises(ValueError, match=r"^action_sequence must be 'pzyx' or 'pzyxr'.*, got 'pxy'"):
        make_env(PICKING, control=path, action_sequence="pxy")
    with pytest.raises(ValueError, match=r"^name must be unused, got 'open_loop'"):
        bulletarm_gym.register_control("open_loop", path)


@pytest.mark.parametrize(
    ("parameters", "reason"),
    [
        ({"robot": "nowhere:x"}, "robot must be one of 'kuka', .*, got 'nowhere:x': .*No module"),
        ({"robot": "math:pi"}, "robot must be .*RobotModel.*float, got 'math:pi'"),
        ({"robot": "math:sin"}, "robot must be .* argument.*, got 'math:sin'"),
        ({"surface": "nowhere:X"}, "surface must be .*, got 'nowhere:X': .* cannot be imported"),
        ({"control": "nowhere:X"}, "control must be .*, got 'nowhere:X': .* cannot be imported"),
        ({"object_scale_range": 0.05}, r"object_scale_range must be above 0\.2.*, got \[0\.05"),
    ],
)
def test_what_cannot_be_is_told_by_its_name(parameters: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValueError, match=f"^{reason}"):
        gymnasium.make(PICKING, **parameters)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"defaults": "max_steps"}, "^defaults must be a dict, got 'max_steps'"),
        ({"task": 3}, "^task must be 'module:attribute', got 3"),
    ],
)
def test_wrong_parts_are_named(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        gymnasium.make("BulletArm/CloseLoopBlockPicking-v0", **arguments)


NOTEBOOK = """
import pickle
import sys

import gymnasium
import numpy as np
from gymnasium import spaces

import bulletarm_gym
from bulletarm_gym.observations import Sensor
from bulletarm_gym.tasks.picking import BlockPicking


class Zero(Sensor):
    space = spaces.Box(0.0, 1.0, (1,), np.float32)

    def read(self, view):
        return np.zeros(1, np.float32)


class Mine(BlockPicking):
    pass


bulletarm_gym.register_sensor("zero", Zero)
env_id = bulletarm_gym.register_task("Mine", Mine)
env = gymnasium.make(env_id, observation=["zero"], obs_size=16)
assert env.reset(seed=0)[0]["zero"] == 0.0
sys.stdout.buffer.write(pickle.dumps(env.unwrapped))
"""


def test_components_of_a_notebook_work_in_their_process() -> None:
    """Components of ``__main__`` are usable there; another process raises an error with the reason."""
    child = subprocess.run([sys.executable, "-c", NOTEBOOK], capture_output=True, check=True)
    with pytest.raises(ValueError, match=r"'__main__:Mine' cannot be imported.*Define it in a module"):
        pickle.loads(child.stdout)
