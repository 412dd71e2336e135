"""Ramps and bumps: their geometry, what is drawn, what lies on them, where structures stand."""

import math
import pickle
from collections.abc import Callable, Iterable
from typing import Any

import gymnasium
import numpy as np
import pytest
from rollouts import advance, transcript

from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.geometry import Footprint, PlacementError, Pose, rotate
from bulletarm_gym.observations import HeightRenderer, Window
from bulletarm_gym.scene.predicates import on_site, on_surface
from bulletarm_gym.scene.sampling import footprint, free_site, place_apart
from bulletarm_gym.simulation import World
from bulletarm_gym.simulation.state import PHYSICS_MODES
from bulletarm_gym.surfaces import SURFACES, BumpSurface, RampSurface

ENV_ID = "BulletArm/CloseLoopBlockStacking-v0"
WORKSPACE = [[0.25, 0.65], [-0.2, 0.2], [0.01, 0.5]]
PARAMETERS = {"workspace": WORKSPACE, "num_objects": 4, "object_scale_range": 0.6}
PIXELS = 96
MARGIN = 2e-3
"""Bullet wraps pyramids, as all convex hulls, in a skin of a millimetre."""
SHOULDER = 2
"""Links of an arm, from the base on, that are too low to pass over a ramp."""
Make = Callable[..., ManipulationEnv]


@pytest.fixture(params=["flat", "ramp", "bump"])
def env(request: pytest.FixtureRequest, make: Make) -> ManipulationEnv:
    return make(ENV_ID, surface=request.param, **PARAMETERS)


@pytest.fixture
def ramp() -> RampSurface:
    surface = SURFACES["ramp"](WORKSPACE, (0.03, 0.03))
    surface.load(World(PHYSICS_MODES["fast"]))
    assert isinstance(surface, RampSurface)
    return surface


@pytest.fixture
def bump() -> BumpSurface:
    surface = SURFACES["bump"](WORKSPACE, (0.03, 0.03))
    surface.load(World(PHYSICS_MODES["fast"]))
    assert isinstance(surface, BumpSurface)
    return surface


def _grid(env: ManipulationEnv) -> np.ndarray:
    line = (np.arange(PIXELS) + 0.5) * env.config.workspace_size / PIXELS - env.config.workspace_size / 2
    x, y = np.meshgrid(line + env.config.centre[0], line + env.config.centre[1], indexing="ij")
    return np.stack([x, y], axis=-1).reshape(-1, 2)


def test_heightmap_shows_the_surface(env: ManipulationEnv) -> None:
    scene, points = env.scene, _grid(env)
    for seed in range(20):
        scene.clear(np.random.default_rng(seed))
        window = Window(env.config.centre, env.config.workspace_size, PIXELS)
        seen = HeightRenderer.of(scene).heights(window).ravel()
        assert np.abs(seen - scene.surface.heights(points)).max() < 1e-4


def test_normals_are_those_of_the_heights(env: ManipulationEnv) -> None:
    surface, points, step = env.scene.surface, _grid(env)[::97], 1e-5
    surface.arrange(np.random.default_rng(1))
    slopes = np.stack(
        [surface.heights(points + move) - surface.heights(points - move) for move in step * np.eye(2)], axis=1
    ) / (2.0 * step)
    bends = np.abs(
        surface.heights(points + step) + surface.heights(points - step) - 2.0 * surface.heights(points)
    )
    checked = 0
    for point, slope, bend in zip(points.tolist(), slopes, bends, strict=True):
        if bend < 1e-8:
            normal = surface.normal(point)
            assert np.allclose(normal, np.append(-slope, 1.0) / math.hypot(*slope, 1.0), atol=1e-6)
            upward = rotate(surface.pose(point, 0.7).orientation, (0.0, 0.0, 1.0))
            assert np.allclose(upward, normal, atol=1e-9)
            checked += 1
    assert checked > 0.8 * len(points)


def test_the_simulated_ground_is_where_it_is_said_to_be(env: ManipulationEnv) -> None:
    scene = env.scene
    env.reset(seed=2)
    client, points = scene.world.client, _grid(env)[::211]
    for item in scene.objects:
        item.park()
    hits = client.rayTestBatch([(*p, 0.4) for p in points.tolist()], [(*p, -0.1) for p in points.tolist()])
    ground = np.isin([hit[0] for hit in hits], [body.id for body in scene.surface.bodies])
    struck = np.array([hit[3][2] for hit in hits])
    assert ground.mean() > 0.8, "the rest hits the arm"
    assert np.abs(struck - scene.surface.heights(points))[ground].max() < MARGIN


def test_ranges_of_the_ramps(ramp: RampSurface) -> None:
    rng = np.random.default_rng(0)
    rows = []
    for _ in range(1000):
        ramp.arrange(rng)
        first, second = ramp.ramps
        assert np.allclose(np.add(first.uphill, second.uphill), 0.0, atol=1e-12)
        yaw = math.atan2(first.uphill[1], first.uphill[0]) % (2.0 * math.pi)
        middle = [float(r.distances([ramp.centre])[0]) for r in (first, second)]
        rows.append((ramp.gap, yaw, first.slope, second.slope, first.edge[2], second.edge[2], *middle))
    low, high = np.min(rows, axis=0), np.max(rows, axis=0)
    limits = [(0.04, 0.2), (0.0, 2.0 * math.pi), *[(0.0, math.pi / 6.0)] * 2, *[(0.0, 0.01)] * 2]
    for column, (least, most) in enumerate(limits):
        close = 0.02 * (most - least)
        assert least <= low[column] < least + close and most - close < high[column] <= most + 1e-9
    assert (high[6:] <= -0.02 + 1e-9).all() and (low[6:] >= -0.1 - 1e-9).all()
    assert abs(np.corrcoef(np.transpose(rows)[2:4])[0, 1]) < 0.1


def test_the_strip_has_room_for_what_is_built() -> None:
    surface = SURFACES["ramp"](WORKSPACE, (0.1, 0.1))
    surface.load(World(PHYSICS_MODES["fast"]))
    assert isinstance(surface, RampSurface)
    rng = np.random.default_rng(0)
    for _ in range(200):
        surface.arrange(rng)
        assert 0.1 <= surface.gap <= 0.2


def test_ranges_of_the_bumps(bump: BumpSurface) -> None:
    rng = np.random.default_rng(0)
    slopes, yaws, places = [], [], []
    for _ in range(1000):
        bump.arrange(rng)
        assert len(bump.slopes) == 9
        slopes.append(bump.slopes)
        yaws.append(bump._world.poses[bump._pyramids[bump._numbers[0]].index].yaw)
        places.append(bump.platform.position[:2])
    assert 0.0 < np.min(slopes) < math.radians(1.0) and np.max(slopes) == pytest.approx(math.pi / 12.0)
    assert np.mean(slopes) == pytest.approx(math.pi / 24.0, rel=0.05)
    assert min(yaws) < -3.1 and max(yaws) > 3.1
    assert np.ptp(places, axis=0).min() > 0.15
    assert bump.level == pytest.approx(0.1 * math.tan(math.pi / 12.0))


def test_what_is_laid_fits_and_stays(env: ManipulationEnv) -> None:
    scene = env.scene
    on_strip = []
    for seed in range(40):
        scene.clear(np.random.default_rng(seed))
        place_apart(scene, np.random.default_rng(seed), scene.objects, gap=0.03)
        laid = [item.pose for item in scene]
        for item in scene:
            assert scene.surface.fits(footprint(item))
        scene.begin()
        scene.settle()
        for item, pose in zip(scene, laid, strict=True):
            assert on_surface(scene, item)
            if not isinstance(scene.surface, BumpSurface):
                assert math.dist(item.pose.position, pose.position) < 1e-3
                on_strip.append(on_site(scene, item))
    if isinstance(scene.surface, RampSurface):
        assert 0.1 < np.mean(on_strip) < 0.6


def test_the_steepest_ramp_holds_a_block(make: Make) -> None:
    env = make(ENV_ID, surface="ramp", **PARAMETERS)
    env.reset(seed=0)
    scene, surface = env.scene, env.scene.surface
    assert isinstance(surface, RampSurface)
    for seed in range(2000):
        surface.arrange(np.random.default_rng(seed))
        ramp = surface.ramps[0]
        if ramp.slope > 0.99 * math.pi / 6.0:
            break
    assert ramp.slope > 0.99 * math.pi / 6.0
    item = scene.objects[0]
    point = tuple(np.add(ramp.edge[:2], 0.05 * np.array(ramp.uphill)).tolist())
    item.place(surface.lay(item.spec, point, 0.4))
    before = item.pose
    for _ in range(3):
        scene.begin()
        scene.world.step(240)
        scene.world.end()
    assert math.dist(item.pose.position, before.position) < 1e-3


@pytest.mark.parametrize("size", [(0.03, 0.03), (0.035, 0.12)])
def test_goal_sites_are_level_ground(env: ManipulationEnv, size: tuple[float, float]) -> None:
    surface = env.scene.surface
    rng = np.random.default_rng(3)
    for _ in range(50):
        env.scene.clear(rng)
        site = surface.goal_site(size, rng)
        base = Footprint.rectangle(size, site)
        assert site.tilt == pytest.approx(0.0, abs=1e-6) and site.z == surface.level
        assert base.is_inside(WORKSPACE)
        assert np.allclose(
            surface.heights(0.999 * (base.points - site.position[:2]) + site.position[:2]), site.z
        )


def test_a_site_that_fits_nowhere_is_refused(env: ManipulationEnv) -> None:
    with pytest.raises(PlacementError, match="workspace"):
        env.scene.surface.goal_site((0.3, 0.5), np.random.default_rng(0))


def test_a_free_site_keeps_away_from_what_lies_there(env: ManipulationEnv) -> None:
    rng = np.random.default_rng(5)
    for seed in range(10):
        env.scene.clear(np.random.default_rng(seed))
        env.scene.surface.lay(env.scene.objects[0].spec, (0.45, 0.0), 0.0)
        place_apart(env.scene, rng, env.scene.objects[:2], gap=0.03)
        base = Footprint.rectangle((0.03, 0.08), free_site(env.scene, rng, (0.03, 0.08), 0.02))
        assert all(base.gap(footprint(item)) >= 0.02 for item in env.scene)


@pytest.mark.parametrize("surface", ["ramp", "bump"])
def test_the_ground_is_part_of_the_state(make: Make, surface: str) -> None:
    env, other = (make(ENV_ID, instance, surface=surface, **PARAMETERS) for instance in range(2))
    state = advance(env, 4, 2)
    heights = env.scene.surface.heights(_grid(env))
    expected = transcript(env, 8)
    other.reset(seed=9)
    assert not np.array_equal(other.scene.surface.heights(_grid(env)), heights)
    for instance in (env, other):
        instance.set_state(pickle.loads(pickle.dumps(state)))
        assert np.array_equal(instance.scene.surface.heights(_grid(env)), heights)
        assert transcript(instance, 8) == expected


def test_a_seed_gives_the_ground_whatever_was_before(make: Make) -> None:
    env, other = (make(ENV_ID, instance, surface="bump", **PARAMETERS) for instance in range(2))
    env.reset(seed=6)
    for seed in (1, 6):
        other.reset(seed=seed)
    assert np.array_equal(env.scene.surface.heights(_grid(env)), other.scene.surface.heights(_grid(env)))


def test_unknown_surfaces_are_refused() -> None:
    with pytest.raises(ValueError, match=r"surface must be one of 'flat'.*, got 'lawn'"):
        gymnasium.make(ENV_ID, surface="lawn")


@pytest.mark.parametrize(
    ("name", "parameters", "others", "reason"),
    [
        ("OpenLoopBottleArrangement", {"surface": "ramp"}, "'flat'", "bottles fall"),
        ("OpenLoopCovidTest", {"surface": "bump"}, "'flat'", "30 x 30 cm"),
        ("OpenLoopBinPacking", {"surface": "tray"}, "'flat' or 'ramp' or 'bump'", "the bin"),
        ("OpenLoopObjectGrasping", {"surface": "ramp"}, "'flat' or 'tray'", "level"),
        ("CloseLoopObjectGrasping", {"surface": "bump"}, "'flat' or 'tray'", "level"),
        ("CloseLoopBlockPicking", {"surface": "ramp", "close_loop_tray": True}, "'flat' or 'tray'", "level"),
        ("CloseLoopCornerPicking", {"surface": "tray"}, "'flat'", "does not fit into the tray"),
        ("CloseLoopDrawerOpening", {"surface": "ramp"}, "'flat'", "cabinet stands on level ground"),
    ],
)
def test_ground_that_a_task_cannot_stand_on_is_refused(
    name: str, parameters: dict[str, Any], others: str, reason: str
) -> None:
    message = f"surface must be {others} .*, got '{parameters['surface']}': .*{reason}"
    with pytest.raises(ValueError, match=message):
        gymnasium.make(f"BulletArm/{name}-v0", **parameters)


@pytest.mark.parametrize(
    ("env_id", "parameters", "seeds"),
    [
        ("BulletArm/CloseLoopBlockInBowl-v0", {"surface": "bump"}, range(8)),
        ("BulletArm/OpenLoopBumpBoxPalletizing-v0", {"random_orientation": False}, (295, 341, 404)),
    ],
)
def test_without_room_the_ground_is_drawn_anew(
    make: Make, env_id: str, parameters: dict[str, Any], seeds: Iterable[int]
) -> None:
    env = make(env_id, **parameters)
    assert all(env.reset(seed=seed)[1]["is_valid"] for seed in seeds)


def test_nothing_slides_over_the_border(make: Make) -> None:
    env = make("BulletArm/OpenLoopBumpHouseBuilding4-v0", workspace_check="bounding_box")
    assert all(env.reset(seed=seed)[1]["is_valid"] for seed in (382, 470, 483, 701))


@pytest.mark.parametrize("robot", ["kuka", "panda", "ur5"])
def test_ramps_keep_clear_of_the_arm(make: Make, robot: str) -> None:
    scene = make(ENV_ID, surface="ramp", robot=robot, **PARAMETERS).scene
    for seed in range(200):
        scene.clear(np.random.default_rng(seed))
        plates = [body for body in scene.surface.bodies[1:] if scene.world.active[body.index]]
        assert len(plates) == 2
        for body in plates:
            points = scene.world.client.getClosestPoints(scene.robot.body.id, body.id, 0.02)
            assert not any(0 <= point[3] < SHOULDER for point in points)  # the base is as fixed as the plate


def test_gap_of_footprints() -> None:
    square = Footprint.rectangle((0.1, 0.1), Pose((0.0, 0.0, 0.0)))
    for degrees in range(0, 360, 7):
        turn = math.radians(degrees)
        for distance in (0.16, 0.3):
            other = Footprint.rectangle((0.1, 0.1), Pose.planar(distance, 0.0, 0.0, turn))
            clear = other.points[:, 0].min() - 0.05
            assert clear - 0.002 < square.gap(other) <= math.hypot(clear, 0.1)
    assert square.gap(Footprint.rectangle((0.1, 0.1), Pose.planar(0.09, 0.0, 0.0))) < 0.0
