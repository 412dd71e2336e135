"""Cameras: what a pixel measures, and where default cameras look."""

import json
import math
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import RenderCollection
from numpy.typing import NDArray
from rollouts import make_env

from bulletarm_gym.config import ParameterError
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.geometry import FloatArray, Pose, euler_pose, matrix
from bulletarm_gym.objects.solids import block
from bulletarm_gym.observations.cameras import side_cameras, viewpoint
from bulletarm_gym.simulation import BodySpec, Camera, World
from bulletarm_gym.simulation.state import PHYSICS_MODES

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


# Default cameras

ASIDE = [[-0.15, 0.15], [-0.6, -0.3], [0.01, 0.25]]
WORKSPACES = [
    None,
    ASIDE,
    [[-0.15, 0.15], [0.35, 0.65], [0.01, 0.25]],
    [[0.44, 0.56], [-0.06, 0.06], [0.01, 0.25]],
    [[0.2, 0.66], [-0.23, 0.23], [0.01, 0.25]],
]


def corners(workspace: Sequence[Sequence[float]]) -> list[tuple[float, float, float]]:
    return [(x, y, 0.0) for x in workspace[0] for y in workspace[1]]


def red_pixels(image: NDArray[np.uint8]) -> int:
    """Number of pixels of a color image (height, width, 3) that show the red cube."""
    red, green, _ = np.moveaxis(image.astype(int), -1, 0)
    return int(((red > 2.5 * green) & (red > 80)).sum())


def check_default_cameras(env: ManipulationEnv) -> None:
    """The whole floor of the workspace and the cube are visible, and the floor fills a third of the width."""
    env.reset(seed=0)
    x, y = env.config.centre
    env.scene.robot.home(Pose.planar(x, y, 0.2))
    env.scene["cube"].place(Pose.planar(x, y, 0.025))
    env.observe()
    for name, share in (("rgb", 1 / 3), ("render", 1 / 8)):
        camera = env.cameras[name]
        width, height = camera.camera.width, camera.camera.height
        pixels = np.array([camera.camera.project(corner) for corner in corners(env.config.workspace)])
        assert (pixels >= 0).all() and (pixels <= (width - 1, height - 1)).all(), name
        assert np.ptp(pixels[:, 0]) > share * width, name
        assert red_pixels(camera.color()) > 1e-3 * width * height, name
    close_up = np.array(env.viewer.close_up(84))
    assert red_pixels(close_up) > 1e-3 * close_up.shape[0] * close_up.shape[1]


@pytest.mark.parametrize("robot", ["kuka", "panda", "ur5", "ur5_robotiq"])
@pytest.mark.parametrize("workspace", WORKSPACES, ids=str)
def test_default_cameras_look_at_the_configured_workspace(workspace: Any, robot: str) -> None:
    chosen = {} if workspace is None else {"workspace": workspace}
    try:
        env = make_env(PICKING, robot=robot, observation=["rgb"], **chosen)
    except ParameterError as error:
        assert "reaches" in str(error)
        pytest.skip(f"{robot} does not reach {workspace}")
    with closing(env):
        check_default_cameras(env)


@pytest.mark.parametrize("base", [(1.04, 0.0), (0.45, 0.59), (0.45, -0.59), (0.45, 0.0)], ids=str)
def test_default_cameras_look_towards_the_arm_over_the_workspace(base: tuple[float, float]) -> None:
    model = SimpleNamespace(base=Pose((*base, 0.1)))
    config = SimpleNamespace(centre=(0.45, 0.0), workspace_size=0.3)
    scene: Any = SimpleNamespace(config=config, robot=SimpleNamespace(model=model))
    eye, target = viewpoint(scene, (0.5, -0.2, 0.6), (0.0, 0.0, 0.05))
    assert target == pytest.approx((0.45, 0.0, 0.05))
    assert math.dist(eye[:2], base) > math.dist((0.45, 0.0), base)


def test_side_cameras_cover_a_large_workspace(make: Make) -> None:
    for workspace in (None, [[0.2, 0.66], [-0.23, 0.23], [0.01, 0.25]]):
        env = make(PICKING, **({} if workspace is None else {"workspace": workspace}))
        for camera in side_cameras(env.config, 100):
            pixels = np.array([camera.project(corner) for corner in corners(env.config.workspace)])
            assert (pixels > 0).all() and (pixels < 99).all()


# Parameters of render()


def test_render_size_and_render_camera_are_those_of_make() -> None:
    top = {"position": [0.75, 0.0, 1.2], "target": [0.45, 0.0, 0.0], "fov": 30}
    kwargs = {"render_mode": "rgb_array", "render_size": [96, 64], "render_camera": top}
    env = RenderCollection(gymnasium.make(PICKING, **kwargs))
    env.reset(seed=0)
    env.step(env.action_space.sample())
    frames: Any = env.render()
    assert [frame.shape for frame in frames] == [(64, 96, 3)] * 2
    core: Any = env.unwrapped
    assert core.cameras["render"].camera.eye == (0.75, 0.0, 1.2) and core.cameras["render"].camera.fov == 30.0
    assert red_pixels(frames[0]) > 0
    again = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(env.unwrapped.spec.to_json()))  # type: ignore[union-attr]
    again.reset(seed=0)
    np.testing.assert_array_equal(again.render(), frames[0])
    env.close()
    again.close()


def test_render_camera_takes_its_defaults_from_the_workspace(make: Make) -> None:
    plain, turned = make(PICKING), make(PICKING, render_camera={"fov": 20}, render_size=32)
    first, second = plain.cameras["render"].camera, turned.cameras["render"].camera
    assert second == replace(first, fov=20.0, width=32, height=32)
    assert first.eye == pytest.approx(Camera.eye) and first.target == pytest.approx(Camera.target)


def test_render_camera_at_its_target_is_refused() -> None:
    camera = {"position": [0.4, 0.0, 0.1], "target": [0.4, 0.0, 0.1]}
    with pytest.raises(ParameterError, match=r"render_camera: target must be .*got \[0\.4, 0\.0, 0\.1\]"):
        make_env(PICKING, render_camera=camera)


def test_depth_array_has_the_render_size() -> None:
    with closing(make_env(PICKING, render_mode="depth_array", render_size=32)) as env:
        env.reset(seed=0)
        np.testing.assert_array_equal(env.render(), env.cameras["render"].depth())
        assert env.render().shape == (32, 32)


# Cameras by name


def test_every_camera_has_intrinsics_extrinsics_and_depth_by_name(make: Make) -> None:
    side = {"name": "side", "sensor": "rgb", "position": [0.45, 0.6, 0.3], "size": 96}
    env = make(PICKING, view="point_cloud", observation=["heightmap", side, "point_cloud"])
    observation, _ = env.reset(seed=0)
    names = ["render", "heightmap_0", "heightmap_1", "side", "point_cloud_0", "point_cloud_1"]
    assert list(env.cameras) == names
    for camera in env.cameras.values():
        assert camera.intrinsics.shape == (3, 3) and camera.extrinsics.shape == (4, 4)
        assert camera.depth().shape == (camera.camera.height, camera.camera.width)
    np.testing.assert_array_equal(env.cameras["side"].color().transpose(2, 0, 1), observation["side"])


def test_the_pixel_of_the_cube_is_at_the_cube(make: Make) -> None:
    env = make(PICKING, observation=["rgb"])
    env.reset(seed=0)
    env.scene.robot.home(Pose.planar(0.36, 0.1, 0.2))
    env.scene["cube"].place(Pose.planar(0.5, -0.06, 0.025, 0.3))
    env.observe()
    camera = env.cameras["rgb"]
    column, row = np.rint(camera.camera.project((0.5, -0.06, 0.05))).astype(int)
    ray = np.linalg.inv(camera.intrinsics) @ [column, row, 1.0] * camera.depth()[row, column]
    x, y, z = (np.linalg.inv(camera.extrinsics) @ [*ray, 1.0])[:3]
    assert (x, y) == pytest.approx((0.5, -0.06), abs=0.01) and z == pytest.approx(0.05, abs=1e-4)


def test_parameters_of_cameras_are_json(make: Make) -> None:
    env = make(PICKING, render_camera={"fov": 20}, render_size=32)
    assert json.loads(json.dumps(env.config.parameters()))["render_size"] == [32, 32]
