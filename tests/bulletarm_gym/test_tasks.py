"""Each task: where its bodies start, what counts as success, what its expert does."""

import itertools
import math
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from rollouts import make_env

from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.experts import CLOSED, OPEN, Waypoint
from bulletarm_gym.geometry import Pose
from bulletarm_gym.objects.containers import CORNER_INSIDE
from bulletarm_gym.scene import Scene
from bulletarm_gym.scene.predicates import touching
from bulletarm_gym.tasks.picking import BlockPicking

Make = Callable[..., ManipulationEnv]

PAPER_STEPS = {
    "BlockReaching": 3,
    "BlockPicking": 7,
    "BlockPushing": 7,
    "BlockPulling": 7,
    "BlockInBowl": 11,
    "BlockStacking": 12,
    "HouseBuilding": 12,
    "CornerPicking": 14,
    "DrawerOpening": 9,
}
"""Optimal numbers of steps (paper, table of the Close-Loop 4D Benchmark)."""
FIXED = {"action_sequence": "pxyz", "random_orientation": False}
MODES = ({}, FIXED)


def task_id(name: str) -> str:
    return f"BulletArm/CloseLoop{name}-v0"


def solve(env: ManipulationEnv) -> int:
    """Let the expert go on; return after how many steps it has succeeded, 0 if it has not."""
    for step in itertools.count(1):
        *_, terminated, truncated, info = env.step(env.expert_action())
        if terminated or truncated:
            return step if info["is_success"] else 0
    raise AssertionError


def follow(env: ManipulationEnv, waypoint: Waypoint, steps: int) -> dict[str, bool]:
    """Move towards a waypoint; return the last info."""
    for _ in range(steps):
        *_, info = env.step(env.control.encode_action(env.tracker.towards(waypoint)))
    return info


@pytest.mark.parametrize("name", PAPER_STEPS)
@pytest.mark.parametrize("mode", MODES, ids=("random", "fixed"))
def test_expert_solves_in_about_the_papers_steps(make: Make, name: str, mode: dict) -> None:
    env = make(task_id(name), **mode)
    lengths = []
    for seed in range(10):
        env.reset(seed=seed)
        lengths.append(solve(env))
    assert all(lengths), lengths
    assert 0.8 <= np.mean(lengths) / PAPER_STEPS[name] <= 1.2


@pytest.mark.parametrize("name", PAPER_STEPS)
def test_expert_recovers_from_what_chance_has_done(make: Make, name: str) -> None:
    env = make(task_id(name))
    solved = []
    for seed in range(5):
        env.reset(seed=seed)
        rng = np.random.default_rng(seed)
        ended = False
        for _ in range(10):
            *_, terminated, _, _ = env.step(rng.uniform(-1.0, 1.0, 5))
            ended = ended or terminated
        solved.append(ended or solve(env) > 0)
    assert sum(solved) >= 4


@pytest.mark.parametrize("name", ["BlockStacking", "HouseBuilding"])
@pytest.mark.parametrize("count", [3, 4])
def test_expert_builds_higher(make: Make, name: str, count: int) -> None:
    env = make(task_id(name), num_objects=count)
    solved = []
    for seed in range(3):
        env.reset(seed=seed)
        solved.append(solve(env))
    assert all(solved)


def outline(scene: Scene, workspace: list[list[float]]) -> float:
    """Return the least distance (m) of a loose item's outline to the border, negative beyond it."""
    limits = np.array(workspace)[:2]
    bounds = [item.spec.mesh.moved(item.pose).bounds[:, :2] for item in scene if item.spec.mass > 0.0]
    return min((min((b[0] - limits[:, 0]).min(), (limits[:, 1] - b[1]).min()) for b in bounds), default=0.0)


@pytest.mark.parametrize("name", PAPER_STEPS)
@pytest.mark.parametrize("mode", MODES, ids=("random", "fixed"))
def test_arrangements_keep_apart_and_inside(make: Make, name: str, mode: dict) -> None:
    env = make(task_id(name), **mode)
    for seed in range(200):
        _, info = env.reset(seed=seed)
        assert info["is_valid"] and not info["is_success"]
        assert outline(env.scene, env.config.workspace) >= 0.0
        loose = [item for item in env.scene if item.spec.mass > 0.0]
        for first, second in itertools.combinations(loose, 2):
            assert not touching(env.scene, first, second)


@pytest.mark.parametrize("name", PAPER_STEPS)
def test_arrangements_are_at_rest(make: Make, name: str) -> None:
    env = make(task_id(name))
    for seed in range(10):
        env.reset(seed=seed)
        before = [item.pose for item in env.scene]
        env.scene.begin()
        env.scene.world.step(60)
        env.scene.world.end()
        for pose, item in zip(before, env.scene, strict=True):
            assert math.dist(pose.position, item.pose.position) < 2e-3


# Pushing


def test_moving_only_the_goal_changes_the_image(make: Make) -> None:
    for view in ("orthographic", "point_cloud"):
        env = make(task_id("BlockPushing"), view=view)
        env.reset(seed=0)
        scene = env.scene
        scene["cube"].place(Pose.planar(0.4, 0.1, 0.025))
        scene["goal"].place(Pose.planar(0.5, -0.08, 0.0))
        first = env.observe()["heightmap"][0]
        scene["goal"].place(Pose.planar(0.4, -0.08, 0.0))
        second = env.observe()["heightmap"][0]
        side = 0.45 / env.config.obs_size
        for change in (first < second - 0.015, second < first - 0.015):
            assert change.sum() * side**2 == pytest.approx(0.09**2, rel=0.06)
        assert (second - first).max() == pytest.approx(0.02, abs=3e-3)


def test_goal_is_no_obstacle(make: Make) -> None:
    env = make(task_id("BlockPushing"))
    env.reset(seed=0)
    goal, cube = env.scene["goal"], env.scene["cube"]
    cube.place(goal.pose.compose(Pose((0.0, 0.0, 0.025))))
    *_, info = env.step(np.zeros(5))
    assert info["is_success"]
    assert cube.pose.z == pytest.approx(0.025, abs=2e-4)


def test_fixed_orientation_puts_cube_and_goal_in_line(make: Make) -> None:
    env = make(task_id("BlockPushing"), **FIXED)
    for seed in range(20):
        env.reset(seed=seed)
        cube, goal = env.scene["cube"].pose, env.scene["goal"].pose
        assert cube.x == goal.x and cube.yaw == 0.0
        assert abs(cube.y - goal.y) >= 0.09


# In bowl


def bowl_with(env: ManipulationEnv, offset: tuple[float, float], height: float) -> dict[str, bool]:
    """Drop the cube over the bowl; return what a step finds."""
    env.reset(seed=0)
    env.scene["bowl"].place(Pose.planar(0.45, -0.03, 0.035))
    env.scene["cube"].place(Pose.planar(0.45 + offset[0], -0.03 + offset[1], height))
    *_, info = env.step(np.array([1.0, 0.0, 0.0, 0.0, 0.0]))
    return info


def test_bowl_is_hollow(make: Make) -> None:
    env = make(task_id("BlockInBowl"))
    info = bowl_with(env, (0.0, 0.0), 0.08)
    assert info["is_success"]
    assert env.scene["cube"].pose.z < 0.035
    assert env.scene["bowl"].spec.extents == pytest.approx((0.16, 0.16, 0.07))


def test_cube_beside_the_bowl_does_not_count(make: Make) -> None:
    info = bowl_with(make(task_id("BlockInBowl")), (0.0, 0.12), 0.025)
    assert info["is_valid"] and not info["is_in_bowl"] and not info["is_success"]


def test_cube_held_in_the_bowl_does_not_count(make: Make) -> None:
    env = make(task_id("BlockInBowl"))
    env.reset(seed=1)
    while env.scene.held is None:
        env.step(env.expert_action())
    x, y, _ = env.scene["bowl"].pose.position
    hand = env.scene.robot.pose
    follow(env, Waypoint(Pose.planar(hand.x, hand.y, 0.13, hand.yaw), CLOSED), 3)
    follow(env, Waypoint(Pose.planar(x, y, 0.13, hand.yaw), CLOSED), 6)
    info = follow(env, Waypoint(Pose.planar(x, y, 0.034, hand.yaw), CLOSED), 2)
    assert info["is_in_bowl"] and not info["is_empty"] and not info["is_success"]


# Stacking


def test_stack_in_the_gripper_does_not_count(make: Make) -> None:
    env = make(task_id("BlockStacking"))
    env.reset(seed=0)
    success = held = False
    while not success:
        held = env.scene.held is not None
        *_, info = env.step(env.expert_action())
        success = info["is_success"]
        assert not (success and env.scene.held is not None)
    assert held, "the step before let go"


def test_roof_below_does_not_count(make: Make) -> None:
    env = make(task_id("HouseBuilding"))
    env.reset(seed=0)
    env.scene["triangle"].place(Pose.planar(0.45, 0.0, 0.025))
    env.scene["cube"].place(Pose.planar(0.45, 0.0, 0.0755))
    info = env._evaluate(ignored=False)
    assert info["is_stacked"] and not info["is_roof_on_top"] and not info["is_success"]


def test_house_upside_right_counts(make: Make) -> None:
    env = make(task_id("HouseBuilding"))
    env.reset(seed=0)
    env.scene["cube"].place(Pose.planar(0.45, 0.0, 0.025))
    env.scene["triangle"].place(Pose.planar(0.45, 0.0, 0.0755))
    assert env._evaluate(ignored=False)["is_success"]


def test_stack_too_high_for_the_workspace_is_refused() -> None:
    with pytest.raises(ValueError, match=r"num_objects .*got 4"):
        make_env(task_id("BlockStacking"), num_objects=4, object_scale_range=1.5)


# Corner


@pytest.mark.parametrize("name", ["CornerPicking", "DrawerOpening"])
def test_tray_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match="close_loop_tray"):
        make_env(task_id(name), close_loop_tray=True)


def test_cube_is_flush_with_both_walls(make: Make) -> None:
    env = make(task_id("CornerPicking"))
    for seed in range(20):
        env.reset(seed=seed)
        inside = env.scene["corner"].pose.inverse().compose(env.scene["cube"].pose)
        assert inside.position[:2] == pytest.approx((CORNER_INSIDE + 0.025,) * 2, abs=1e-3)
        assert abs(inside.yaw) < 0.01


@pytest.mark.parametrize("robot", ["kuka", "panda", "ur5", "ur5_robotiq"])
@pytest.mark.parametrize("turn", [0.0, math.pi / 4.0, math.pi / 2.0, -math.pi / 4.0])
def test_straight_pick_fails_in_the_corner(make: Make, robot: str, turn: float) -> None:
    env = make(task_id("CornerPicking"), robot=robot)
    for seed in range(2):
        env.reset(seed=seed)
        cube = env.scene["cube"].pose
        yaw = env.scene["corner"].pose.yaw + turn
        follow(env, Waypoint(Pose.planar(cube.x, cube.y, 0.2, yaw), OPEN), 8)
        follow(env, Waypoint(Pose.planar(*cube.position, yaw), OPEN, finish=CLOSED), 6)
        hand = env.scene.robot.pose
        follow(env, Waypoint(Pose.planar(hand.x, hand.y, hand.z, yaw), CLOSED), 1)
        info = follow(env, Waypoint(Pose.planar(hand.x, hand.y, 0.22, yaw), CLOSED), 5)
        assert not info["is_success"] and not info["is_held"]
        assert env.scene["cube"].pose.z < 0.06


# Drawer


def test_open_drawer_counts_beyond_15_cm(make: Make) -> None:
    env = make(task_id("DrawerOpening"))
    env.reset(seed=0)
    for opened, success in ((0.14, False), (0.151, True)):
        env.scene["drawer"].set_joints((opened,))
        *_, info = env.step(np.zeros(5))
        assert info["is_success"] is success and info["is_valid"]
        assert env.scene["drawer"].joints[0] == pytest.approx(opened, abs=1e-4)


def test_drawer_stays_shut_unless_it_is_pulled(make: Make) -> None:
    env = make(task_id("DrawerOpening"))
    env.reset(seed=0)
    assert env.scene["drawer"].joints == (0.0,)
    env.scene.begin()
    env.scene.world.step(60)
    env.scene.world.end()
    assert abs(env.scene["drawer"].joints[0]) < 1e-4


def test_fixed_orientation_opens_the_drawer_along_y(make: Make) -> None:
    env = make(task_id("DrawerOpening"), **FIXED)
    yaws = set()
    for seed in range(40):
        env.reset(seed=seed)
        yaws.add(round(env.scene["drawer"].pose.yaw, 6))
    assert yaws == {round(math.pi / 2.0, 6), round(-math.pi / 2.0, 6)}


def test_state_observation_tells_how_far_the_drawer_is_open(make: Make) -> None:
    env = make(task_id("DrawerOpening"), observation="state")
    env.reset(seed=0)
    env.scene["drawer"].set_joints((0.1,))
    assert env.observe()["state"][-1] == np.float32(0.1)


INSTRUCTIONS = ("Put", "Get", "Grasp", "Move", "Pull", "Push", "Stack", "Present", "Bring")


def test_task_description_is_one_sentence_in_the_imperative(make: Make, env_id: str) -> None:
    env = make(env_id)
    description = env.get_wrapper_attr("task_description")
    assert description.startswith(INSTRUCTIONS) and description.endswith(".")
    assert description.count(".") == 1 and "\n" not in description
    assert env.get_wrapper_attr("_max_episode_steps") == env.config.max_steps


def test_vector_environments_return_what_the_evaluation_of_lerobot_calls() -> None:
    envs = gymnasium.make_vec(task_id("BlockPicking"), 2, vectorization_mode="sync", max_episode_steps=9)
    assert envs.call("_max_episode_steps") == (9, 9)
    assert envs.call("task_description") == ("Grasp a cube and lift it.",) * 2
    assert hasattr(envs.envs[0], "task_description"), "LeRobot passes an empty task without it"  # type: ignore[attr-defined]
    envs.close()


def test_description_of_a_task_without_docstring_is_its_name() -> None:
    class BlockShaking(BlockPicking):
        pass

    assert BlockShaking.description.fget(object.__new__(BlockShaking)) == "Block shaking."


@pytest.mark.parametrize(
    "env_id", ["BulletArm/CloseLoopBlockPicking-v0", "BulletArm/OpenLoopBlockStacking-v0"]
)
@pytest.mark.parametrize("plan", [(), None])
def test_a_plan_without_a_waypoint_is_refused(
    env_id: str, plan: tuple[()] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    env = make_env(env_id)
    monkeypatch.setattr(env.task, "plan", lambda scene, rng: plan)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"plan\(\) of the task must yield a waypoint, .* got none"):
        env.expert_action()
    env.close()


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda slots: [*slots, *slots], "slots with distinct names, got 'cube' more than once"),
        (lambda slots: None, "a list of slots, got None"),
    ],
)
def test_roles_that_cannot_be_loaded_are_refused(
    change: Callable[[Any], Any], reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    bodies = BlockPicking.bodies
    monkeypatch.setattr(BlockPicking, "bodies", lambda task, config: change(bodies(task, config)))
    with pytest.raises(ValueError, match=rf"bodies\(\) of BlockPicking must return {reason}"):
        make_env("BulletArm/CloseLoopBlockPicking-v0")
