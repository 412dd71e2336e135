"""Images: heightmaps of closed-loop control, cameras, and colour, depth and segmentation sensors."""

import math
from contextlib import closing
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import MagicMock

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import RenderCollection
from rollouts import PICKING, STACKING, make_env

from bulletarm_gym.geometry import Pose, euler_pose, matrix
from bulletarm_gym.objects.solids import block
from bulletarm_gym.observations.cameras import Viewer, side_cameras
from bulletarm_gym.observations.images import FINGER_COLOUR, GRIPPER
from bulletarm_gym.simulation import BodySpec, Camera, World
from bulletarm_gym.simulation.shapes import RED
from bulletarm_gym.simulation.state import PHYSICS_MODES
from bulletarm_gym.surfaces.surface import FLOOR

EXTENT, SIZE = 0.45, 128
RESOLUTION = EXTENT / SIZE
CAMERA_OFFSET, FINGER = 0.1, 0.021


def look(env, hand, cube):
    """Return the heightmap with the open gripper and the cube at poses."""
    env.scene.robot.home(hand)
    env.scene["cube"].place(cube)
    return env.observe()["heightmap"][0]


def raised(image):
    """Return the mask of pixels above the floor."""
    return (image > 0) & (image < image.max() - 0.01)


def centroid(mask, extent=EXTENT):
    """Return the mean offset (m) in x and y of the masked pixels from the centre of the image."""
    assert mask.any()
    return (np.argwhere(mask).mean(axis=0) - (len(mask) - 1) / 2) * extent / len(mask)


@pytest.mark.parametrize("height", [0.08, 0.25, 0.35])
def test_depth_is_metric_and_clipped(make, height):
    env = make(PICKING, seed=0)
    image = look(env, Pose.planar(0.45, 0.0, height), Pose.planar(0.52, 0.06, 0.025, 0.3))
    assert image.max() == pytest.approx(min(height + CAMERA_OFFSET, 0.4), abs=1e-6)
    row, column = (round((SIZE - 1) / 2 + offset / RESOLUTION) for offset in (0.07, 0.06))
    assert image[row, column] == pytest.approx(min(height + CAMERA_OFFSET - 0.05, 0.4), abs=1e-6)
    if height < 0.3:
        assert raised(image).sum() * RESOLUTION**2 == pytest.approx(0.05**2, rel=0.05)


def test_image_is_centred_on_the_fingertips_and_larger_than_the_workspace(make):
    """Rows grow with x, columns with y."""
    env = make(PICKING, seed=0)
    for hand, offset in (
        ((0.45, 0.0), (0.1, 0.0)),
        ((0.45, 0.0), (0.0, 0.12)),
        ((0.37, 0.08), (0.09, -0.13)),
    ):
        cube = Pose.planar(hand[0] + offset[0], hand[1] + offset[1], 0.025, 0.2)
        image = look(env, Pose.planar(*hand, 0.2, math.pi / 4), cube)
        np.testing.assert_allclose(centroid(raised(image)), offset, atol=RESOLUTION / 2)
    env = make(PICKING, obs_size=32, workspace=[[0.3, 0.5], [-0.1, 0.1], [0.01, 0.25]], seed=0)
    image = look(env, Pose.planar(0.4, 0.0, 0.2), Pose.planar(0.5, 0.0, 0.025))
    assert image.shape == (32, 32)
    np.testing.assert_allclose(centroid(raised(image), 0.3), (0.1, 0.0), atol=0.3 / 64)


@pytest.mark.parametrize("yaw", [0.0, 0.6, -1.0])
@pytest.mark.parametrize("ratio", [1.0, 0.5])
def test_gripper_is_two_squares(make, yaw, ratio):
    """The arm and the rest of the gripper are not rendered."""
    env = make(PICKING, seed=0)
    env.scene.robot.home(Pose.planar(0.45, 0.0, 0.06, yaw))
    env.scene["cube"].park()
    env.scene.robot.set_opening(ratio)
    image = env.observe()["heightmap"][0]
    squares = image == 0.0
    assert np.isclose(image[~squares], image.max(), atol=1e-6).all()
    axis = np.array([math.cos(yaw), math.sin(yaw)])
    along = np.zeros(image.shape)
    along[squares] = (np.argwhere(squares) - (SIZE - 1) / 2) @ axis
    reach = (env.scene.robot.opening + FINGER) / 2
    for side, sign in ((along > 0, 1.0), (along < 0, -1.0)):
        np.testing.assert_allclose(centroid(side), sign * reach * axis, atol=RESOLUTION / 2)
        assert side.sum() * RESOLUTION**2 == pytest.approx(FINGER**2, rel=0.2)


def test_grasped_object_is_visible(make):
    env = make(PICKING, seed=3)
    while env.scene.held is None:
        env.step(env.expert_action())
    observation, *_ = env.step([-1.0, 0.0, 0.0, 1.0, 0.0])
    assert observation["holding"].tolist() == [1.0]
    hand, cube = env.scene.robot.pose, env.scene["cube"].pose
    middle = observation["heightmap"][0, SIZE // 2, SIZE // 2]
    assert middle == pytest.approx(hand.z + CAMERA_OFFSET - (cube.z + 0.025), abs=2e-3)


# The view "point_cloud"


@pytest.mark.parametrize("name", ["BlockPicking", "BlockPushing"])
def test_point_cloud_view_agrees_with_the_orthographic_view(make, name):
    """Within a millimetre except at edges, and where the arm hides something from both cameras."""
    env_id = f"BulletArm/CloseLoop{name}-v0"
    first, second = (make(env_id, view=view) for view in ("orthographic", "point_cloud"))
    seen, clouded = (each.reset(seed=0)[0] for each in (first, second))
    for _ in range(3):
        difference = np.abs(seen["heightmap"] - clouded["heightmap"])
        assert np.median(difference) < 1e-5 and (difference > 5e-3).mean() < 0.03
        action = first.expert_action()
        seen, clouded = first.step(action)[0], second.step(action)[0]


# Cameras


TOP = ["heightmap", "color", "segmentation"]
EXACT = 5e-6
"""Error (m) of a depth that the rasterizer's 32-bit depth buffer explains."""


def test_intrinsics_and_extrinsics_give_the_point_of_a_pixel():
    """The camera looks at a large plate, whose upper side is the plane z = 0 of a tilted frame."""
    world, pose = World(PHYSICS_MODES["fast"]), euler_pose((0.1, -0.05, 0.02), (0.3, -0.2, 0.0))
    world.add(BodySpec("plate", (block((6.0, 6.0, 0.1), (0.0, 0.0, -0.05)),), mass=0.0), pose)
    world.seal()
    world.begin()
    camera = Camera((0.4, -0.6, 0.9), (0.1, 0.0, 0.0), width=60, height=40)
    depth, to_world = camera.depth(world), np.linalg.inv(camera.extrinsics)
    np.testing.assert_allclose(to_world[:3, 3], camera.eye)
    assert np.linalg.det(camera.extrinsics[:3, :3]) == pytest.approx(1.0)
    for column, row in ((0, 0), (59, 0), (17, 33), (59, 39)):
        ray = np.linalg.inv(camera.intrinsics) @ [column, row, 1.0]
        point = (to_world @ [*(depth[row, column] * ray), 1.0])[:3]
        assert abs((point - pose.position) @ matrix(pose)[:, 2]) < EXACT
        assert camera.project(tuple(point)) == pytest.approx((column, row), abs=1e-4)


def test_shadows_end_near_their_object():
    """A column at a corner of the workspace darkens the ground beside it, and none 0.7 m farther."""
    world = World(PHYSICS_MODES["fast"])
    world.add_plane(FLOOR)
    world.add(BodySpec("column", (block((0.05, 0.05, 0.2)),), mass=0.0), Pose.planar(0.62, 0.18, 0.1))
    world.seal()
    world.begin()
    for x, y, darker in ((0.6, 0.3, True), (1.5, 0.6, False)):
        camera = Camera((x, y, 2.0), (x, y, 0.0), 32.0, 100, 100)
        assert (camera.color(world) < replace(camera, shadow=False).color(world)).any() == darker


WORKSPACES = [
    [[0.3, 0.6], [-0.15, 0.15], [0.01, 0.25]],
    [[-0.15, 0.15], [-0.6, -0.3], [0.01, 0.25]],
    [[0.44, 0.56], [-0.06, 0.06], [0.01, 0.25]],
]


def of_colour(image, colour):
    """Return the mask of the pixels of (3, size, size) that have a colour."""
    return (image == np.rint(255 * np.array(colour[:3]))[:, None, None]).all(axis=0)


def red_pixels(image):
    """Return the number of pixels of an image (height, width, 3) that show the red cube."""
    red, green, _ = np.moveaxis(image.astype(int), -1, 0)
    return np.count_nonzero((red > 2.5 * green) & (red > 80))


@pytest.mark.parametrize("robot", ["kuka", "ur5_robotiq"])
@pytest.mark.parametrize("workspace", WORKSPACES, ids=str)
def test_default_cameras_show_the_workspace(workspace, robot):
    """The corners of the floor and the cube are visible, and the floor fills a share of the width."""
    corners = [(x, y, 0.0) for x in workspace[0] for y in workspace[1]]
    with closing(make_env(PICKING, robot=robot, observation=["rgb"], workspace=workspace)) as env:
        env.reset(seed=0)
        x, y = env.config.centre
        env.scene.robot.home(Pose.planar(x, y, 0.2))
        env.scene["cube"].place(Pose.planar(x, y + 0.3 * env.config.workspace_size, 0.025))
        for name, share in (("render", 0.12), ("rgb", 0.3)):
            camera = env.cameras[name]
            width, height = camera.camera.width, camera.camera.height
            pixels = np.array([camera.camera.project(corner) for corner in corners])
            assert (pixels >= 0).all() and (pixels <= (width - 1, height - 1)).all(), name
            assert np.ptp(pixels[:, 0]) > share * width, name
            assert red_pixels(camera.color()) > 1e-3 * width * height, name
        assert red_pixels(env.viewer.close_up(84)) > 1e-3 * 84 * 84
        pixels = np.array([side.project(at) for side in side_cameras(env.config, 100) for at in corners])
        assert (pixels > 0).all() and (pixels < 99).all()


def test_render_size_and_render_camera(make):
    top = {"position": [0.75, 0.0, 1.2], "target": [0.45, 0.0, 0.0], "fov": 30}
    kwargs = {"render_mode": "rgb_array", "render_size": [96, 64], "render_camera": top}
    env = RenderCollection(gymnasium.make(PICKING, **kwargs))
    env.reset(seed=0)
    env.step(env.action_space.sample())
    frames = env.render()
    assert [frame.shape for frame in frames] == [(64, 96, 3)] * 2 and red_pixels(frames[0])
    camera = env.unwrapped.cameras["render"].camera
    assert camera.eye == (0.75, 0.0, 1.2) and camera.fov == 30.0
    plain = make(PICKING)
    narrow = make(PICKING, render_camera={"fov": 20}, render_size=32, render_mode="depth_array")
    first, second = plain.cameras["render"].camera, narrow.cameras["render"].camera
    assert second == replace(first, fov=20.0, width=32, height=32)
    narrow.reset(seed=0)
    np.testing.assert_array_equal(narrow.render(), narrow.cameras["render"].depth())


@pytest.mark.parametrize("env_id", [PICKING, STACKING])
def test_wrist_camera_moves_with_the_gripper(make, env_id):
    mounted = {"mount": "wrist", "size": [64, 48]}
    sensors = [{"name": "wrist", "sensor": "rgb", **mounted}, {"name": "depth", **mounted}]
    env = make(env_id, observation=sensors)
    observation, _ = env.reset(seed=0)
    assert observation in env.observation_space
    assert observation["wrist"].shape == (3, 48, 64) and observation["depth"].shape == (1, 48, 64)
    camera, tcp_pose = env.cameras["wrist"], env.scene.robot.pose
    mount = tcp_pose.inverse().transform(camera.camera.eye)
    moved = tcp_pose.compose(Pose.planar(0.03, 0.02, 0.01, 0.5))
    env.scene.robot.home(moved)
    assert camera.camera.eye == pytest.approx(moved.transform(mount), abs=1e-4)
    pixel = camera.camera.project(moved.transform((0.0, 0.0, -0.03)))
    assert pixel == pytest.approx((31.5, 23.5), abs=1e-2)
    np.testing.assert_array_equal(env.observe()["depth"][0], env.cameras["depth"].depth())


def test_point_cloud_measures_the_cube(make):
    env = make(PICKING, observation=["heightmap", {"name": "point_cloud", "points": 4000}], seed=0)
    env.scene.robot.home(Pose.planar(0.38, -0.08, 0.2))
    cube = Pose.planar(0.5, 0.06, 0.025, 0.3)
    env.scene["cube"].place(cube)
    points = env.observe()["point_cloud"] + [0.38, -0.08, 0.2]
    local = (points - cube.position) @ matrix(cube)
    assert np.abs(local[:, :2]).max() < 0.025 + 0.006  # a pixel
    upper = np.unique(points[points[:, 2] > 0.0495], axis=0)
    assert len(upper) > 100 and upper[:, 2].max() == pytest.approx(0.05, abs=3 * EXACT)
    env.scene["cube"].place(Pose.planar(1.5, 0.0, 0.025))
    assert not env.observe()["point_cloud"].any()


# Color and segmentation


def test_color_and_segmentation_show_the_cube_and_the_fingers(make):
    env = make(PICKING, observation=TOP, seed=0)
    images = []
    for turn, x, y in ((0.0, 0.07, 0.06), (math.pi / 2, -0.06, 0.07)):
        env.scene.robot.home(Pose.planar(0.45, 0.0, 0.2, 0.4 + turn))
        env.scene["cube"].place(Pose.planar(0.45 + x, y, 0.025, 0.3 + turn))
        images.append(env.observe())
    first, second = images
    numbers, color = first["segmentation"][0], first["color"]
    cube, fingers = of_colour(color, RED), of_colour(color, np.array(FINGER_COLOUR) / 255)
    for mask in (first["heightmap"][0] == 0.0, numbers == GRIPPER):
        np.testing.assert_array_equal(mask, fingers)
    np.testing.assert_array_equal(cube, numbers == 1)
    np.testing.assert_array_equal(of_colour(color, FLOOR.colour), ~cube & ~fingers)
    np.testing.assert_allclose(centroid(cube), (0.07, 0.06), atol=RESOLUTION / 2)
    for name in TOP:
        assert (np.rot90(first[name], 1, axes=(1, 2)) != second[name]).mean() < 1e-3, name


def test_open_loop_segmentation_numbers_slots_and_omits_the_grasped_object(make):
    env = make(STACKING, observation=[*TOP, "holding"], object_scale_range=[0.6, 0.7])
    for seed in range(2):
        before, _ = env.reset(seed=seed)
        assert set(np.unique(before["segmentation"])) == {0, 1, 2, 3, 4}
    after, *_ = env.step(env.expert_action())
    assert after["holding"] == 1.0
    held = next(n for n, item in enumerate(env.scene.objects, 1) if item is env.scene.held)
    assert set(np.unique(after["segmentation"])) == {0, 1, 2, 3, 4} - {held}


def test_pressed_keys_are_those_that_went_down():
    client = SimpleNamespace(KEY_IS_DOWN=1, KEY_WAS_TRIGGERED=2, KEY_WAS_RELEASED=4)
    client.COV_ENABLE_KEYBOARD_SHORTCUTS = client.configureDebugVisualizer = MagicMock()
    config, world = SimpleNamespace(render_mode="human"), SimpleNamespace(client=client)
    viewer, shift, tapped = Viewer(SimpleNamespace(config=config, world=world)), 65306, 4
    for events, pressed in (
        ({"w": 3, "a": tapped, ".": 2, "q": 6}, [".", "a", "q", "w"]),
        ({"w": 1}, []),
        ({"w": 4, "q": tapped}, ["q"]),
        ({"w": tapped}, ["w"]),
    ):
        found = {shift: 3, **{ord(key): event for key, event in events.items()}}
        client.getKeyboardEvents = lambda found=found: found
        assert viewer.pressed_keys() == pressed
