"""Experts solve their tasks, recover from failures, respect the limits of the control, build structures."""

import math

import numpy as np
import pytest
from rollouts import CLOSE_STACKING, PICKING, STACKING, digest, finish, make_env
from small_arm import PARAMETERS, SMALL

from bulletarm_gym.control import CloseLoop, RobotInterface
from bulletarm_gym.demonstrations import collect
from bulletarm_gym.experts.approach import avoid_limits
from bulletarm_gym.geometry import Pose, euler_pose
from bulletarm_gym.observations import View
from bulletarm_gym.robots import Robot
from bulletarm_gym.scene import Scene, SceneObject
from bulletarm_gym.scene import predicates as are
from bulletarm_gym.simulation import Body, World
from bulletarm_gym.tasks import Task


def solve(env):
    """Solve the first or the second of two seeds: experts fail in up to one of 25 scenes."""
    for seed in (0, 100):
        env.reset(seed=seed)
        if finish(env)[0]:
            return
    raise AssertionError


@pytest.mark.parametrize(
    "parameters",
    [
        {"action_sequence": "pxyz", "random_orientation": False, "fast_mode": False},
        {"action_sequence": "rzyxp", "obs_size": 32, "physics_mode": "slow"},
    ],
    ids=str,
)
def test_expert_solves_under_other_parameters(make, typical_id, parameters):
    few = {"num_objects": 6} if "Palletizing" in typical_id else {}
    solve(make(typical_id, **parameters, **few))


def test_long_blocks_of_structures_stay_inside_the_workspace(make):
    env = make("BulletArm/OpenLoopHouseBuilding4-v0", workspace_check="bounding_box")
    for seed in (2, 7):
        env.reset(seed=seed)
        assert finish(env)[0]


SMALLEST = {"workspace": [[0.4, 0.44], [-0.02, 0.02], [0.005, 0.12]], "object_scale_range": 0.3}
"""The smallest workspace, and a cube of 1.5 cm."""


@pytest.mark.parametrize(
    ("task", "scale", "most"), [("CloseLoopBlockPushing", 0.5, 20), ("OpenLoopBinPacking", 0.6, 16)]
)
def test_fingers_open_by_less_than_the_stroke_for_small_objects(make, task, scale, most):
    """Cubes are pushed by both fingers instead of passing between them, and slabs are grasped across."""
    env = make(f"BulletArm/{task}-v0", object_scale_range=scale)
    for seed in (1, 2):
        env.reset(seed=seed)
        solved, steps = finish(env)[:2]
        assert solved and steps <= most


def test_expert_solves_tasks_in_a_small_workspace():
    for task, parameters in (
        ("CloseLoopBlockPicking", {**SMALLEST, "home_height": 0.1, "lift_height": 0.08}),
        ("OpenLoopBlockStacking", {"robot": SMALL, **PARAMETERS, "num_objects": 2}),
    ):
        env, solved = make_env(f"BulletArm/{task}-v0", **parameters), 0
        for seed in range(5):
            env.reset(seed=seed)
            assert env.scene.robot.pose.z == pytest.approx(env.config.home_height, abs=1e-3)
            solved += finish(env)[0]
        assert solved >= 4


def test_expert_recovers_from_random_actions(make, typical_id):
    few = {"num_objects": 6} if "Palletizing" in typical_id else {}
    env, solved = make(typical_id, max_steps=80, **few), []
    for seed in range(3):
        for action_seed in range(20):
            rng = np.random.default_rng((seed, action_seed))
            env.reset(seed=seed)
            actions = (rng.uniform(-1, 1, env.action_space.shape) for _ in range(10))
            if not any(any(env.step(action)[2:4]) for action in actions):
                break
        solved.append(finish(env)[0])
    assert sum(solved) >= 2


@pytest.mark.parametrize("height", [0.06, 0.125])
def test_expert_keeps_clear_of_the_last_joint_limit_at_every_height(make, height):
    """Near that limit one of these heights is reached in a straight motion, the other is not."""
    env = make("BulletArm/CloseLoopBinPacking-v0", robot="panda", seed=0)
    env.scene.robot.home(Pose.planar(0.3532, 0.1133, 0.125, -0.293))
    goal = avoid_limits(env.scene, Pose.planar(0.3531, 0.1137, height, 2.849))
    assert goal.yaw == pytest.approx(2.849 - np.pi)


SIMULATED = (Scene, World, SceneObject, Body, Robot, Task)


class SmallSteps(CloseLoop):
    """Closed-loop control with a fifth of the limits."""

    max_translation = 0.01
    max_rotation = math.pi / 20.0


def reachable(thing, seen):
    """Yield an object and all objects that its attributes lead to; of interface and view, the public ones."""
    if id(thing) in seen:
        return
    seen.add(id(thing))
    yield thing
    parts = list(thing) if isinstance(thing, tuple | list) else []
    if isinstance(thing, RobotInterface | View):
        parts += [getattr(thing, name) for name in dir(thing) if not name.startswith("_")]
    elif type(thing).__module__.startswith("bulletarm_gym"):
        parts += getattr(thing, "__dict__", {}).values()
    for part in parts:
        if not callable(part):
            yield from reachable(part, seen)


@pytest.mark.parametrize("env_id", [PICKING, "BulletArm/OpenLoopHouseBuilding2-v0"])
def test_control_reaches_no_simulated_object(make, env_id):
    env = make(env_id, seed=0)
    while env.scene.held is None:
        env.step(env.expert_action())
    assert any(isinstance(thing, Scene) for thing in reachable(env.tracker, set()))
    for start in (env.control, env.look()):
        assert not [thing for thing in reachable(start, set()) if isinstance(thing, SIMULATED)]


def test_expert_respects_the_limits_of_the_control(make):
    env = make(PICKING, control=f"{__name__}:SmallSteps", max_steps=200, seed=1)
    move = env.decode_action(env.expert_action())
    assert max(map(abs, move.translation)) <= 0.01 + 1e-9
    assert abs(move.rotation) <= math.pi / 20.0 + 1e-9
    assert finish(env)[0]


CUBE = 0.03
CENTRE = 0.45
HOUSE_1 = "BulletArm/OpenLoopHouseBuilding1-v0"
HOUSE_2 = "BulletArm/OpenLoopHouseBuilding2-v0"
HOUSE_3 = "BulletArm/OpenLoopHouseBuilding3-v0"
HOUSE_4 = "BulletArm/OpenLoopHouseBuilding4-v0"
IMPROVISE_2 = "BulletArm/OpenLoopImproviseHouseBuilding2-v0"
IMPROVISE_3 = "BulletArm/OpenLoopImproviseHouseBuilding3-v0"
RAMP = "BulletArm/OpenLoopRampHouseBuilding2-v0"
BUMP = "BulletArm/OpenLoopBumpHouseBuilding4-v0"
PAIR = {"cube_0": (-0.025, 0.0), "cube_1": (0.025, 0.0)}


def lay(env, **places):
    """Place blocks at y, height of their lowest points and, if given, x and yaw; all others aside."""
    env.reset(seed=0)
    aside = np.linspace(-0.16, 0.16, len(env.scene.objects)).tolist()
    for y, obj in zip(aside, env.scene.objects, strict=True):
        obj.place(Pose.planar(0.32, y, CUBE / 2.0, math.pi / 2.0))
    for name, (y, low, *rest) in places.items():
        x, yaw = (*rest, CENTRE, 0.0)[:2] if len(rest) != 1 else (rest[0], 0.0)
        env.scene[name.replace("_", " ")].place(Pose.planar(x, y, low + CUBE / 2.0, yaw))
    return env


@pytest.fixture
def cubes(make):
    env = make(CLOSE_STACKING, num_objects=3, seed=0)
    return env.scene


def place(scene, *positions):
    """Place the cubes of 5 cm relative to x = 0.45, y = 0 m."""
    for obj, (x, y, z) in zip(scene.objects, positions, strict=True):
        obj.place(Pose.planar(0.45 + x, y, z))
    return scene.objects


def test_stacked(cubes):
    for positions, expected in (
        (((0.0, 0.0, 0.125), (0.01, 0.0, 0.025), (0.0, 0.01, 0.075)), True),
        (((0.0, 0.0, 0.125), (0.1, 0.0, 0.025), (0.0, 0.01, 0.075)), False),
        (((0.0, 0.0, 0.135), (0.0, 0.0, 0.035), (0.0, 0.0, 0.085)), False),  # not on the surface
        (((0.0, 0.0, 0.025), (0.0, 0.05, 0.025), (0.0, 0.025, 0.075)), False),  # two at one level
    ):
        assert are.stacked(cubes, place(cubes, *positions)) is expected


def test_relations_of_two_cubes(cubes):
    for aside, expected in ((0.024, True), (0.026, False)):
        first, second, _ = place(cubes, (0.0, 0.0, 0.025), (0.0, aside, 0.075), (0.1, 0.1, 0.075))
        assert are.on_top(cubes, first, second) is expected
        assert not are.on_top(cubes, second, first)
    assert [are.is_top(obj, cubes.objects) for obj in cubes.objects] == [False, True, True]
    for gap, expected in ((0.001, True), (0.003, False)):
        first, second, _ = place(cubes, (0.0, 0.0, 0.025), (0.0, 0.05 + gap, 0.025), (0.1, -0.1, 0.025))
        assert are.touching(cubes, first, second) is expected


def test_poses_of_one_cube(cubes):
    cube = cubes.objects[0]
    for degrees, is_upright in ((19.0, True), (21.0, False), (90.0, False)):
        cube.place(euler_pose((0.45, 0.0, 0.1), (0.0, math.radians(degrees), 0.0)))
        assert are.upright(cube) is is_upright
    edge = euler_pose((0.45, 0.0, 0.025 * math.sqrt(2.0)), (math.pi / 4.0, 0.0, 0.0))
    for pose in (Pose.planar(0.45, 0.0, 0.025, 0.3), edge, Pose((0.45, 0, 0.03))):
        cube.place(pose)
        assert are.on_surface(cubes, cube) is (pose.z != 0.03)
    cubes.begin()
    cubes.world.step(3)
    cubes.world.end()
    assert not are.at_rest(cubes)


def test_a_block_at_the_edge_of_a_ramp_is_on_the_ground_but_not_on_the_site(make):
    scene = make(RAMP, seed=0).scene
    ramp, cube = scene.surface.ramps[0], scene.objects[0]
    for distance, expected in ((-0.01, (True, False)), (-0.03, (True, True)), (0.1, (False, False))):
        x, y = np.add(ramp.edge[:2], distance * np.array(ramp.uphill[:2]))
        cube.place(scene.surface.lay(cube.spec, (x, y), 0.0))
        assert (are.on_ground(scene, cube), are.on_site(scene, cube)) == expected, distance


ROOF = {**PAIR, "roof": (0.0, CUBE)}
BORDER = 0.645
"""x (m) of cubes whose centres are in the workspace, but not their sides."""
UPPER = {"cube_2": (-0.03, 2 * CUBE), "cube_3": (0.03, 2 * CUBE), "roof": (0.0, 3 * CUBE)}
FOUR_LAYERS = {**PAIR, "brick": (0.0, CUBE), **UPPER}


def test_success_of_a_house(make):
    for env_id, blocks, expected in (
        (HOUSE_2, ROOF, True),
        (HOUSE_2, {**ROOF, "roof": (0.0, CUBE, CENTRE + 0.012, math.pi)}, True),
        (HOUSE_2, {**ROOF, "roof": (0.028, CUBE)}, True),
        (HOUSE_2, {**ROOF, "roof": (0.032, CUBE)}, False),
        (HOUSE_2, {**ROOF, "roof": (0.0, CUBE, CENTRE, math.radians(24.0))}, True),
        (HOUSE_2, {**ROOF, "roof": (0.0, CUBE, CENTRE, math.radians(27.0))}, False),
        (HOUSE_2, {**ROOF, "roof": (0.0, CUBE + 0.004)}, False),
        (HOUSE_2, {**ROOF, "cube_1": (-0.025, 0.0, CENTRE, 0.5), "cube_0": (0.025, 0.0, CENTRE, 2.0)}, True),
        (HOUSE_2, {**ROOF, "cube_0": (0.0, 0.0), "cube_1": (0.1, 0.0)}, False),
        (HOUSE_2, {name: (y, low, BORDER, 0.0) for name, (y, low) in ROOF.items()}, True),
        (HOUSE_4, FOUR_LAYERS, True),
        (HOUSE_4, {**FOUR_LAYERS, "cube_0": (-0.03, 2 * CUBE), "cube_2": (-0.025, 0.0)}, True),
        (HOUSE_4, {**FOUR_LAYERS, "cube_3": (0.1, 0.0)}, False),
        (HOUSE_4, {**FOUR_LAYERS, "brick": (0.0, 3 * CUBE), "roof": (0.0, CUBE)}, False),
        (HOUSE_4, {**FOUR_LAYERS, "brick": (0.0, CUBE, CENTRE, 0.5)}, False),
    ):
        env = lay(make(env_id), **blocks)
        assert env.task.evaluate(env.scene)["success"] is expected


@pytest.mark.parametrize("env_id", [HOUSE_2, RAMP])
def test_a_fallen_roof_ends_the_episode(make, env_id):
    env = make(env_id, seed=0)
    roof = env.scene["roof"]
    assert env.task.is_valid(env.scene)
    roof.place(roof.pose.compose(euler_pose((0.0, 0.0, 0.0), (math.pi, 0.0, 0.0))))
    _, reward, terminated, _, info = env.step(env.expert_action())
    assert (reward, terminated, info["is_valid"]) == (0.0, True, False)


def test_expert_needs_two_steps_a_block(make):
    """The first block stays where it is, except on bumps."""
    for env_id, parameters, picks, *seeds in (
        (HOUSE_4, {}, 5, 1),
        (IMPROVISE_3, {}, 3, 1),
        (BUMP, {}, 6, 1),
        (HOUSE_1, {"action_sequence": "xyzrrr"}, 3, 1),
        (HOUSE_1, {"half_rotation": False, "workspace": [[0.3, 0.6], [-0.1, 0.2], [0.0, 0.5]]}, 3, 1),
        (HOUSE_1, {"object_scale_range": [0.5, 0.8], "num_objects": 3}, 2, 1),
        # Blocks of these seeds are grasped off their middles, and their line points backwards.
        (IMPROVISE_2, {"action_sequence": "pxy", "random_orientation": False}, 2, 25, 78, 111),
    ):
        for seed in seeds:
            assert finish(make(env_id, **parameters, seed=seed)) == (True, 2 * picks)


def test_expert_takes_wrong_structures_apart(make):
    for wrong, steps in (
        ({"cube_0": (0.0, 0.0), "brick": (0.0, CUBE)}, 8),
        ({**PAIR, "roof": (0.0, CUBE)}, 6),
        ({**PAIR, "brick": (0.0, CUBE, CENTRE, 1.0)}, 4),
        ({"cube_0": (0.0, 0.0), "cube_1": (0.0, CUBE)}, 6),
        ({"brick": (0.0, 0.0), "cube_0": (-0.03, CUBE), "cube_1": (0.03, CUBE)}, 8),
    ):
        solved, count = finish(lay(make(HOUSE_3), **wrong))
        assert solved and count <= steps


@pytest.mark.parametrize("env_id", [STACKING, IMPROVISE_3, RAMP, CLOSE_STACKING])
def test_goal_starts_are_solved_and_repeatable(make, env_id):
    env = make(env_id)
    for seed in range(2):
        first, info = env.reset(seed=seed, options={"start": "goal"})
        assert info["is_success"] and info["is_valid"] and first in env.observation_space
        assert digest(first) == digest(env.reset(seed=seed, options={"start": "goal"})[0])


def test_demonstrations_rebuild_the_structure(make):
    for env_id, env_kwargs in (
        (STACKING, {"action_sequence": "pxy", "random_orientation": False}),
        (IMPROVISE_3, {}),
        *((HOUSE_1, {"robot": robot}) for robot in ("panda", "ur5_robotiq")),
    ):
        demonstrations = collect(env_id, 2, "deconstruction", seed=0, env_kwargs=env_kwargs)
        assert demonstrations.attempts <= 3
        env = make(env_id, **env_kwargs)
        steps = 2 * (env.config.num_objects - 1)
        for episode in demonstrations:
            holding, in_hand = (episode.observations[name][:-1] for name in ("holding", "in_hand"))
            for is_held in (holding[:, 0] == 1.0, in_hand.any(axis=(1, 2, 3))):
                np.testing.assert_array_equal(is_held, np.resize([False, True], steps))
        env.set_state(demonstrations[0].state)
        if "random_orientation" in env_kwargs:
            assert [obj.pose.yaw for obj in env.scene] == pytest.approx([0.0] * 4, abs=1e-4)
