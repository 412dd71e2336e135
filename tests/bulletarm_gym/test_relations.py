"""The words that goals are written in, on scenes laid out by hand."""

import math
from collections.abc import Callable

import pytest

from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.geometry import Pose
from bulletarm_gym.scene import Scene, SceneObject
from bulletarm_gym.scene.predicates import (
    at_rest,
    inside,
    is_top,
    on_surface,
    on_top,
    stacked,
    touching,
    upright,
)

Make = Callable[..., ManipulationEnv]
STACKING = "BulletArm/CloseLoopBlockStacking-v0"


@pytest.fixture
def scene(make: Make) -> Scene:
    env = make(STACKING, num_objects=3)
    env.reset(seed=0)
    return env.scene


def lay(scene: Scene, *places: tuple[float, float, float]) -> list[SceneObject]:
    items = scene.objects[: len(places)]
    for item, (x, y, z) in zip(items, places, strict=True):
        item.place(Pose.planar(x, y, z))
    return items


def test_stack_of_three(scene: Scene) -> None:
    items = lay(scene, (0.45, 0.0, 0.125), (0.46, 0.0, 0.025), (0.45, 0.01, 0.075))
    assert stacked(scene, items)
    assert not stacked(scene, lay(scene, (0.45, 0.0, 0.125), (0.55, 0.0, 0.025), (0.45, 0.01, 0.075)))


def test_stack_must_begin_on_the_ground(scene: Scene) -> None:
    assert not stacked(scene, lay(scene, (0.45, 0.0, 0.135), (0.45, 0.0, 0.035), (0.45, 0.0, 0.085)))


def test_stack_has_one_item_a_level(scene: Scene) -> None:
    assert not stacked(scene, lay(scene, (0.45, 0.0, 0.025), (0.45, 0.05, 0.025), (0.45, 0.025, 0.075)))


def test_stack_tolerates_half_a_side(scene: Scene) -> None:
    for aside, expected in ((0.024, True), (0.026, False)):
        first, second, _ = lay(scene, (0.45, 0.0, 0.025), (0.45, aside, 0.075), (0.55, 0.1, 0.025))
        assert on_top(scene, first, second) is expected
        assert not on_top(scene, second, first)


def test_gap_is_no_contact(scene: Scene) -> None:
    first, second, _ = lay(scene, (0.45, 0.0, 0.025), (0.45, 0.051, 0.025), (0.55, -0.1, 0.025))
    assert touching(scene, first, second)
    second.place(Pose.planar(0.45, 0.053, 0.025))
    assert not touching(scene, first, second)


def test_held_item_is_not_stacked(make: Make) -> None:
    env = make(STACKING)
    env.reset(seed=0)
    while env.scene.held is None:
        env.step(env.expert_action())
    held = env.scene.held
    (other,) = (item for item in env.scene if item is not held)
    low = held.pose
    other.place(Pose.planar(low.x, low.y, low.z + 0.0505))
    assert on_top(env.scene, held, other) and not stacked(env.scene, env.scene)


def test_upright_up_to_20_degrees(scene: Scene) -> None:
    item = scene.objects[0]
    for degrees, expected in ((19.0, True), (21.0, False), (90.0, False)):
        half = math.radians(degrees) / 2.0
        item.place(Pose((0.45, 0.0, 0.1), (0.0, math.sin(half), 0.0, math.cos(half))))
        assert upright(item) is expected


def test_on_ground(scene: Scene) -> None:
    item = scene.objects[0]
    item.place(Pose.planar(0.45, 0.0, 0.025, 0.3))
    assert on_surface(scene, item)
    quarter = math.pi / 8.0
    item.place(Pose((0.45, 0.0, 0.025 * math.sqrt(2.0)), (math.sin(quarter), 0.0, 0.0, math.cos(quarter))))
    assert on_surface(scene, item), "on an edge"
    item.place(Pose.planar(0.45, 0.0, 0.03))
    assert not on_surface(scene, item)


def test_is_top(scene: Scene) -> None:
    low, high, aside = lay(scene, (0.45, 0.0, 0.025), (0.45, 0.0, 0.075), (0.55, 0.1, 0.075))
    assert is_top(high, scene.objects) and is_top(aside, scene.objects) and not is_top(low, scene.objects)


def test_inside_seen_from_above(make: Make) -> None:
    env = make("BulletArm/OpenLoopBinPacking-v0")
    env.reset(seed=0)
    container, item = env.scene["bin"], env.scene["block 0"]
    for x, y, expected in ((0.087, 0.071, True), (0.089, 0.0, False), (0.0, -0.073, False)):
        item.place(container.pose.compose(Pose((x, y, 0.3))))
        assert inside(item, container) is expected


def test_what_falls_is_not_at_rest(scene: Scene) -> None:
    assert at_rest(scene)
    scene.objects[0].place(Pose.planar(0.45, 0.0, 0.2))
    scene.begin()
    scene.world.step(3)
    scene.world.end()
    assert not at_rest(scene)
