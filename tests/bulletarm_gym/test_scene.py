"""Sampling of poses, the loaded bodies if sizes are sampled, and values that are computed once a pose."""

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest

from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.geometry import PlacementError, Pose
from bulletarm_gym.objects import create
from bulletarm_gym.objects.blocks import SHAPES
from bulletarm_gym.observations import HeightRenderer, Window
from bulletarm_gym.robots import ROBOTS
from bulletarm_gym.scene import ObjectSlot, Scene
from bulletarm_gym.scene.predicates import touching
from bulletarm_gym.scene.sampling import (
    footprint,
    free_pose,
    is_within,
    most_free_point,
    place_apart,
    sample_until,
    scatter,
)
from bulletarm_gym.scene.scene import MAX_BODIES
from bulletarm_gym.surfaces import SURFACES

Make = Callable[..., ManipulationEnv]

STACKING = "BulletArm/CloseLoopBlockStacking-v0"
PACKING = "BulletArm/OpenLoopBinPacking-v0"
RANGE = {"object_scale_range": [0.7, 0.9]}
SKIN = 1e-3
"""Thickness (m) that Bullet adds to convex hulls."""
WORKSPACE = [[0.25, 0.65], [-0.2, 0.2], [0.0, 1.0]]
HOUSE = [*(("cube", 0.6) for _ in range(4)), ("brick", 0.6), ("roof", 0.6)]
BIN = [("packing_bin", 1.0), *((f"packing_block_{number % 7}", 0.8) for number in range(8))]


# Sampling


@pytest.fixture(params=["flat", "ramp", "bump", "packing"])
def crowded(make: Make, request: pytest.FixtureRequest) -> Iterator[tuple[Scene, float]]:
    """A scene with the blocks of a house or of a bin, and the gap (m) that they keep."""
    surface, kinds, gap = {"packing": ("flat", BIN, 0.01), "bump": ("bump", HOUSE, 0.02)}.get(
        request.param, (request.param, HOUSE, 0.03)
    )
    slots = [ObjectSlot(str(n), (create(kind, str(n), scale),)) for n, (kind, scale) in enumerate(kinds)]
    config = replace(make(STACKING).config, workspace=WORKSPACE)
    scene = Scene(config, ROBOTS["kuka"], SURFACES[surface](WORKSPACE, (0.03, 0.03)), slots)
    yield scene, gap
    scene.world.close()


def test_objects_are_placed_apart_and_inside(crowded: tuple[Scene, float]) -> None:
    scene, gap = crowded
    for seed in range(50):
        rng = np.random.default_rng(seed)
        scene.clear(rng)
        place_apart(scene, rng, scene.objects, gap)
        for obj in scene:
            low, high = obj.bounds
            assert (low[:2] > [0.25, -0.2]).all() and (high[:2] < [0.65, 0.2]).all()
        for first, second in itertools.combinations(scene, 2):
            assert scene.world.distance(first.body, second.body, gap) > gap - 2.5 * SKIN
    with pytest.raises(PlacementError, match="workspace: found no room for"):
        place_apart(scene, rng, scene.objects, 0.3)


@pytest.fixture
def scene(make: Make) -> Scene:
    env = make(STACKING, num_objects=3)
    env.reset(seed=0)
    return env.scene


def test_points_keep_their_distances(scene: Scene) -> None:
    rng, margins = np.random.default_rng(0), (0.02, 0.08, 0.05)
    for _ in range(50):
        points = scatter(scene, rng, margins, 0.1)
        assert all(is_within(scene, point, margin) for point, margin in zip(points, margins, strict=True))
        assert min(math.dist(a, b) for a, b in itertools.combinations(points, 2)) >= 0.1
    assert len({x for x, _ in scatter(scene, rng, [0.03] * 3, 0.05, aligned=True)}) == 1
    for margins, gap in (((0.05,) * 3, 0.3), ((0.16,), 0.0)):
        with pytest.raises(PlacementError, match="workspace"):
            scatter(scene, rng, margins, gap)


def test_free_pose_is_away_from_all_others(scene: Scene) -> None:
    *others, last = scene.objects
    last.place(free_pose(scene, np.random.default_rng(0), last, 0.03))
    assert all(footprint(last).gap(footprint(other)) >= 0.03 for other in others)


def test_a_point_is_uniform(scene: Scene) -> None:
    rng = np.random.default_rng(1)
    points = np.array([scatter(scene, rng, [0.05], 0.0)[0] for _ in range(2000)])
    counts, *_ = np.histogram2d(*points.T, bins=4, range=[[0.35, 0.55], [-0.1, 0.1]])
    assert counts.sum() == 2000
    assert np.abs(counts - 125.0).max() < 5.0 * math.sqrt(125.0)


def test_sample_until_returns_the_first_sample_that_fits() -> None:
    numbers = iter(range(10))
    assert sample_until(lambda: next(numbers), lambda number: number > 3) == 4
    with pytest.raises(PlacementError, match="workspace"):
        sample_until(lambda: 0, lambda number: False)


def test_most_free_point_is_away_from_all_others(scene: Scene) -> None:
    for obj, (x, y) in zip(scene.objects, ((0.35, -0.1), (0.35, 0.1), (0.4, 0.0)), strict=True):
        obj.place(Pose.planar(x, y, 0.025))
    x, y = most_free_point(scene, scene.objects[2])
    assert x > 0.5 and is_within(scene, (x, y), 0.03)


# Loaded bodies


def test_a_range_of_sizes_keeps_all_sizes_and_shapes_in_few_bodies(make: Make) -> None:
    full, env = make(PACKING), make(PACKING, **RANGE)
    assert all(len(obj.choices) == len(obj.slot.variants) for obj in full.scene.objects)
    assert len(env.scene.world.bodies) <= MAX_BODIES + 2  # with ground and arm
    pairs = set()
    for obj in env.scene.objects[1:]:
        own = {tuple(obj.slot.variants[place].name.split()[-2:]) for place in obj.choices}
        assert len({shape for shape, _ in own}) == len(SHAPES) and len({scale for _, scale in own}) >= 7
        pairs |= own
    assert len(pairs) == len(SHAPES) * len(env.config.scales)


# Values that are computed once a pose


def test_relations_and_heightmaps_follow_the_poses(make: Make) -> None:
    env = make("BulletArm/OpenLoopBlockStacking-v0")
    env.reset(seed=0)
    scene, window = env.scene, Window(env.config.centre, env.config.workspace_size, 64)
    first, second = list(scene)[:2]
    renderer, before = HeightRenderer.of(scene), footprint(first)
    assert footprint(first) is before and not touching(scene, first, second)
    x, y, z = second.pose.position
    first.place(Pose((x, y, z + second.spec.extents[2])))
    assert touching(scene, first, second) and footprint(first).centre == pytest.approx((x, y))
    assert first.lowest == pytest.approx(second.bounds[1, 2], abs=1e-6)
    state, alone = env.get_state(), renderer.heights_of([first.body], window)
    first.place(Pose((x + 0.1, y, z)))
    assert not touching(scene, first, second)
    assert not np.array_equal(renderer.heights_of([first.body], window), alone)
    env.set_state(state)
    assert touching(scene, first, second)
    np.testing.assert_array_equal(renderer.heights_of([first.body], window), alone)
    first.park()
    assert renderer.heights_of([first.body], window).max() == 0.0
