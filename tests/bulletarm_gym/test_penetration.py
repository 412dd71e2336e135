"""Fingers stop at what they touch instead of going into it."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from rollouts import is_open_loop

from bulletarm_gym.control import PickPlace
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.geometry import Pose
from bulletarm_gym.robots import ROBOTS, RobotModel
from bulletarm_gym.simulation.motion import follow

Make = Callable[..., ManipulationEnv]

PICKING = "BulletArm/CloseLoopBlockPicking-v0"
DEEPEST = 3e-3
"""Maximum overlap (m) of the hand and of the grasped object with anything."""
NEAR = 0.03
"""How far (m) along each axis from an object's middle the gripper is sent."""


def penetration(env: ManipulationEnv) -> float:
    """Return how deep (m) the last link, the fingers and the grasped object are in anything."""
    world, arm, held = env.scene.world, env.scene.robot.body, env.scene.robot.held
    hand = min(*env.scene.robot._fingers.joints, env.scene.robot._arm.joints[-1])
    others = [body for body in world.obstacles if body is not arm]
    points = [p for body in others for p in world.client.getClosestPoints(arm.id, body.id, 0.0)]
    depths = [-p[8] for p in points if p[3] >= hand]
    if held is not None:
        rest = [body for body in [*others, world.ground] if body is not held]
        depths += [-p[8] for body in rest for p in world.client.getClosestPoints(held.id, body.id, 0.0)]
    return max(depths, default=0.0)


def rough_action(env: ManipulationEnv, rng: np.random.Generator) -> np.ndarray:
    """Return any action, or more often one that sends the gripper into an object."""
    anything = rng.uniform(-1.0, 1.0, env.action_space.shape)
    things = [item for item in env.scene if item.spec.mass > 0.0 or item.spec.parts]
    if not things or rng.random() < 0.2:
        return anything
    at = np.array(things[int(rng.integers(len(things)))].pose.position) + rng.uniform(-NEAR, NEAR, 3)
    return _pick(env, at, rng) if is_open_loop(env.spec.id) else _move(env, at, anything, rng)


def _pick(env: ManipulationEnv, at: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    angles = [rng.uniform(0.0, math.pi), 0.0, 0.0]
    if env.action_sequence.count("r") == 3:
        angles[1:] = rng.uniform(-0.5, 0.5, 2).tolist()
    primitive = "pick" if env.scene.robot.held is None else "place"
    return env.encode_action(PickPlace(primitive, (at[0], at[1], max(at[2], 0.005)), tuple(angles)))


def _move(env: ManipulationEnv, at: np.ndarray, anything: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    way = (at - np.array(env.scene.robot.pose.position)) / 0.05
    way[2] = rng.choice([way[2], -1.0, 1.0], p=[0.6, 0.25, 0.15])
    for axis, part in zip("xyz", way, strict=True):
        anything[env.action_sequence.index(axis)] = np.clip(part, -1.0, 1.0)
    return anything


def play(env: ManipulationEnv, steps: int, seed: int) -> float:
    """Return the greatest penetration (m) at the end of a step."""
    rng, worst = np.random.default_rng(seed), 0.0
    env.reset(seed=seed)
    for _ in range(steps):
        *_, terminated, truncated, _ = env.step(rough_action(env, rng))
        worst = max(worst, penetration(env))
        if terminated or truncated:
            env.reset()
    return worst


def test_fingers_stay_out_of_things(env: ManipulationEnv) -> None:
    assert play(env, 12 if is_open_loop(env.spec.id) else 80, seed=0) <= DEEPEST


@pytest.mark.slow
@pytest.mark.parametrize("robot", ROBOTS)
def test_fingers_stay_out_of_things_for_long(make: Make, env_id: str, robot: str) -> None:
    steps = 60 if is_open_loop(env_id) else 500
    assert play(make(env_id, robot=robot), steps, seed=1) <= DEEPEST


@pytest.fixture(params=ROBOTS.values(), ids=lambda model: model.name)
def model(request: pytest.FixtureRequest) -> RobotModel:
    return request.param


@pytest.mark.parametrize("opening", [0.0, 1.0])
def test_a_finger_pressed_onto_a_cube_stops_above_it(make: Make, model: RobotModel, opening: float) -> None:
    env = make(PICKING, robot=model.name)
    env.reset(seed=0)
    finger = opening * (model.gripper.stroke + model.gripper.finger[0]) / 2.0
    start = Pose((0.45 + finger, 0.0, 0.025))
    env.scene["cube"].place(start)
    for _ in range(8):
        *_, info = env.step([2.0 * opening - 1.0, 0.0, 0.0, -1.0, 0.0])
        assert info["is_valid"] and penetration(env) <= DEEPEST
    cube = env.scene["cube"].pose
    assert env.scene.robot.pose.z > 0.05 - DEEPEST
    assert math.dist(cube.position, start.position) < 4e-3 and cube.tilt < 0.12
    env.step([2.0 * opening - 1.0, 0.0, 0.0, 1.0, 0.0])
    assert env.scene.robot.pose.z > 0.09


def test_a_blocked_arm_presses_little(make: Make, model: RobotModel) -> None:
    """It goes back as far as it must for what it pressed into the ground to come up again."""
    env = make(PICKING, robot=model.name, fast_mode=False)
    env.reset(seed=0)
    env.scene["cube"].place(Pose((0.45, 0.0, 0.025)))
    robot, world = env.scene.robot, env.scene.world
    robot.home(Pose.planar(0.45, 0.0, 0.08))
    robot.set_opening(0.0)
    env.scene.begin()
    goal = robot.inverse_kinematics(Pose.planar(0.45, 0.0, 0.02))
    follow(world, robot._arm, [goal], 24, None)
    world.step(20)
    points = world.client.getContactPoints(robot.body.id)
    assert sum(p[9] for p in points) < 25.0
    assert max((-p[8] for p in points), default=0.0) < DEEPEST


def test_a_blocked_pick_draws_back_the_way_it_came(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    """It stops above where it would have begun to draw back, and must not go down there first."""
    env = make("BulletArm/OpenLoopBlockStacking-v0")
    env.reset(seed=0)
    side = env.scene["cube 0"].spec.extents[2]
    for number in range(3):
        env.scene[f"cube {number}"].place(Pose((0.45, 0.0, (number + 0.5) * side)))
    env.scene["cube 3"].place(Pose((0.3, 0.15, side / 2.0)))
    robot, heights = env.scene.robot, []
    move_to = robot.move_to

    def watched(pose: Pose, in_contact: bool = True) -> None:
        move_to(pose, in_contact)
        heights.append(robot.pose.z)

    monkeypatch.setattr(robot, "move_to", watched)
    finger = (robot.model.gripper.stroke + robot.model.gripper.finger[0]) / 2.0
    env.scene.begin()
    env.control.apply(PickPlace("pick", (0.45 - finger, 0.0, 0.02)))
    assert heights[0] > 3 * side - DEEPEST
    assert heights == sorted(heights)
