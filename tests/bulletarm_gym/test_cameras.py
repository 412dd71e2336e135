"""Cameras: what a pixel measures, and where default cameras look."""

from collections.abc import Callable

import numpy as np
import pytest

from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.geometry import FloatArray, Pose, euler_pose, matrix
from bulletarm_gym.objects.solids import block
from bulletarm_gym.simulation import BodySpec, Camera, World
from bulletarm_gym.simulation.physics import PHYSICS_MODES

Make = Callable[..., ManipulationEnv]

PICKING = "BulletArm/CloseLoopBlockPicking-v0"
STACKING = "BulletArm/OpenLoopBlockStacking-v0"
TILTS = [(0.0, 0.0), (0.3, 0.0), (0.0, -0.4), (-0.5, 0.2), (0.2, 0.7)]
SIZES = [(64, 64), (128, 128), (90, 60)]
EXACT = 5e-6
"""Error (m) of a depth that the rasterizer's 32-bit depth buffer explains."""


def tilted_plane(tilt: tuple[float, float]) -> tuple[World, Pose]:
    """A large plate whose upper side is the plane z = 0 of a tilted frame."""
    world = World(PHYSICS_MODES["fast"])
    pose = euler_pose((0.1, -0.05, 0.02), (*tilt, 0.0))
    world.add(BodySpec("plate", (block((6.0, 6.0, 0.1), (0.0, 0.0, -0.05)),), mass=0.0), pose)
    world.seal()
    world.begin()
    return world, pose


def heights_above(pose: Pose, points: FloatArray) -> FloatArray:
    return (points - pose.position) @ matrix(pose)[:, 2]


@pytest.mark.parametrize("tilt", TILTS, ids=str)
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_points_lie_on_a_tilted_plane(tilt: tuple[float, float], size: tuple[int, int]) -> None:
    world, pose = tilted_plane(tilt)
    for eye in ((0.3, -0.5, 1.0), (0.0, 0.0, 1.2)):
        points = Camera(eye, (0.0, 0.0, 0.0), 35.6, *size, near=0.1, far=6.0).points(world, [])
        assert len(points) > 0.9 * size[0] * size[1]
        assert np.abs(heights_above(pose, points)).max() < EXACT


def test_a_pixel_is_a_point_of_the_world_by_intrinsics_and_extrinsics() -> None:
    world, pose = tilted_plane((0.3, -0.2))
    camera = Camera((0.4, -0.6, 0.9), (0.1, 0.0, 0.0), width=60, height=40)
    depth, to_world = camera.depth(world), np.linalg.inv(camera.extrinsics)
    for column, row in ((0, 0), (59, 0), (17, 33), (59, 39)):
        ray = np.linalg.inv(camera.intrinsics) @ [column, row, 1.0]
        point = (to_world @ [*(depth[row, column] * ray), 1.0])[:3]
        assert abs(heights_above(pose, point)) < EXACT
        assert camera.project(tuple(point)) == pytest.approx((column, row), abs=1e-4)


def test_extrinsics_are_a_rotation_and_the_position() -> None:
    camera = Camera((0.4, -0.6, 0.9), (0.1, 0.0, 0.0))
    np.testing.assert_allclose(np.linalg.inv(camera.extrinsics)[:3, 3], camera.eye)
    rotation = camera.extrinsics[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_point_cloud_sensor_measures_the_upper_side_of_a_cube(make: Make) -> None:
    env = make(PICKING, observation=["heightmap", {"name": "point_cloud", "points": 4000}])
    env.reset(seed=0)
    env.scene.robot.home(Pose.planar(0.38, -0.08, 0.2))
    env.scene["cube"].place(Pose.planar(0.5, 0.06, 0.025, 0.3))
    points = env.observe()["point_cloud"] + [0.38, -0.08, 0.2]
    upper = np.unique(points[points[:, 2] > 0.0495], axis=0)
    assert len(upper) > 100 and upper[:, 2].max() == pytest.approx(0.05, abs=3 * EXACT)
    assert np.median(upper[:, 2]) == pytest.approx(0.05, abs=EXACT)


def test_point_cloud_view_shows_the_floor_at_its_height(make: Make) -> None:
    env = make(PICKING, view="point_cloud")
    env.reset(seed=0)
    env.scene["cube"].park()
    hand = env.scene.robot.pose
    floor = env.observe()["heightmap"]
    assert np.abs(floor[floor > 0.0] - (hand.z + 0.1)).max() < 3 * EXACT
