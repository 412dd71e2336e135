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
        return [scaled(config, f"cube {number}", cube) for number in range(3)]

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        for number, pose in self.layout.items():
            scene[f"cube {number}"].place(Pose((*self.config.centre, scene.surface.level)).compose(pose))

    def evaluate(self, scene: Scene) -> dict[str, bool]:
        return {"success": stacked(scene, list(scene)), "is_at_rest": at_rest(scene)}

    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        yield Waypoint(scene.robot.pose, 1.0)


def above(height: float, x: float = 0.0) -> Pose:
    return Pose((x, 0.0, height))


STACK = {number: above((number + 0.5) * SIDE) for number in range(3)}
UNSTABLE: dict[str, dict[int, Pose]] = {
    "in the air": {0: above(0.125)},
    "just above the surface": {0: above(HALF + 0.001)},
    "tilted": {0: euler_pose((0.0, 0.0, 0.1), (0.5, 0.3, 0.2))},
    "on a corner": {0: euler_pose((0.0, 0.0, 0.04), (0.5, 0.5, 0.0))},
    "overlapping": {0: above(HALF), 1: above(HALF, 0.01)},
    "in each other": {0: above(HALF), 1: above(HALF)},
    "off balance": {0: above(HALF), 1: above(HALF + SIDE, HALF + 0.0003)},
    "tipping its support": {0: above(HALF), 1: above(HALF + SIDE, 0.02), 2: above(HALF + 2.0 * SIDE, 0.04)},
}
Get = Callable[..., ManipulationEnv]


@pytest.fixture(scope="module")
def arranged() -> Iterator[Get]:
    """Return shared environments whose cubes are laid out by the test."""
    made: dict[Any, ManipulationEnv] = {}

    def get(kind: Any, layout: dict[int, Pose], fast: bool = True, number: int = 0) -> ManipulationEnv:
        key = (kind, fast, number)
        if key not in made:
            Arranged.layout = STACK
            parameters = {"obs_size": 32, "object_scale_range": 1.0, "fast_mode": fast}
            made[key] = ManipulationEnv("test_settling:Arranged", *kind, **parameters)
        made[key].task.layout = layout
        return made[key]

    yield get
    for env in made.values():
        env.close()


def positions(env: ManipulationEnv) -> np.ndarray:
    return np.array([item.pose.position for item in env.scene])


def assert_supported(env: ManipulationEnv) -> None:
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
def test_unstable_cubes_come_to_rest_before_success_is_evaluated(arranged: Get, kind: Any, name: str) -> None:
    ends = []
    for fast in (True, False):
        env = arranged(kind, UNSTABLE[name], fast)
        _, info = env.reset(seed=0)
        ends.append(positions(env))
        assert len(ends[-1]) == 1 or not info["is_success"]
        assert_supported(env)
    if len(ends[0]) == 1:
        assert ends[0] == pytest.approx(ends[1], abs=SAME)


@pytest.mark.parametrize("kind", KINDS, ids="-".join)
def test_stack_falls_without_its_lowest_cube(arranged: Get, kind: Any) -> None:
    for fast in (True, False):
        env = arranged(kind, STACK, fast)
        _, info = env.reset(seed=0)
        assert info["is_success"] and info["is_at_rest"]
        (x, *yz), orientation = env.scene["cube 0"].pose
        env.scene["cube 0"].place(Pose((x + 0.06, *yz), orientation))
        step_on(env, idle(env))
        assert env.scene["cube 2"].pose.z - env.scene.surface.level < 2.0 * SIDE
        assert_supported(env)


@pytest.mark.parametrize("surface", ["flat", "ramp"])
def test_picking_a_support_lets_its_load_fall(arranged: Get, surface: str) -> None:
    layout = {0: above(HALF, -0.03), 1: above(HALF, 0.03), 2: above(HALF + SIDE)}
    for fast in (True, False):
        env = arranged((OPEN_LOOP, surface), layout, fast)
        env.reset(seed=0)
        assert env.scene["cube 2"].lowest == pytest.approx(SIDE + env.scene.surface.level, abs=1e-3)
        (x, y, z), load = env.scene["cube 0"].pose.position, env.scene["cube 2"].pose
        step_on(env, env.encode_action(PickPlace("pick", (x - 0.015, y, z), (math.pi / 2.0, 0.0, 0.0))))
        assert env.scene.held is env.scene["cube 0"]
        assert math.dist(env.scene["cube 2"].pose.position, load.position) > 0.005, "tipped, or fallen"
        assert_supported(env)


def test_released_cube_falls(arranged: Get) -> None:
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


@pytest.mark.parametrize("kind", KINDS, ids="-".join)
def test_state_with_an_unsupported_body_is_exact(arranged: Get, kind: Any) -> None:
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
def test_cubes_apart_on_the_surface_need_no_simulation(arranged: Get, surface: str) -> None:
    env = arranged((CLOSE_LOOP, surface), {0: above(HALF), 1: above(HALF, 0.06)})
    env.reset(seed=0)
    scene, bodies = env.scene, [item.body for item in env.scene]
    assert set(positions(env)[:, 2]) == {HALF + scene.surface.level}
    assert is_stable(scene.world, scene.surface, bodies)
    tilted = euler_pose((0.0, 0.0, HALF), (0.05, 0.0, 0.0))
    for pose in (above(HALF + 3e-4), above(HALF - 3e-4), above(HALF, 0.012), tilted):
        scene["cube 0"].place(Pose((*env.config.centre, scene.surface.level)).compose(pose))
        assert not is_stable(scene.world, scene.surface, bodies)
