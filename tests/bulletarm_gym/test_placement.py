"""Finding room: uniform, apart, bounded."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.footprint import PlacementError
from bulletarm_gym.geometry import Pose
from bulletarm_gym.placement import draw_until, is_within, roomiest, scatter
from bulletarm_gym.scene import Scene

Make = Callable[..., ManipulationEnv]


@pytest.fixture
def scene(make: Make) -> Scene:
    env = make("BulletArm/CloseLoopBlockStacking-v0", num_objects=3)
    env.reset(seed=0)
    return env.scene


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
        draw_until(lambda: 0, lambda drawn: False)


def test_too_wide_a_margin_is_refused(scene: Scene) -> None:
    with pytest.raises(ValueError, match="workspace"):
        scatter(scene, np.random.default_rng(0), [0.16], 0.0)


def test_draw_until_returns_what_fits() -> None:
    numbers = iter(range(10))
    assert draw_until(lambda: next(numbers), lambda number: number > 3) == 4


def test_roomiest_is_away_from_all_others(scene: Scene) -> None:
    for item, (x, y) in zip(scene.items, ((0.35, -0.1), (0.35, 0.1), (0.4, 0.0)), strict=True):
        item.place(Pose.planar(x, y, 0.025))
    x, y = roomiest(scene, scene.items[2])
    assert x > 0.5 and is_within(scene, (x, y), 0.03)
