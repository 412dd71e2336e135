"""Sensors, and components of users: registered by name, stored by import path, rejected with the reason."""

import pickle
import subprocess
import sys
from collections import UserList
from functools import partial
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv
from rollouts import GRASPING, PICKING, STACKING, advance, digest, make_env, transcript

import bulletarm_gym
from bulletarm_gym import registry
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.geometry import Pose
from bulletarm_gym.objects.catalogue import KINDS
from bulletarm_gym.robots import ROBOTS
from bulletarm_gym.surfaces import FlatSurface
from bulletarm_gym.wrappers import GoalObservation

HERE = Path(__file__).parent
TASK, BOTH = "bulletarm_gym.tasks.picking:BlockPicking", "bulletarm_gym.tasks.stacking:BlockStacking"


@pytest.fixture(autouse=True)
def no_registrations(monkeypatch, own_registrations):
    """Remove all registrations of a test."""
    for one in (registry.ROBOTS, registry.OBJECTS, registry.SENSORS, registry.SURFACES, registry.CONTROLS):
        monkeypatch.setattr(one, "paths", {})


@pytest.fixture
def mine():
    """Register one component of each kind; return the task's id."""
    bulletarm_gym.register_robot("mine", "my_parts:arm")
    bulletarm_gym.register_object("tile", "my_parts:brick")
    bulletarm_gym.register_sensor("zero", "my_parts:Count")
    bulletarm_gym.register_surface("high_ground", "my_parts:Raised")
    bulletarm_gym.register_control("back_wards", "my_parts:Backwards")
    return bulletarm_gym.register_task("Mine", "my_parts:Picking", "back_wards", "high_ground")


ENVIRONMENTS = {
    PICKING: {"surface": "high_ground", "control": "back_wards", "observation": ["heightmap", "zero"]},
    GRASPING: {"object_set": UserList(["tile", "cube", "tile"]), "num_objects": 2, "object_scale_range": 0.5},
    "BulletArm/BackWardsHighGroundMine-v0": {"robot": "mine"},
}


def own_sensor(name, **parameters):
    """Return the parameters of an environment with a sensor of the user's module."""
    entry = {"name": "mine", "sensor": f"my_parts:{name}", **parameters}
    return {"observation": [entry, "holding"], "obs_size": 16}


def test_goals_of_a_users_task_can_be_in_its_memory(mine):
    env = GoalObservation(gymnasium.make(mine, observation="state"))
    observation, info = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    assert env.compute_reward((0.5, 0.1), observation["desired_goal"], info) == 1.0


@pytest.mark.usefixtures("mine")
@pytest.mark.parametrize("env_id", ENVIRONMENTS)
def test_registered_components_are_stored_by_their_paths(env_id):
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


def test_spawned_workers_find_registered_components(mine):
    parameters = {"robot": "mine", "observation": ["heightmap", "zero"], "obs_size": 16}
    make = partial(gymnasium.make, f"bulletarm_gym:{mine}", **parameters)
    vector = AsyncVectorEnv([make], context="spawn")
    observations, _ = vector.reset(seed=0)
    with make() as env:
        expected, _ = env.reset(seed=0)
    np.testing.assert_array_equal(observations["heightmap"][0], expected["heightmap"])
    assert vector.call("action_sequence") == ("rzyxp",)
    vector.close()


@pytest.mark.usefixtures("mine")
@pytest.mark.parametrize(
    ("control", "prefix", "limit"), [("close_loop", "CloseLoop", 100), ("open_loop", "OpenLoop", 10)]
)
def test_ids_name_control_and_surface(control, prefix, limit):
    specs = {}
    for surface, word in (("high_ground", "HighGround"), ("ramp", "Ramp"), ("tray", "Tray"), ("flat", "")):
        env_id = bulletarm_gym.register_task("Mine", BOTH, control, surface)
        assert env_id == f"BulletArm/{prefix}{word}Mine-v0"
        expected = "my_parts:Raised" if surface == "high_ground" else surface
        specs[env_id] = gymnasium.registry.pop(env_id)
        assert specs[env_id].kwargs["surface"] == expected and specs[env_id].max_episode_steps == limit
    registry.register_all()  # as in a child process
    assert specs == {env_id: gymnasium.registry.pop(env_id) for env_id in specs}


LOCAL = type("Local", (FlatSurface,), {"__qualname__": "test.<locals>.Local"})


@pytest.mark.usefixtures("mine")
def test_registration_is_refused():
    for kind, name, component, reason in (
        ("surface", "mine", LOCAL, "local to a function"),
        ("sensor", "other", lambda scene: None, "lambda"),
        ("sensor", "other", "my_parts:Missing", "cannot be imported"),
        ("surface", "two levels", FlatSurface, "^name must be an identifier"),
        *(("object", name, "my_parts:brick", f"^name must be unused, got '{name}'") for name in KINDS),
        *(("robot", name, "my_parts:arm", f"^name must be unused, got '{name}'") for name in ROBOTS),
        ("control", "open_loop", "my_parts:Backwards", "^name must be unused, got 'open_loop'"),
        ("surface", "high_ground", FlatSurface, "^name must be unused, got 'high_ground'"),
    ):
        with pytest.raises(ValueError, match=reason):
            getattr(bulletarm_gym, f"register_{kind}")(name, component)
    for name, value in (("surface", "moon"), ("control", "remote")):
        with pytest.raises(ValueError, match=f"^{name} must be one of .*, got '{value}'"):
            bulletarm_gym.register_task("Mine", TASK, **{name: value})


REFUSED = [
    ({"surface": "step"}, "surface must be .*'flat', 'tray', 'ramp', 'bump'.* got 'step'"),
    ({"surface": "my_parts:NUMBER"}, "surface must be a subclass of Surface, got "),
    ({"surface": "nowhere:X"}, "surface must be .*, got 'nowhere:X': .* cannot be imported"),
    ({"control": "remote"}, "control must be one of 'close_loop', 'open_loop'.*, got 'remote'"),
    ({"control": "my_parts:Kindless"}, "control must be .* with BlockPicking, got 'my_parts:Kindless'"),
    ({"control": "open_loop"}, "control must be .* with BlockPicking, got 'open_loop'"),
    ({"control": "my_parts:Backwards", "action_sequence": "pxy"}, "action_sequence .*'zyxp'.*, got 'pxy'"),
    ({"robot": "nowhere:x"}, "robot must be one of 'kuka', .*, got 'nowhere:x': .*No module"),
    ({"robot": "math:pi"}, "robot must be .*RobotModel.*float, got 'math:pi'"),
    ({"task": "bulletarm_gym.surfaces:FlatSurface"}, "task must be a subclass of Task, got "),
    ({"task": 3}, "task must be 'module:attribute', got 3"),
    ({"defaults": "max_steps"}, "defaults must be a dict, got 'max_steps'"),
    (own_sensor("Unfinished"), "observation: mine: .*abstract"),
    (own_sensor("spaces"), "observation must be .*'my_parts:spaces'"),
    (own_sensor("Shape"), r"observation: mine: .*float32 .* got ndarray float32 \(3,\)"),
    (own_sensor("Type"), r"observation: mine: .*float32 .* got ndarray float64 \(2,\)"),
    (own_sensor("List"), "observation: mine: .*float32 .* got list"),
    (own_sensor("Discrete"), "observation: mine: space must be a Box, got Discrete"),
    *(
        ({"observation": value}, f"observation.*{words}")
        for value, words in (
            (["holding", "heigthmap"], "'heightmap'"),
            (["holding", "holding"], "distinct names"),
            ([{"sensor": "holding"}], "names and dicts"),
            (["holding", {"name": "a b", "sensor": "state"}], "identifier"),
            ([{"name": "holding", "size": 3}], "size"),
            ([{"name": "holding", "size": {3}}], "JSON values"),
            ([{"name": "mine", "sensor": "json:dumps"}], "subclass of Sensor"),
            ([{"name": "rgb", "position": [1.0, 2.0]}], r"position must be \[x, y, z\]"),
            ([{"name": "rgb", "position": [0, 0, 1], "target": [0, 0, 1]}], "another point"),
            ([{"name": "rgb", "fov": 180}], "fov must be a number of degrees from 1 to 170, got 180"),
            ([{"name": "point_cloud", "points": 0}], "points must be an integer of at least 1"),
            (["rgb", {"name": "render", "sensor": "rgb"}], "two cameras would be called 'render'"),
            (["in_hand"], "'in_hand' of open_loop"),
        )
    ),
    (
        {"view": "point_cloud", "observation": ["color"]},
        "observation: color: view must be .*, got 'point_cloud'",
    ),
]


@pytest.mark.parametrize(("parameters", "reason"), REFUSED, ids=str)
def test_component_is_rejected_with_its_parameter(parameters, reason):
    with pytest.raises(ValueError, match=f"^{reason}"):
        gymnasium.make(PICKING, **{"obs_size": 16, **parameters}).reset(seed=0)


def test_object_set_is_rejected_with_the_object():
    for kind, reason in (
        ("hammer", "object_set: kind must .*, got 'hammer'"),
        ("my_parts:nothing", "object_set: .*BodySpec, got a NoneType"),
        ("my_parts:light", "object_set: mass .*, got -1"),
        ("my_parts:slippery", "object_set: friction .*, got nan"),
        ("my_parts:opaque", "object_set: colour .*, got"),
        ("my_parts:empty", "object_set: object 'my_parts:empty': pieces must"),
        ("my_parts:flat", "object_set: object 'my_parts:flat': sides must"),
        ("pallet", "object_set: .*got 'pallet'"),
        ("cube", "num_objects must .*1 .*, got 2"),
    ):
        with pytest.raises(ValueError, match=f"^{reason}"):
            make_env(GRASPING, object_set=[kind], num_objects=2)


NOTEBOOK = """
import pickle
import sys

import gymnasium

import bulletarm_gym
from my_parts import Picking

class Mine(Picking):
    pass

def half(scene, outcome):
    return 0.5

for component in (Mine, "__main__:Mine"):
    try:
        bulletarm_gym.register_task("Mine", component)
    except ValueError as error:
        assert "__main__:Mine" in str(error)
    else:
        raise AssertionError
with gymnasium.make("BulletArm/CloseLoopBlockPicking-v0", reward=half) as env:
    assert env.spec.kwargs["reward"] == "__main__:half"
sys.ps1 = ">>> "  # as in an interactive session
env = gymnasium.make(bulletarm_gym.register_task("Mine", Mine), obs_size=16)
env.reset(seed=0)
sys.stdout.buffer.write(pickle.dumps(env.unwrapped))
"""


def test_components_of_a_notebook_work_in_their_process():
    """A script's components and another process raise an error with the reason."""
    child = subprocess.run([sys.executable, "-c", NOTEBOOK], capture_output=True, check=True, cwd=HERE)
    with pytest.raises(ValueError, match=r"'__main__:Mine' cannot be imported.*Define it in a module"):
        pickle.loads(child.stdout)


CAMERAS = [{"name": "rgb", "size": 32}, {"name": "point_cloud", "points": 200}]
ALL = ["heightmap", "color", "segmentation", *CAMERAS, "joint_state", "holding"]


@pytest.mark.parametrize("env_id", [PICKING, STACKING])
def test_spaces_and_states_of_all_sensors(make, env_id):
    env, other = (make(env_id, instance, observation=ALL) for instance in range(2))
    check_env(env, skip_render_check=True)
    shapes = {name: array.shape for name, array in env.observe().items()}
    images = [("heightmap", (1, 128, 128)), ("color", (3, 128, 128)), ("segmentation", (1, 128, 128))]
    cameras = [("rgb", (3, 32, 32)), ("point_cloud", (200, 3))]
    assert list(shapes.items()) == [*images, *cameras, ("joint_state", (8,)), ("holding", (1,))]
    other.set_state(advance(env, 3, 2))
    assert digest(other.observe()) == digest(env.observe())
    assert transcript(env, 2) == transcript(other, 2)


def test_actions_and_states_do_not_depend_on_what_is_observed(make):
    """Heights of actions follow from the heightmap, whether or not the agent observes it."""
    env, plain = make(STACKING, observation=["holding"]), make(STACKING)
    for each in (env, plain):
        each.reset(seed=2)
    for _ in range(3):
        action = plain.expert_action()
        assert digest(*env.step(action)[1:]) == digest(*plain.step(action)[1:])
        assert env.get_state().world == plain.get_state().world and env.get_state().sensors == {}
    env.set_state(plain.get_state())
    with pytest.raises(ValueError, match="in_hand"):
        plain.set_state(env.get_state())


def test_actions_use_the_scene_as_it_is(make):
    """A user may have moved something since the last observation."""
    env = make(STACKING, seed=0)
    first, *others = env.scene
    first.place(Pose.planar(0.45, 0.0, 0.015))
    for number, item in enumerate(others):
        item.place(Pose.planar(0.3, -0.15 + 0.1 * number, 0.015))
    observation, *_ = env.step([-1.0, 0.0, 0.0, -1.0])
    assert observation["holding"] == 1.0 and observation["in_hand"].max() > 0.02


def test_joint_state_gives_the_tool_pose(make):
    env = make(PICKING, observation=["joint_state"], seed=0)
    observation, *_ = env.step([1.0, 0.5, 0.5, -0.5, 0.5])
    *joints, opening = observation["joint_state"]
    pose = env.scene.robot.model.chain.forward(np.array(joints, float))
    assert pose.position == pytest.approx(env.scene.robot.pose.position, abs=1e-5)
    assert opening == pytest.approx(1.0)


DOWN = [1.0, 0.0, 0.0, -0.5, 0.0]


def test_own_sensor_reads_and_remembers():
    env = gymnasium.make(PICKING, **own_sensor("Count", start=5)).unwrapped
    for _ in range(2):
        assert env.reset(seed=0)[0]["mine"].tolist() == [5.0, 0.0]
        for number in (6, 7):
            observation, *_ = env.step(DOWN)
            np.testing.assert_allclose(observation["mine"], [number, -0.025], atol=1e-4)
    state = env.get_state()
    copy = pickle.loads(pickle.dumps(env))
    env.step(DOWN)
    env.set_state(state)
    for each in (env, copy):
        assert digest(each.observe()) == digest(observation)
