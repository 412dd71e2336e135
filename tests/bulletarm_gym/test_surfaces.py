"""Surfaces and the sampling of poses on them; loaded bodies, and values that are computed once a pose."""

import math
import re

import gymnasium
import numpy as np
import pytest
from rollouts import CLOSE_STACKING

from bulletarm_gym.geometry import Footprint, PlacementError
from bulletarm_gym.observations import HeightRenderer, Window
from bulletarm_gym.scene.predicates import on_site, on_surface
from bulletarm_gym.scene.sampling import footprint, free_site, place_apart
from bulletarm_gym.simulation import World
from bulletarm_gym.simulation.state import PHYSICS_MODES
from bulletarm_gym.surfaces import SURFACES, RampSurface

WORKSPACE = [[0.25, 0.65], [-0.2, 0.2], [0.01, 0.5]]
PARAMETERS = {"workspace": WORKSPACE, "num_objects": 4, "object_scale_range": 0.6}
PIXELS = 96
SKIN = 2e-3
"""Maximum thickness (m) of the skin around Bullet's convex hulls, such as pyramids."""
SHOULDER = 2
"""Number of links of an arm, from the base on, that are too low to pass over a ramp."""


@pytest.fixture(params=["flat", "ramp", "bump"])
def env(request, make):
    return make(CLOSE_STACKING, surface=request.param, **PARAMETERS)


def load(name, site=(0.03, 0.03)):
    """Return a surface in a world of its own."""
    surface = SURFACES[name](WORKSPACE, site)
    surface.load(World(PHYSICS_MODES["fast"]))
    return surface


def grid():
    """Return the centres of the pixels of a heightmap of the workspace, (n, 2)."""
    (x0, x1), (y0, y1), _ = WORKSPACE
    line = (np.arange(PIXELS) + 0.5) / PIXELS
    x, y = np.meshgrid(x0 + (x1 - x0) * line, y0 + (y1 - y0) * line, indexing="ij")
    return np.stack([x, y], axis=-1).reshape(-1, 2)


def test_heightmap_and_simulation_have_the_heights_of_the_surface(env):
    scene, points = env.scene, grid()
    for seed in range(4):
        scene.clear(np.random.default_rng(seed))
        window = Window(env.config.centre, env.config.workspace_size, PIXELS)
        rendered = HeightRenderer.of(scene).heights(window).ravel()
        assert np.abs(rendered - scene.surface.heights(points)).max() < 1e-4
    points = points[::211]
    starts, ends = ([(*point, height) for point in points.tolist()] for height in (0.4, -0.1))
    hits = scene.world.client.rayTestBatch(starts, ends)
    ground = np.isin([hit[0] for hit in hits], [body.id for body in scene.surface.bodies])
    assert ground.mean() > 0.8, "the other rays hit the arm"
    struck = np.array([hit[3][2] for hit in hits])
    assert np.abs(struck - scene.surface.heights(points))[ground].max() < SKIN


@pytest.mark.parametrize("side", [0.04, 0.1, 0.2])
def test_ramps_fit_small_workspaces(side):
    ramp = RampSurface([[0.4, 0.4 + side], [0.0, side], [0.0, 0.3]])
    ramp.load(World(PHYSICS_MODES["fast"]))
    for seed in range(5):
        ramp.arrange(np.random.default_rng(seed))
        assert all(piece.shape.extents[1] > 0.0 for body in ramp.bodies[1:] for piece in body.spec.pieces)
        assert np.isfinite(ramp.heights([ramp.centre])).all()


def test_ranges_of_the_ramps():
    ramp, rng, rows = load("ramp"), np.random.default_rng(0), []
    for _ in range(1000):
        ramp.arrange(rng)
        first, second = ramp.ramps
        assert np.add(first.uphill, second.uphill) == pytest.approx((0.0, 0.0), abs=1e-12)
        yaw = math.atan2(first.uphill[1], first.uphill[0]) % (2.0 * math.pi)
        middle = [float(side.distances([ramp.centre])[0]) for side in (first, second)]
        rows.append((ramp.gap, yaw, first.slope, second.slope, first.edge[2], second.edge[2], *middle))
    low, high = np.min(rows, axis=0), np.max(rows, axis=0)
    limits = [(0.04, 0.2), (0.0, 2.0 * math.pi), *[(0.0, math.pi / 6.0)] * 2, *[(0.0, 0.01)] * 2]
    for column, (least, most) in enumerate(limits):
        close = 0.02 * (most - least)
        assert least <= low[column] < least + close and most - close < high[column] <= most + 1e-9
    assert (high[6:] <= -0.02 + 1e-9).all() and (low[6:] >= -0.1 - 1e-9).all()
    wide = load("ramp", site=(0.1, 0.1))
    for _ in range(100):
        wide.arrange(rng)
        assert 0.1 <= wide.gap <= 0.2


def test_ranges_of_the_bumps():
    bump, rng, slopes, places = load("bump"), np.random.default_rng(0), [], []
    for _ in range(1000):
        bump.arrange(rng)
        slopes.append(np.arctan(bump._slopes[bump._numbers]))
        places.append((*bump.platform.position[:2], bump.platform.yaw))
    assert np.shape(slopes) == (1000, 9)
    assert 0.0 < np.min(slopes) < math.radians(1.0) and np.max(slopes) == pytest.approx(math.pi / 12.0)
    assert np.mean(slopes) == pytest.approx(math.pi / 24.0, rel=0.05)
    assert (np.ptp(places, axis=0) > (0.15, 0.15, 6.2)).all()
    assert bump.level == pytest.approx(0.1 * math.tan(math.pi / 12.0))


def test_placed_objects_fit_and_stay(env):
    scene, on_strip = env.scene, []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        scene.clear(rng)
        place_apart(scene, rng, scene.objects, gap=0.03)
        before = [item.pose for item in scene]
        assert all(scene.surface.fits(footprint(item)) for item in scene)
        scene.begin()
        scene.settle()
        for item, pose in zip(scene, before, strict=True):
            assert on_surface(scene, item)
            if scene.surface.keeps_poses:
                assert math.dist(item.pose.position, pose.position) < 1e-3
                on_strip.append(on_site(scene, item))
    if isinstance(scene.surface, RampSurface):
        assert 0.1 < np.mean(on_strip) < 0.6


def test_sites_are_level_free_and_inside(env):
    scene, surface, rng = env.scene, env.scene.surface, np.random.default_rng(3)
    for size in ((0.03, 0.03), (0.035, 0.12)) * 15:
        scene.clear(rng)
        site = surface.goal_site(size, rng)
        base = Footprint.rectangle(size, site)
        assert site.tilt == pytest.approx(0.0, abs=1e-6) and site.z == surface.level
        assert base.is_inside(WORKSPACE)
        inside = 0.999 * (base.points - site.position[:2]) + site.position[:2]
        assert surface.heights(inside) == pytest.approx(site.z)
        place_apart(scene, rng, scene.objects[:2], gap=0.03)
        base = Footprint.rectangle((0.03, 0.08), free_site(scene, rng, (0.03, 0.08), 0.02))
        assert all(base.gap(footprint(item)) >= 0.02 for item in scene)
    with pytest.raises(PlacementError, match="workspace"):
        surface.goal_site((0.3, 0.5), rng)


def test_surface_that_does_not_fit_the_task_is_refused():
    for name, surface, others in (
        ("CloseLoopBlockStacking", "lawn", "one of 'flat'"),
        ("OpenLoopBottleArrangement", "ramp", "'flat'.*bottles fall"),
        ("OpenLoopBinPacking", "tray", "'flat' or 'ramp' or 'bump'.*the bin"),
        ("CloseLoopCornerPicking", "tray", "'flat'.*tray"),
    ):
        with pytest.raises(ValueError, match=r"surface must be .*, got") as error:
            gymnasium.make(f"BulletArm/{name}-v0", surface=surface)
        assert re.search(others, str(error.value)) and surface in str(error.value)
    with pytest.raises(ValueError, match=r"surface must be 'flat' or 'tray'.*, got 'ramp'.*level"):
        gymnasium.make("BulletArm/CloseLoopBlockPicking-v0", surface="ramp", close_loop_tray=True)


def test_scenes_with_little_space_are_valid(make):
    for name, parameters, seeds in (
        ("CloseLoopBlockInBowl", {"surface": "bump"}, range(8)),  # without space the surface is sampled again
        ("OpenLoopBumpBoxPalletizing", {"random_orientation": False}, (295, 341, 404)),
        ("OpenLoopBumpHouseBuilding4", {"workspace_check": "bounding_box"}, (382, 470, 483, 701)),
    ):
        env = make(f"BulletArm/{name}-v0", **parameters)
        assert all(env.reset(seed=seed)[1]["is_valid"] for seed in seeds)


@pytest.mark.parametrize("robot", ["kuka", "panda", "ur5"])
def test_ramps_keep_clear_of_the_arm(make, robot):
    scene = make(CLOSE_STACKING, surface="ramp", robot=robot, **PARAMETERS).scene
    for seed in range(20):
        scene.clear(np.random.default_rng(seed))
        plates = [body for body in scene.surface.bodies[1:] if scene.world.active[body.index]]
        near = [point for one in plates for point in scene.world.closest_points(scene.robot.body, one, 0.02)]
        # The base is as fixed as the plates.
        assert len(plates) == 2 and not any(0 <= point.link < SHOULDER for point in near)
