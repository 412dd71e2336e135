"""Fingers stop at bodies that they touch instead of penetrating them."""

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rollouts import is_open_loop

from bulletarm_gym.control import PickPlace
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.geometry import Pose
from bulletarm_gym.robots import ROBOTS
from bulletarm_gym.simulation import Body, BodySpec, Contact
from bulletarm_gym.simulation.motion import deepest_normal

Make = Callable[..., ManipulationEnv]

PICKING = "BulletArm/CloseLoopBlockPicking-v0"
DEEPEST = 3e-3
"""Maximum overlap (m) of the gripper and of the grasped object with a body."""
PART = BodySpec("part", (), 0.0)
NEAR = 0.03
"""Maximum distance (m) along each axis between an object and a target of the gripper."""


def penetration(env: ManipulationEnv) -> float:
    """Return the depth (m) of the last link, the fingers and the grasped object in other bodies."""
    world, arm, held = env.scene.world, env.scene.robot.body, env.scene.robot.held
    hand = min(*env.scene.robot.finger_links, env.scene.robot._arm.joints[-1])
    others = [body for body in world.obstacles if body is not arm]
    points = [p for body in others for p in world.client.getClosestPoints(arm.id, body.id, 0.0)]
    depths = [-p[8] for p in points if p[3] >= hand]
    if held is not None:
        rest = [body for body in [*others, world.ground] if body is not held]
        depths += [-p[8] for body in rest for p in world.client.getClosestPoints(held.id, body.id, 0.0)]
    return max(depths, default=0.0)


def rough_action(env: ManipulationEnv, rng: np.random.Generator) -> np.ndarray:
    """Return a random action, or more often one that moves the gripper into an object."""
    action = rng.uniform(-1.0, 1.0, env.action_space.shape)
    objects = [item for item in env.scene if item.spec.mass > 0.0 or item.spec.parts]
    if not objects or rng.random() < 0.2:
        return action
    goal = np.array(objects[int(rng.integers(len(objects)))].pose.position) + rng.uniform(-NEAR, NEAR, 3)
    if is_open_loop(env.spec.id):
        angles = rng.uniform((0.0, -0.5, -0.5), (math.pi, 0.5, 0.5))
        angles[1:] *= env.action_sequence.count("r") == 3
        primitive = "pick" if env.scene.robot.held is None else "place"
        return env.encode_action(PickPlace(primitive, (*goal[:2], max(goal[2], 0.005)), tuple(angles)))
    step = (goal - np.array(env.scene.robot.pose.position)) / 0.05
    step[2] = rng.choice([step[2], -1.0, 1.0], p=[0.6, 0.25, 0.15])
    action[[env.action_sequence.index(axis) for axis in "xyz"]] = step.clip(-1.0, 1.0)
    return action


def play(env: ManipulationEnv, steps: int, seed: int) -> float:
    """Return the maximum penetration (m) at the end of a step."""
    rng, worst = np.random.default_rng(seed), 0.0
    env.reset(seed=seed)
    for _ in range(steps):
        *_, terminated, truncated, _ = env.step(rough_action(env, rng))
        worst = max(worst, penetration(env))
        if terminated or truncated:
            env.reset()
    return worst


def test_fingers_stay_out_of_bodies(typical_env: ManipulationEnv) -> None:
    assert play(typical_env, 12 if is_open_loop(typical_env.spec.id) else 40, seed=0) <= DEEPEST


@pytest.mark.slow
@pytest.mark.parametrize("robot", ROBOTS)
def test_fingers_stay_out_of_bodies_for_long(make: Make, env_id: str, robot: str) -> None:
    assert play(make(env_id, robot=robot), 60 if is_open_loop(env_id) else 500, seed=1) <= DEEPEST


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("opening", [0.0, 1.0])
def test_finger_pressed_onto_a_cube_stops_above_it(make: Make, robot: str, opening: float) -> None:
    env, gripper = make(PICKING, robot=robot), ROBOTS[robot].gripper
    env.reset(seed=0)
    start = Pose((0.45 + opening * (gripper.stroke + gripper.finger[0]) / 2.0, 0.0, 0.025))
    env.scene["cube"].place(start)
    for _ in range(8):
        *_, info = env.step([2.0 * opening - 1.0, 0.0, 0.0, -1.0, 0.0])
        assert info["is_valid"] and penetration(env) <= DEEPEST
    cube = env.scene["cube"].pose
    assert env.scene.robot.pose.z > 0.05 - DEEPEST
    assert math.dist(cube.position, start.position) < 4e-3 and cube.tilt < 0.12
    env.step([2.0 * opening - 1.0, 0.0, 0.0, 1.0, 0.0])
    assert env.scene.robot.pose.z > 0.09


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("x, top, goal", [(0.45, 0.05, 0.02), (0.33, 0.0, -0.1)], ids=["cube", "ground"])
def test_blocked_arm_presses_little(make: Make, robot: str, x: float, top: float, goal: float) -> None:
    """It retreats until the object that it pressed into the ground has recovered."""
    env = make(PICKING, robot=robot, fast_mode=False)
    env.reset(seed=0)
    env.scene["cube"].place(Pose((x, 0.0, 0.025)))
    arm, world = env.scene.robot, env.scene.world
    arm.home(Pose.planar(0.45, 0.0, 0.08))
    arm.set_opening(0.0)
    for _ in range(2):
        env.scene.begin()
        arm.move_to(Pose.planar(0.45, 0.0, goal))
        assert -0.03 < arm.pose.z - top < 0.02
    world.step(20)
    points = world.client.getContactPoints(arm.body.id)
    assert sum(p[9] for p in points) < 25.0
    assert max((-p[8] for p in points), default=0.0) < DEEPEST
    env.scene.begin()
    arm.move_to(Pose.planar(0.45, 0.0, 0.1))
    assert arm.pose.z == pytest.approx(0.1, abs=2e-3)


def test_blocked_pick_retreats_on_its_path(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    """It stops above the start of the retreat, and must not go down there first."""
    env = make("BulletArm/OpenLoopBlockStacking-v0")
    env.reset(seed=0)
    side = env.scene["cube 0"].spec.extents[2]
    for number in range(3):
        env.scene[f"cube {number}"].place(Pose((0.45, 0.0, (number + 0.5) * side)))
    env.scene["cube 3"].place(Pose((0.3, 0.15, side / 2.0)))
    robot, heights = env.scene.robot, []
    move_to = robot.move_to

    def watched(pose: Pose, *options: bool) -> None:
        move_to(pose, *options)
        heights.append(robot.pose.z)

    monkeypatch.setattr(robot, "move_to", watched)
    finger = (robot.model.gripper.stroke + robot.model.gripper.finger[0]) / 2.0
    env.scene.begin()
    env.control.apply(PickPlace("pick", (0.45 - finger, 0.0, 0.02)))
    assert heights[0] > 3 * side - DEEPEST and heights == sorted(heights)


def test_pressing_arm_slides_in_closed_loop(make: Make) -> None:
    """As an arm that yields to contact forces; it would stand still for ever with a policy that presses."""
    env = make(PICKING)
    env.reset(seed=0)
    env.scene["cube"].place(Pose((0.45, 0.0, 0.025)))
    arm = env.scene.robot
    arm.home(Pose.planar(0.45, 0.0, 0.08))
    env.step([-1.0, 0.0, 0.0, -1.0, 0.0])
    before = arm.pose
    env.step([-1.0, 0.6, 0.0, -0.2, 0.0])
    assert arm.pose.x - before.x > 0.02 and abs(arm.pose.y - before.y) < 2e-3
    assert penetration(env) <= DEEPEST


@pytest.mark.parametrize("depth, normal", [(0.005, (0.0, 0.0, 1.0)), (0.011, (1.0, 0.0, 0.0))])
def test_the_grasped_object_blocks_only_where_it_is_squeezed(
    depth: float, normal: tuple[float, float, float]
) -> None:
    """Fingers always overlap it, and its contact must not be the direction in which the arm slides."""
    arm, held, wall = Body(0, 0, PART), Body(1, 1, PART), Body(2, 2, PART)
    contacts = [
        Contact(0, held, (1.0, 0.0, 0.0), -depth, 50.0),
        Contact(0, wall, (0.0, 0.0, 1.0), -0.003, 120.0),
    ]
    world: Any = SimpleNamespace(contacts=lambda _: contacts)
    assert deepest_normal(world, arm, held) == normal
