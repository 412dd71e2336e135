"""A body falls if nothing supports it: in a user's task, under both controls, on the plane and on ramps."""

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from rollouts import digest, idle, step_on

from bulletarm_gym.config import CLOSE_LOOP, OPEN_LOOP, TaskDefaults
from bulletarm_gym.control import DeltaMove, PickPlace
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.geometry import Pose, euler_pose
from bulletarm_gym.objects import cube
from bulletarm_gym.scene import ObjectSlot, Scene, scaled
from bulletarm_gym.scene.predicates import at_rest, on_surface, stacked, touching
from bulletarm_gym.scene.stability import is_stable
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
    layout: dict[int, Pose]

    def bodies(self, config: Any) -> list[ObjectSlot]:
        """Return the cubes."""
        return [scaled(config, f"cube {number}", cube) for number in range(3)]

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        """Put the cubes at the poses of the test, relative to the middle of the workspace."""
        for number, pose in self.layout.items():
            scene[f"cube {number}"].place(Pose((*self.config.centre, scene.surface.level)).compose(pose))

    def evaluate(self, scene: Scene) -> dict[str, bool]:
        """Return whether the cubes that are present form one stack."""
        return {"success": stacked(scene, list(scene)), "is_at_rest": at_rest(scene)}

    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        """Yield no move of interest."""
        yield Waypoint(scene.robot.pose, 1.0)


def above(height: float) -> Pose:
    return Pose((0.0, 0.0, height))


STACK = {number: above((number + 0.5) * SIDE) for number in range(3)}
AIR = {"level": above(0.125), "just above the ground": above(HALF + 0.001)}
AIR |= {
    "tilted": euler_pose((0.0, 0.0, 0.1), (0.5, 0.3, 0.2)),
    "on a corner": euler_pose((0.0, 0.0, 0.04), (0.5, 0.5, 0.0)),
}


@pytest.fixture(scope="module")
def arranged() -> Iterator[Callable[..., ManipulationEnv]]:
    made: dict[Any, ManipulationEnv] = {}

    def get(
        kind: tuple[str, str], layout: dict[int, Pose], fast: bool = True, number: int = 0
    ) -> ManipulationEnv:
        key = (kind, fast, number)
        if key not in made:
            Arranged.layout = STACK
            control, surface = kind
            made[key] = ManipulationEnv(
                "test_settling:Arranged",
                control,
                surface,
                obs_size=32,
                object_scale_range=1.0,
                fast_mode=fast,
            )
        made[key].task.layout = layout
        return made[key]

    yield get
    for env in made.values():
        env.close()


def present(env: ManipulationEnv) -> list[Pose]:
    return [item.pose for item in env.scene]


def assert_supported(env: ManipulationEnv) -> None:
    """Assert that everything rests, each item on the ground or in contact with another one, none inside."""
    items, world = [item for item in env.scene if item is not env.scene.held], env.scene.world
    assert at_rest(env.scene)
    for item in items:
        others = [other for other in items if other is not item]
        assert on_surface(env.scene, item) or any(touching(env.scene, item, other) for other in others)
        assert all(world.distance(item.body, other.body, 0.1) > -1.5e-3 for other in others)
    before = present(env)
    env.scene.begin()
    world.step(120)
    world.end()
    for now, then in zip(present(env), before, strict=True):
        assert math.dist(now.position, then.position) < SAME


def assert_same(fast: ManipulationEnv, slow: ManipulationEnv) -> None:
    for one, other in zip(present(fast), present(slow), strict=True):
        assert math.dist(one.position, other.position) < SAME


@pytest.mark.parametrize("kind", KINDS, ids="-".join)
@pytest.mark.parametrize("name", AIR)
def test_cube_placed_in_the_air_falls(arranged: Callable[..., ManipulationEnv], kind: Any, name: str) -> None:
    ends = []
    for fast in (True, False):
        env = arranged(kind, {0: AIR[name]}, fast)
        env.reset(seed=0)
        (before,) = present(env)
        assert_supported(env)
        env.reset(seed=0)
        for _ in range(3):
            step_on(env, idle(env))
        assert math.dist(present(env)[0].position, before.position) < SAME
        ends.append(env)
    assert_same(*ends)


@pytest.mark.parametrize("kind", KINDS, ids="-".join)
@pytest.mark.parametrize("change", ["park", "place"])
def test_stack_falls_without_its_lowest_cube(
    arranged: Callable[..., ManipulationEnv], kind: Any, change: str
) -> None:
    ends = []
    for fast in (True, False):
        env = arranged(kind, STACK, fast)
        _, info = env.reset(seed=0)
        assert info["is_success"] and info["is_at_rest"]
        lowest = env.scene["cube 0"]
        if change == "park":
            lowest.park()
        else:
            lowest.place(
                lowest.pose._replace(position=(env.config.centre[0] + 0.06, *lowest.pose.position[1:]))
            )
        assert env.scene.world.unsettled
        step_on(env, idle(env))
        assert env.scene["cube 2"].pose.z - env.scene.surface.level < 2.0 * SIDE
        assert_supported(env)
        ends.append(env)
    assert_same(*ends)


@pytest.mark.parametrize("kind", KINDS, ids="-".join)
@pytest.mark.parametrize("apart", [0.01, 0.0])
def test_overlapping_cubes_are_pushed_apart(
    arranged: Callable[..., ManipulationEnv], kind: Any, apart: float
) -> None:
    env = arranged(kind, {0: above(HALF), 1: Pose((apart, 0.0, HALF))})
    env.reset(seed=0)
    assert_supported(env)


@pytest.mark.parametrize("kind", KINDS, ids="-".join)
@pytest.mark.parametrize("over", [0.0003, 0.002])
def test_cube_off_balance_falls_before_success_is_evaluated(
    arranged: Callable[..., ManipulationEnv], kind: Any, over: float
) -> None:
    for fast in (True, False):
        layout = {0: above(HALF), 1: Pose((HALF + over, 0.0, HALF + SIDE))}
        env = arranged(kind, layout, fast)
        _, info = env.reset(seed=0)
        assert not info["is_success"]
        assert_supported(env)


def test_load_that_tips_its_support_falls(arranged: Callable[..., ManipulationEnv]) -> None:
    """Each cube stands on the one below, but the middle one does not with the upper one on it."""
    layout = {0: above(HALF), 1: Pose((0.02, 0.0, HALF + SIDE)), 2: Pose((0.04, 0.0, HALF + 2.0 * SIDE))}
    env = arranged(KINDS[0], layout)
    _, info = env.reset(seed=0)
    assert not info["is_success"]
    assert_supported(env)


@pytest.mark.parametrize("surface", ["flat", "ramp"])
def test_picking_a_support_lets_its_load_fall(arranged: Callable[..., ManipulationEnv], surface: str) -> None:
    for fast in (True, False):
        layout = {0: Pose((-0.03, 0.0, HALF)), 1: Pose((0.03, 0.0, HALF)), 2: above(HALF + SIDE)}
        env = arranged((OPEN_LOOP, surface), layout, fast)
        env.reset(seed=0)
        assert env.scene["cube 2"].lowest == pytest.approx(SIDE + env.scene.surface.level, abs=1e-3)
        (x, y, z), load = env.scene["cube 0"].pose.position, env.scene["cube 2"].pose
        step_on(env, env.encode_action(PickPlace("pick", (x - 0.015, y, z), (math.pi / 2.0, 0.0, 0.0))))
        assert env.scene.held is env.scene["cube 0"]
        assert math.dist(env.scene["cube 2"].pose.position, load.position) > 0.005, "tipped, or fallen"
        assert_supported(env)


def test_released_cube_falls(arranged: Callable[..., ManipulationEnv]) -> None:
    ends = []
    for fast in (True, False):
        env = arranged((CLOSE_LOOP, "flat"), {0: above(HALF)}, fast)
        env.reset(seed=0)
        z = env.scene.robot.pose.z
        for opening, rise in [*[(1.0, (HALF - z) / 4.0)] * 4, (0.0, 0.0), (0.0, 0.04), (0.0, 0.04)]:
            step_on(env, env.encode_action(DeltaMove(opening, (0.0, 0.0, rise))))
        assert env.scene.held is env.scene["cube 0"] and env.scene.held.lowest > 0.05
        step_on(env, env.encode_action(DeltaMove(1.0, (0.0, 0.0, 0.0))))
        assert env.scene.held is None and env.scene["cube 0"].lowest < 2e-3
        step_on(env, env.encode_action(DeltaMove(1.0, (0.0, 0.0, 0.05))))
        assert_supported(env)
        ends.append(env)
    assert_same(*ends)


def test_reset_lets_the_grasped_cube_fall(arranged: Callable[..., ManipulationEnv]) -> None:
    """The gripper opens at once when the next episode begins in the same scene."""
    env = arranged((CLOSE_LOOP, "flat"), {0: above(HALF)})
    env.reset(seed=0)
    cube_0 = env.scene["cube 0"]
    hand = env.scene.robot.pose
    env.scene.world.carry(cube_0.body, hand)
    env.scene.robot.held = cube_0.body
    env.scene.robot.home(hand)
    env.scene.begin()
    env.scene.settle()
    assert cube_0.lowest < 2e-3


@pytest.mark.parametrize("kind", KINDS, ids="-".join)
def test_state_with_an_unsupported_body_is_exact(arranged: Callable[..., ManipulationEnv], kind: Any) -> None:
    env, other = arranged(kind, STACK), arranged(kind, STACK, number=1)
    env.reset(seed=3)
    env.scene["cube 0"].park()
    state = env.get_state()
    expected = [digest(*step_on(env, idle(env))) for _ in range(2)], env.get_state().world
    other.reset(seed=4)
    step_on(other, idle(other))
    other.set_state(state)
    assert ([digest(*step_on(other, idle(other))) for _ in range(2)], other.get_state().world) == expected


@pytest.mark.parametrize("surface", ["flat", "ramp"])
def test_cubes_apart_on_the_surface_need_no_simulation(
    arranged: Callable[..., ManipulationEnv], surface: str
) -> None:
    env = arranged((CLOSE_LOOP, surface), {0: above(HALF), 1: Pose((0.06, 0.0, HALF))})
    env.reset(seed=0)
    scene, expected = env.scene, above(HALF).z + env.scene.surface.level
    assert [pose.z for pose in present(env)] == [expected, expected]
    bodies = [item.body for item in scene]
    assert is_stable(scene.world, scene.surface, bodies)
    for pose in (
        above(HALF + 3e-4),
        above(HALF - 3e-4),
        Pose((0.012, 0.0, HALF)),
        euler_pose((0.0, 0.0, HALF), (0.05, 0.0, 0.0)),
    ):
        scene["cube 0"].place(Pose((*env.config.centre, scene.surface.level)).compose(pose))
        assert not is_stable(scene.world, scene.surface, bodies)
