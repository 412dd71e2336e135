"""Contacts: a body falls if nothing supports it, and fingers stop at bodies that they touch."""

import math

import numpy as np
import pytest
from rollouts import PICKING, is_open_loop, step_on

from bulletarm_gym.config import CLOSE_LOOP, OPEN_LOOP, TaskDefaults
from bulletarm_gym.control import PickPlace
from bulletarm_gym.geometry import Pose, euler_pose
from bulletarm_gym.objects import cube
from bulletarm_gym.robots import ROBOTS
from bulletarm_gym.scene import scaled
from bulletarm_gym.scene.predicates import at_rest, on_surface, stacked, touching
from bulletarm_gym.tasks import Task, Waypoint

SIDE = 0.05
HALF = SIDE / 2.0
KINDS = [(control, surface) for control in (CLOSE_LOOP, OPEN_LOOP) for surface in ("flat", "ramp")]
SAME = 3e-3
"""Distance (m) between the end states of both values of ``fast_mode``: contacts are solved in other steps."""


class Arranged(Task):
    """Three cubes that a test lays out; solved if they form one stack."""

    defaults = TaskDefaults(num_objects=3, allowed_objects=(3,), close_loop={"max_steps": 100})
    controls = (CLOSE_LOOP, OPEN_LOOP)
    site = (3.0 * SIDE, 3.0 * SIDE)
    layout: dict[int, Pose] | None = None

    def bodies(self, config):
        return [scaled(config, f"cube {number}", cube) for number in range(3)]

    def arrange(self, scene, rng):
        for number, pose in (self.layout or {}).items():
            scene[f"cube {number}"].place(Pose((*self.config.centre, scene.surface.level)).compose(pose))

    def evaluate(self, scene):
        return {"success": stacked(scene, list(scene)), "is_at_rest": at_rest(scene)}

    def plan(self, scene, rng):
        yield Waypoint(scene.robot.pose, 1.0)


def above(height, x=0.0):
    return Pose((x, 0.0, height))


UNSTABLE = {
    "in the air": {0: above(0.125)},
    "just above the surface": {0: above(HALF + 0.001)},
    "tilted": {0: euler_pose((0.0, 0.0, 0.1), (0.5, 0.3, 0.2))},
    "on a corner": {0: euler_pose((0.0, 0.0, 0.04), (0.5, 0.5, 0.0))},
    "overlapping": {0: above(HALF), 1: above(HALF, 0.01)},
    "in each other": {0: above(HALF), 1: above(HALF)},
    "off balance": {0: above(HALF), 1: above(HALF + SIDE, HALF + 0.0003)},
    "tipping its support": {0: above(HALF), 1: above(HALF + SIDE, 0.02), 2: above(HALF + 2.0 * SIDE, 0.04)},
}


def arranged(make, kind, layout, fast):
    """Return a shared environment of a control and a surface, whose cubes are laid out."""
    task, (control, surface) = f"{__name__}:Arranged", kind
    parameters = {"obs_size": 32, "object_scale_range": 1.0, "fast_mode": fast}
    env = make(PICKING, task=task, control=control, surface=surface, **parameters)
    env.task.layout = layout
    return env


def positions(env):
    return np.array([item.pose.position for item in env.scene])


def assert_supported(env):
    """Assert that all cubes rest on the surface or in contact with each other, none inside another."""
    items, world = [item for item in env.scene if item is not env.scene.held], env.scene.world
    assert at_rest(env.scene)
    for item in items:
        others = [other for other in items if other is not item]
        assert on_surface(env.scene, item) or any(touching(env.scene, item, other) for other in others)
        assert all(world.distance(item.body, other.body, 0.1) > -1.5e-3 for other in others)
    before = positions(env)
    env.scene.begin()
    world.step(120)
    world.end()
    assert positions(env) == pytest.approx(before, abs=SAME)


@pytest.mark.parametrize(
    ("kind", "name"),
    [(kind, name) for kind in KINDS for name in UNSTABLE if "tipping" not in name or "flat" in kind],
)
def test_unstable_cubes_come_to_rest_before_success_is_evaluated(make, kind, name):
    ends = []
    for fast in (True, False):
        env = arranged(make, kind, UNSTABLE[name], fast)
        _, info = env.reset(seed=0)
        ends.append(positions(env))
        assert len(ends[-1]) == 1 or not info["is_success"]
        assert_supported(env)
    if len(ends[0]) == 1:
        assert ends[0] == pytest.approx(ends[1], abs=SAME)


DEEPEST = 3e-3
"""Maximum overlap (m) of the gripper and of the grasped object with a body."""
NEAR = 0.03
"""Maximum distance (m) along each axis between an object and a target of the gripper."""


@pytest.mark.parametrize("surface", ["flat", "ramp"])
def test_picking_a_support_lets_its_load_fall(make, surface):
    layout = {0: above(HALF, -0.03), 1: above(HALF, 0.03), 2: above(HALF + SIDE)}
    for fast in (True, False):
        env = arranged(make, (OPEN_LOOP, surface), layout, fast)
        env.reset(seed=0)
        (x, y, z), load = env.scene["cube 0"].pose.position, env.scene["cube 2"].pose
        step_on(env, env.encode_action(PickPlace("pick", (x - 0.015, y, z), (math.pi / 2.0, 0.0, 0.0))))
        assert env.scene.held is env.scene["cube 0"]
        assert math.dist(env.scene["cube 2"].pose.position, load.position) > 0.005, "tipped, or fallen"
        assert_supported(env)


def penetration(env):
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


def rough_action(env, rng):
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


def play(env, steps, seed):
    """Return the maximum penetration (m) at the end of a step."""
    rng, worst = np.random.default_rng(seed), 0.0
    env.reset(seed=seed)
    for _ in range(steps):
        *_, terminated, truncated, _ = env.step(rough_action(env, rng))
        worst = max(worst, penetration(env))
        if terminated or truncated:
            env.reset()
    return worst


def test_fingers_stay_out_of_bodies(typical_env):
    assert play(typical_env, 12 if is_open_loop(typical_env.spec.id) else 40, seed=0) <= DEEPEST


@pytest.mark.slow
@pytest.mark.parametrize("robot", ROBOTS)
def test_fingers_stay_out_of_bodies_for_long(make, env_id, robot):
    assert play(make(env_id, robot=robot), 60 if is_open_loop(env_id) else 500, seed=1) <= DEEPEST


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("x, top, goal", [(0.45, 0.05, 0.02), (0.33, 0.0, -0.1)], ids=["cube", "ground"])
def test_blocked_arm_presses_little(make, robot, x, top, goal):
    """It retreats until the object that it pressed into the ground has recovered."""
    env = make(PICKING, robot=robot, fast_mode=False, seed=0)
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
    assert sum(p[9] for p in points) < 25.0 and all(-p[8] < DEEPEST for p in points)
    env.scene.begin()
    arm.move_to(Pose.planar(0.45, 0.0, 0.1))
    assert arm.pose.z == pytest.approx(0.1, abs=2e-3)


def test_blocked_pick_retreats_on_its_path(make, monkeypatch):
    """It stops above the start of the retreat, and must not go down there first."""
    env = make("BulletArm/OpenLoopBlockStacking-v0", seed=0)
    side = env.scene["cube 0"].spec.extents[2]
    for number in range(3):
        env.scene[f"cube {number}"].place(Pose((0.45, 0.0, (number + 0.5) * side)))
    env.scene["cube 3"].place(Pose((0.3, 0.15, side / 2.0)))
    robot, heights = env.scene.robot, []
    move_to = robot.move_to

    def watched(pose, *options):
        move_to(pose, *options)
        heights.append(robot.pose.z)

    monkeypatch.setattr(env.control.robot, "move_to", watched)
    finger = (robot.model.gripper.stroke + robot.model.gripper.finger[0]) / 2.0
    env.scene.begin()
    env.control.apply(PickPlace("pick", (0.45 - finger, 0.0, 0.02)))
    assert heights[0] > 3 * side - DEEPEST and heights == sorted(heights)


def test_pressing_arm_slides_in_closed_loop(make):
    """As an arm that yields to contact forces; it would stand still for ever with a policy that presses."""
    env = make(PICKING, seed=0)
    env.scene["cube"].place(Pose((0.45, 0.0, 0.025)))
    arm = env.scene.robot
    arm.home(Pose.planar(0.45, 0.0, 0.08))
    env.step([-1.0, 0.0, 0.0, -1.0, 0.0])
    before = arm.pose
    env.step([-1.0, 0.6, 0.0, -0.2, 0.0])
    assert arm.pose.x - before.x > 0.02 and abs(arm.pose.y - before.y) < 2e-3
    assert penetration(env) <= DEEPEST
