"""Tasks: the start of an episode, success, the expert's number of steps, and rewards."""

import itertools
import math
import pickle
import re
from unittest.mock import patch

import gymnasium
import numpy as np
import pytest
from rollouts import CLOSE_STACKING, PICKING, REACHING, digest, finish, idle, is_open_loop, make_env

from bulletarm_gym.benchmarks import BENCHMARKS
from bulletarm_gym.experts import CLOSED, OPEN, Waypoint
from bulletarm_gym.geometry import Pose
from bulletarm_gym.objects import cube
from bulletarm_gym.objects.containers import CORNER_INSIDE
from bulletarm_gym.registry import ENVIRONMENTS, TASKS
from bulletarm_gym.scene import scaled
from bulletarm_gym.scene.predicates import loose_objects, touching
from bulletarm_gym.scene.sampling import footprint
from bulletarm_gym.tasks.picking import BlockPicking
from bulletarm_gym.tasks.progress import DISCOUNT
from bulletarm_gym.wrappers import InstructionInfo

ROWS = {
    row.env_id: row for name in ("close_loop_4d", "open_loop_3d") for row in BENCHMARKS[name].environments
}
CLOSE_LOOP = [env_id for env_id in ROWS if "/CloseLoop" in env_id and "Grasping" not in env_id]
OPEN_LOOP = {f"BulletArm/OpenLoop{name}-v0": seed for name, seed in (("BinPacking", 1), ("CovidTest", 4))}
OPEN_LOOP |= {f"BulletArm/OpenLoop{name}-v0": 1 for name in ("BottleArrangement", "BoxPalletizing")}
SLOPES = [f"BulletArm/OpenLoop{name}-v0" for name in ("BumpBoxPalletizing", "RampHouseBuilding2")]
FIXED = {"action_sequence": "pxyz", "random_orientation": False}
modes = pytest.mark.parametrize("mode", [{}, FIXED], ids=("random", "fixed"))


def task_id(name):
    return f"BulletArm/CloseLoop{name}-v0"


def follow(env, waypoint, steps):
    """Move towards a waypoint; return the last info."""
    for _ in range(steps):
        *_, info = env.step(env.control.encode_action(env.tracker.towards(waypoint)))
    return info


@modes
@pytest.mark.parametrize("env_id", [*CLOSE_LOOP, *OPEN_LOOP])
def test_expert_solves_in_the_papers_steps(make, env_id, mode):
    """In closed loop in about as many, on average."""
    env, lengths = make(env_id, **mode), []
    seeds, tolerance = ([OPEN_LOOP[env_id]], 0.0) if env_id in OPEN_LOOP else (range(5), 0.25)
    for seed in seeds:
        env.reset(seed=seed)
        solved, steps = finish(env)
        assert solved
        lengths.append(steps)
    assert np.mean(lengths) == pytest.approx(ROWS[env_id].optimal_steps, rel=tolerance)


@modes
@pytest.mark.parametrize("env_id", [*CLOSE_LOOP, *OPEN_LOOP, *SLOPES])
def test_objects_start_apart_inside_and_at_rest(make, env_id, mode):
    env = make(env_id, **mode)
    for seed in range(5):
        _, info = env.reset(seed=seed)
        assert info["is_valid"] and not info["is_success"]
        loose, before = loose_objects(env.scene), [item.pose.position for item in env.scene]
        assert all(footprint(item).is_inside(env.config.workspace) for item in loose)
        assert not any(touching(env.scene, *pair) for pair in itertools.combinations(loose, 2))
        env.scene.begin()
        env.scene.world.step(60)
        env.scene.world.end()
        np.testing.assert_allclose([item.pose.position for item in env.scene], before, atol=2e-3)


@pytest.mark.parametrize("view", ["orthographic", "point_cloud"])
def test_goal_of_a_push_is_in_the_image(make, view):
    env = make(task_id("BlockPushing"), view=view, seed=0)
    scene, heightmaps = env.scene, []
    scene["cube"].place(Pose.planar(0.4, 0.1, 0.025))
    for x in (0.5, 0.4):
        scene["goal"].place(Pose.planar(x, -0.08, 0.0))
        heightmaps.append(env.observe()["heightmap"][0])
    first, second = heightmaps
    side = 0.45 / env.config.obs_size
    for change in (first < second - 0.015, second < first - 0.015):
        assert change.sum() * side**2 == pytest.approx(0.09**2, rel=0.06)
    assert (second - first).max() == pytest.approx(0.02, abs=3e-3)


PLACED = [
    ("BlockPushing", {"goal": (0.5, 0.0, 0.0), "cube": (0.5, 0.0, 0.025)}, {"is_success": True}),
    ("BlockInBowl", {"bowl": (0.45, 0.0, 0.035), "cube": (0.45, 0.0, 0.08)}, {"is_success": True}),
    ("BlockInBowl", {"bowl": (0.45, 0.0, 0.035), "cube": (0.45, 0.12, 0.025)}, {"is_in_bowl": False}),
    ("HouseBuilding", {"cube": (0.45, 0.0, 0.025), "triangle": (0.45, 0.0, 0.0755)}, {"is_success": True}),
    ("HouseBuilding", {"triangle": (0.45, 0.0, 0.025), "cube": (0.45, 0.0, 0.0755)}, {"is_success": False}),
]


@pytest.mark.parametrize(("name", "placed", "facts"), PLACED, ids=str)
def test_success_of_placed_objects(make, name, placed, facts):
    env = make(task_id(name), seed=0)
    for slot, position in placed.items():
        env.scene[slot].place(Pose(position))
    assert np.isfinite(env.expert_action()).all()
    *_, info = env.step(np.array([1.0, 0.0, 0.0, 0.0, 0.0]))
    assert facts.items() <= info.items() and info["is_valid"]
    if name == "BlockPushing":
        assert env.scene["cube"].pose.z == pytest.approx(0.025, abs=2e-4), "the goal is not an obstacle"


def test_orientation_is_fixed(make):
    """The drawer opens to either side."""
    names = ("BlockPushing", "DrawerOpening", "CornerPicking")
    pushing, drawer, corner = envs = [make(task_id(name), **FIXED) for name in names]
    for seed in range(20):
        for env in envs:
            env.reset(seed=seed)
        assert corner.scene["corner"].pose.yaw == 0.0
        cube, goal = pushing.scene["cube"].pose, pushing.scene["goal"].pose
        assert cube.x == goal.x and cube.yaw == 0.0 and abs(cube.y - goal.y) >= 0.09
        assert abs(drawer.scene["drawer"].pose.yaw) == pytest.approx(math.pi / 2.0)
        assert drawer.scene["drawer"].joints == (0.0,)


def test_cube_grasped_in_the_bowl_is_not_a_success(make):
    env = make(task_id("BlockInBowl"), seed=1)
    while env.scene.held is None:
        env.step(env.expert_action())
    x, y, _ = env.scene["bowl"].pose.position
    tool = env.scene.robot.pose
    follow(env, Waypoint(Pose.planar(tool.x, tool.y, 0.13, tool.yaw), CLOSED), 3)
    follow(env, Waypoint(Pose.planar(x, y, 0.13, tool.yaw), CLOSED), 6)
    info = follow(env, Waypoint(Pose.planar(x, y, 0.034, tool.yaw), CLOSED), 2)
    assert info["is_in_bowl"] and not info["is_empty"] and not info["is_success"]


def test_cube_is_next_to_both_walls_of_the_corner(make):
    env = make(task_id("CornerPicking"))
    for seed in range(20):
        env.reset(seed=seed)
        inside = env.scene["corner"].pose.inverse().compose(env.scene["cube"].pose)
        assert inside.position[:2] == pytest.approx((CORNER_INSIDE + 0.025,) * 2, abs=1e-3)
        assert abs(inside.yaw) < 0.01


@pytest.mark.parametrize("robot", ["kuka", "ur5_robotiq"])
@pytest.mark.parametrize("yaw", [0.0, math.pi / 4.0, math.pi / 2.0])
def test_straight_pick_fails_in_the_corner(make, robot, yaw):
    env = make(task_id("CornerPicking"), robot=robot, seed=0)
    cube, yaw = env.scene["cube"].pose, env.scene["corner"].pose.yaw + yaw
    follow(env, Waypoint(Pose.planar(cube.x, cube.y, 0.2, yaw), OPEN), 8)
    follow(env, Waypoint(Pose.planar(*cube.position, yaw), OPEN, finish=CLOSED), 6)
    tool = env.scene.robot.pose
    follow(env, Waypoint(Pose.planar(tool.x, tool.y, tool.z, yaw), CLOSED), 1)
    info = follow(env, Waypoint(Pose.planar(tool.x, tool.y, 0.22, yaw), CLOSED), 5)
    assert not info["is_success"] and not info["is_held"]
    assert env.scene["cube"].pose.z < 0.06


def test_drawer_is_open_beyond_15_cm(make):
    env = make(task_id("DrawerOpening"), observation=["heightmap", "state"], seed=0)
    for opened, success in ((0.14, False), (0.151, True)):
        env.scene["drawer"].set_joints((opened,))
        observation, *_, info = env.step(np.zeros(5))
        assert info["is_success"] is success and info["is_valid"]
        assert env.scene["drawer"].joints[0] == pytest.approx(opened, abs=1e-4)
        assert observation["state"][-1] == pytest.approx(opened, abs=1e-4)


def test_built_in_tasks_have_several_instructions_of_their_own():
    tasks = {kwargs["task"]: TASKS.find(kwargs["task"]) for kwargs in ENVIRONMENTS.values()}
    own = {task.__name__: task.instructions for task in tasks.values()}
    assert own.pop("OpenLoopObjectGrasping") == own["ObjectGrasping"]
    assert all(len(sentences) > 1 for sentences in own.values())
    sentences = [sentence for several in own.values() for sentence in several]
    assert len(set(sentences)) == len(sentences)
    assert all(re.fullmatch(r"[A-Z][^.\n]+\.", sentence) for sentence in sentences)


def test_instructions_name_the_surface_and_the_number_of_objects(make):
    ramp = "BulletArm/OpenLoopRampBlockStacking-v0"
    for env_id, parameters, instruction in (
        (PICKING, {}, "Grasp a cube and lift it."),
        (PICKING, {"close_loop_tray": True}, "Grasp a cube in the tray and lift it."),
        (task_id("ObjectGrasping"), {}, "Grasp any object in the tray and lift it."),
        (ramp, {"num_objects": 3}, "Stack 3 cubes on the ground with ramps."),
        (PICKING, {"task": f"{__name__}:BlockShaking"}, "Block shaking."),
    ):
        env = make(env_id, **parameters)
        assert env.instruction == env.task_description == env.instructions[0] == instruction


def test_info_of_reset_has_a_sampled_instruction(make):
    """The wrapper does not change the episodes."""
    plain = make(PICKING, 1)
    env = InstructionInfo(plain)
    _, info = env.reset(seed=4)
    found = [info.pop("instruction"), *(env.reset()[1]["instruction"] for _ in range(20))]
    assert set(found) == set(plain.instructions) and len(set(found)) > 1
    after = digest(plain.observe())
    assert info == plain.reset(seed=4)[1]
    for _ in range(20):
        observation, _ = plain.reset()
    assert digest(observation) == after
    assert env.reset(seed=4)[1]["instruction"] == found[0]
    assert "instruction" not in env.step(np.zeros(5))[-1]


def test_vector_environments_have_the_attributes_of_lerobots_evaluation():
    envs = gymnasium.make_vec(PICKING, 2, vectorization_mode="sync", max_episode_steps=9)
    assert envs.call("_max_episode_steps") == (9, 9)
    assert envs.call("task_description") == ("Grasp a cube and lift it.",) * 2
    assert hasattr(envs.envs[0], "task_description"), "LeRobot passes an empty task without it"


class BlockShaking(BlockPicking):
    instructions = ()


def test_mistake_of_a_task_is_named():
    for name, value, message in (
        *(
            ("instructions", value, r"^instructions of BlockShaking must be .*, got ")
            for value in ("Lift it.", ("Lift {what}.",), ("Lift {surface.what}.",), (3,))
        ),
        ("bodies", lambda task, config: None, r"bodies\(\) of BlockShaking must"),
        ("bodies", lambda *arguments: 2 * BlockPicking.bodies(*arguments), r"bodies\(\) of .* must"),
        ("bodies", lambda task, config: [scaled(config, "cube", cube, like="bowl")], "earlier slot .*'bowl'"),
        *(
            ("evaluate", lambda task, scene, value=value: value, r"^evaluate\(\) of .* with 'success'")
            for value in (None, {"is_success": True}, {"success": True, "ignored": False})
        ),
        ("plan", lambda task, scene, rng: None, r"plan\(\) .* got none"),
        ("plan", lambda task, scene, rng: [scene["cube"].pose], r"plan\(\) .* Waypoint .*, got Pose"),
    ):
        with patch.object(BlockShaking, name, value), pytest.raises(ValueError, match=message):
            env = make_env(PICKING, task=f"{__name__}:BlockShaking", obs_size=16)
            env.reset(seed=0)
            env.expert_action()


def test_stack_in_the_gripper_is_not_a_success(make):
    env = make(task_id("BlockStacking"), seed=0)
    success = held = False
    while not success:
        held = env.scene.held is not None
        *_, info = env.step(env.expert_action())
        success = info["is_success"]
        assert not (success and env.scene.held is not None)
    assert held, "the step before released it"


IDS = (PICKING, CLOSE_STACKING, "BulletArm/CloseLoopDrawerOpening-v0", "BulletArm/OpenLoopHouseBuilding1-v0")
SENSORS = {"observation": ["holding"], "reward": "progress"}


def rewards_to_the_end(env, before=0):
    """Return the rewards of idle steps and then the expert's, and whether the episode terminated."""
    rewards, terminated, truncated = [], False, False
    while not (terminated or truncated):
        action = idle(env) if len(rewards) < before else env.expert_action()
        _, reward, terminated, truncated, _ = env.step(action)
        rewards.append(reward)
    return rewards, terminated


def discounted(rewards):
    return sum(DISCOUNT**step * reward for step, reward in enumerate(rewards))


def paid(scene, outcome):
    return 0.25 + 2.0 * outcome["is_success"]


@pytest.mark.parametrize("kind", ["path", "function", "lambda"])
def test_rewards_are_functions_of_scene_and_info(kind):
    path = f"{paid.__module__}:paid"
    reward = {"path": path, "function": paid, "lambda": lambda scene, info: paid(scene, info)}[kind]
    env = gymnasium.make(REACHING, obs_size=16, reward=reward)
    again = gymnasium.make(env.spec)
    for each in (env, again, *([] if kind == "lambda" else [pickle.loads(pickle.dumps(env))])):
        core = each.unwrapped
        each.reset(seed=0)
        rewards = [each.step(core.expert_action())[1] for _ in range(3)]
        assert rewards == [0.25, 0.25, 2.25]
        assert kind == "lambda" or (core.config.reward == path and path in each.spec.to_json())


def test_rewards_must_be_finite_numbers():
    value = [None]
    env = make_env(PICKING, obs_size=16, reward=lambda scene, outcome: value[0])
    for value[0] in (None, math.nan, "1.0", [1.0]):
        env.reset(seed=0)
        with pytest.raises(
            ValueError, match=rf"^reward must be .*, got {re.escape(repr(value[0]))}: .*:.*lambda"
        ):
            env.step(idle(env))
    for path in ("no:where", "math:pi"):
        with pytest.raises(ValueError, match=rf"reward must be .*, got '{path}'"):
            make_env(PICKING, reward=path)


@pytest.mark.parametrize("env_id", IDS)
def test_shaping_subtracts_the_same_potential_from_the_return_of_all_actions(make, env_id):
    """Ng et al. 1999: so the order of policies does not change; at the end the potential is 0."""
    env = make(env_id, **SENSORS)
    starts = []
    for before in (0, 2):
        env.reset(seed=3)
        rewards, terminated = rewards_to_the_end(env, before)
        assert terminated
        starts.append(discounted([0.0] * (len(rewards) - 1) + [1.0]) - discounted(rewards))
    assert starts[0] == pytest.approx(starts[1], abs=1e-9)
    assert 0.0 <= starts[0] < 1.0


def test_progress_rewards_the_expert_and_punishes_lost_progress(make):
    env = make(PICKING, **SENSORS, seed=0)
    rewards, _ = rewards_to_the_end(env)
    assert min(rewards) > 0.0 and max(rewards[:-1]) < 1.0
    env.reset(seed=0)
    while not env.step(env.expert_action())[-1]["is_held"]:
        pass
    assert env.step([1.0, 0.0, 0.0, 0.0, 0.0])[1] < -0.3
    env.scene["cube"].place(Pose((0.9, 0.0, 0.025)))
    _, reward, terminated, _, info = env.step(idle(env))
    assert terminated and not info["is_valid"] and reward < 0.0


@pytest.mark.slow
def test_expert_makes_progress_in_every_task(env_id):
    env = make_env(env_id, **SENSORS)
    env.reset(seed=0)
    rewards, terminated = rewards_to_the_end(env)
    assert terminated and (np.abs(rewards) <= 1.0).all()
    assert is_open_loop(env_id) or (np.array(rewards[:-1]) > 0.0).mean() > 0.5
    finished, parts = env.task.parts(env.scene, np.random.default_rng(0))
    assert finished >= parts - 1
