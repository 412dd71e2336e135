"""Finding room: uniform, apart, bounded."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.geometry import PlacementError, Pose
from bulletarm_gym.objects import create
from bulletarm_gym.robots import ROBOTS
from bulletarm_gym.scene import ObjectSlot, Scene
from bulletarm_gym.scene.sampling import (
    free_pose,
    is_within,
    most_free_point,
    place_apart,
    sample_until,
    scatter,
)
from bulletarm_gym.surfaces import SURFACES

Make = Callable[..., ManipulationEnv]


@pytest.fixture
def scene(make: Make) -> Scene:
    env = make("BulletArm/CloseLoopBlockStacking-v0", num_objects=3)
    env.reset(seed=0)
    return env.scene


SKIN = 1e-3
"""Bullet wraps convex hulls in a skin that thick (m)."""
WORKSPACE = [[0.25, 0.65], [-0.2, 0.2], [0.0, 1.0]]
HOUSE = [(f"cube_{number}", "cube", 0.6) for number in range(4)] + [
    ("brick", "brick", 0.6),
    ("roof", "roof", 0.6),
]
PACKING = [(f"packing_{number}", f"packing_block_{number % 7}", 0.8) for number in range(8)]


def _scene(make: Make, surface: str, kinds: list[tuple[str, str, float]]) -> Scene:
    config = replace(make("BulletArm/CloseLoopBlockStacking-v0").config, workspace=WORKSPACE)
    roles = [ObjectSlot(name, (create(kind, name, scale),)) for name, kind, scale in kinds]
    return Scene(config, ROBOTS["kuka"], SURFACES[surface](WORKSPACE, (0.03, 0.03)), roles)


def _assert_apart_and_inside(scene: Scene, least: float) -> None:
    items = list(scene)
    for number, item in enumerate(items):
        low, high = item.spec.mesh.moved(item.pose).bounds
        assert (low[:2] > [0.25, -0.2]).all() and (high[:2] < [0.65, 0.2]).all()
        for other in items[:number]:
            assert scene.world.distance(item.body, other.body, least) > least - 2.5 * SKIN


@pytest.mark.parametrize(
    ("surface", "kinds", "gap", "seeds"),
    [
        ("flat", HOUSE, 0.03, 1000),
        ("ramp", HOUSE, 0.03, 200),
        ("bump", HOUSE, 0.02, 200),
        ("flat", [("bin", "packing_bin", 1.0), *PACKING], 0.01, 100),
    ],
    ids=["flat", "ramp", "bump", "packing"],
)
def test_nothing_touches_and_nothing_is_over_the_border(
    make: Make, surface: str, kinds: list[tuple[str, str, float]], gap: float, seeds: int
) -> None:
    scene = _scene(make, surface, kinds)
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        scene.clear(rng)
        place_apart(scene, rng, scene.objects, gap)
        _assert_apart_and_inside(scene, gap)
    scene.world.close()


def test_one_more_is_laid_away_from_what_is_there(make: Make) -> None:
    scene = _scene(make, "ramp", HOUSE)
    for seed in range(50):
        rng = np.random.default_rng(seed)
        scene.clear(rng)
        *others, last = scene.objects
        place_apart(scene, rng, others, 0.03)
        before = [item.pose for item in others]
        last.place(free_pose(scene, rng, last, 0.03))
        assert [item.pose for item in others] == before
        _assert_apart_and_inside(scene, 0.03)
    scene.world.close()


def test_without_random_orientation_all_lie_straight(make: Make) -> None:
    scene = _scene(make, "flat", HOUSE)
    scene.config = replace(scene.config, random_orientation=False)
    place_apart(scene, np.random.default_rng(0), scene.objects, 0.03)
    assert all(item.pose.yaw == 0.0 for item in scene)
    scene.world.close()


def test_too_much_is_refused(make: Make) -> None:
    scene = _scene(make, "flat", HOUSE)
    with pytest.raises(PlacementError, match="workspace: found no room for 6 objects"):
        place_apart(scene, np.random.default_rng(0), scene.objects, 0.3)
    scene.world.close()


def test_points_keep_their_distances(scene: Scene) -> None:
    rng = np.random.default_rng(0)
    for _ in range(100):
        points = scatter(scene, rng, [0.02, 0.08, 0.05], 0.1)
        for point, margin in zip(points, (0.02, 0.08, 0.05), strict=True):
            assert is_within(scene, point, margin)
        pairs = [(a, b) for n, a in enumerate(points) for b in points[:n]]
        assert min(math.dist(a, b) for a, b in pairs) >= 0.1


def test_aligned_points_share_x(scene: Scene) -> None:
    points = scatter(scene, np.random.default_rng(0), [0.03, 0.03, 0.03], 0.05, aligned=True)
    assert len({x for x, _ in points}) == 1


def test_one_point_is_uniform(scene: Scene) -> None:
    rng = np.random.default_rng(1)
    points = np.array([scatter(scene, rng, [0.05], 0.0)[0] for _ in range(2000)])
    counts, *_ = np.histogram2d(*points.T, bins=4, range=[[0.35, 0.55], [-0.1, 0.1]])
    assert counts.sum() == 2000
    assert np.abs(counts - 125.0).max() < 5.0 * math.sqrt(125.0)


def test_search_is_bounded(scene: Scene) -> None:
    rng = np.random.default_rng(0)
    with pytest.raises(PlacementError, match="workspace"):
        scatter(scene, rng, [0.05] * 3, 0.3)
    with pytest.raises(PlacementError, match="workspace"):
        sample_until(lambda: 0, lambda drawn: False)


def test_too_wide_a_margin_is_refused(scene: Scene) -> None:
    with pytest.raises(PlacementError, match="workspace"):
        scatter(scene, np.random.default_rng(0), [0.16], 0.0)


def test_draw_until_returns_what_fits() -> None:
    numbers = iter(range(10))
    assert sample_until(lambda: next(numbers), lambda number: number > 3) == 4


def test_roomiest_is_away_from_all_others(scene: Scene) -> None:
    for item, (x, y) in zip(scene.objects, ((0.35, -0.1), (0.35, 0.1), (0.4, 0.0)), strict=True):
        item.place(Pose.planar(x, y, 0.025))
    x, y = most_free_point(scene, scene.objects[2])
    assert x > 0.5 and is_within(scene, (x, y), 0.03)
