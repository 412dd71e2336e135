"""Cameras and the images of color, depth and segmentation sensors, against the poses of what they show."""

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
from gymnasium.envs.registration import EnvSpec
from gymnasium.wrappers import RenderCollection
from numpy.typing import NDArray
from rollouts import make_env

from bulletarm_gym.config import ParameterError
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.geometry import Pose, euler_pose, matrix
from bulletarm_gym.objects.solids import block
from bulletarm_gym.observations.cameras import Viewer, side_cameras
from bulletarm_gym.observations.images import FINGER_COLOUR, GRIPPER
from bulletarm_gym.simulation import BodySpec, Camera, World
from bulletarm_gym.simulation.shapes import BLUE, RED
from bulletarm_gym.simulation.state import PHYSICS_MODES
from bulletarm_gym.surfaces.surface import FLOOR

Make = Callable[..., ManipulationEnv]

PICKING = "BulletArm/CloseLoopBlockPicking-v0"
PUSHING = "BulletArm/CloseLoopBlockPushing-v0"
STACKING = "BulletArm/OpenLoopBlockStacking-v0"
TOP = ["heightmap", "color", "segmentation"]
EXTENT, SIZE = 0.45, 128
EXACT = 5e-6
"""Error (m) of a depth that the rasterizer's 32-bit depth buffer explains."""

# Geometry


def test_intrinsics_and_extrinsics_give_the_point_of_a_pixel() -> None:
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


# Default cameras

WORKSPACES = [
    None,
    [[-0.15, 0.15], [-0.6, -0.3], [0.01, 0.25]],
    [[0.44, 0.56], [-0.06, 0.06], [0.01, 0.25]],
    [[0.2, 0.66], [-0.23, 0.23], [0.01, 0.25]],
]


def corners(workspace: Sequence[Sequence[float]]) -> list[tuple[float, float, float]]:
    return [(x, y, 0.0) for x in workspace[0] for y in workspace[1]]


def red_pixels(image: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Return rows and columns of the pixels of an image (height, width, 3) that show the red cube."""
    red, green, _ = np.moveaxis(image.astype(int), -1, 0)
    return np.argwhere((red > 2.5 * green) & (red > 80))


@pytest.mark.parametrize("robot", ["kuka", "ur5_robotiq"])
@pytest.mark.parametrize("workspace", WORKSPACES, ids=str)
def test_default_cameras_show_the_workspace(workspace: Any, robot: str) -> None:
    """The corners of the floor and the cube are visible, and the floor fills a share of the width."""
    chosen = {} if workspace is None else {"workspace": workspace}
    try:
        env = make_env(PICKING, robot=robot, observation=["rgb"], **chosen)
    except ParameterError as error:
        assert "reaches" in str(error)
        pytest.skip(f"{robot} does not reach {workspace}")
    with closing(env):
        env.reset(seed=0)
        x, y = env.config.centre
        env.scene.robot.home(Pose.planar(x, y, 0.2))
        env.scene["cube"].place(Pose.planar(x, y + 0.3 * env.config.workspace_size, 0.025))
        for name, share in (("render", 0.12), ("rgb", 0.3)):
            camera = env.cameras[name]
            width, height = camera.camera.width, camera.camera.height
            pixels = np.array([camera.camera.project(corner) for corner in corners(env.config.workspace)])
            assert (pixels >= 0).all() and (pixels <= (width - 1, height - 1)).all(), name
            assert np.ptp(pixels[:, 0]) > share * width, name
            assert len(red_pixels(camera.color())) > 1e-3 * width * height, name
        assert len(red_pixels(env.viewer.close_up(84))) > 1e-3 * 84 * 84
        for side in side_cameras(env.config, 100):
            pixels = np.array([side.project(corner) for corner in corners(env.config.workspace)])
            assert (pixels > 0).all() and (pixels < 99).all()


# Parameters of render()


def test_render_size_and_render_camera() -> None:
    top = {"position": [0.75, 0.0, 1.2], "target": [0.45, 0.0, 0.0], "fov": 30}
    kwargs = {"render_mode": "rgb_array", "render_size": [96, 64], "render_camera": top}
    env = RenderCollection(gymnasium.make(PICKING, **kwargs))
    env.reset(seed=0)
    env.step(env.action_space.sample())
    frames: Any = env.render()
    assert [frame.shape for frame in frames] == [(64, 96, 3)] * 2
    core: Any = env.unwrapped
    assert core.cameras["render"].camera.eye == (0.75, 0.0, 1.2) and core.cameras["render"].camera.fov == 30.0
    assert len(red_pixels(frames[0]))
    again = gymnasium.make(EnvSpec.from_json(core.spec.to_json()))
    again.reset(seed=0)
    np.testing.assert_array_equal(again.render(), frames[0])
    env.close()
    again.close()


def test_render_camera_has_defaults(make: Make) -> None:
    plain = make(PICKING)
    narrow = make(PICKING, render_camera={"fov": 20}, render_size=32, render_mode="depth_array")
    first, second = plain.cameras["render"].camera, narrow.cameras["render"].camera
    assert second == replace(first, fov=20.0, width=32, height=32)
    assert first.eye == pytest.approx(Camera.eye) and first.target == pytest.approx(Camera.target)
    assert json.loads(json.dumps(narrow.config.parameters()))["render_size"] == [32, 32]
    narrow.reset(seed=0)
    np.testing.assert_array_equal(narrow.render(), narrow.cameras["render"].depth())


def test_render_camera_must_not_be_at_its_target() -> None:
    camera = {"position": [0.4, 0.0, 0.1], "target": [0.4, 0.0, 0.1]}
    with pytest.raises(ParameterError, match=r"render_camera: target must be .*got \[0\.4, 0\.0, 0\.1\]"):
        make_env(PICKING, render_camera=camera)


# Cameras of sensors


def test_cameras_have_names(make: Make) -> None:
    side = {"name": "side", "sensor": "rgb", "position": [0.45, 0.6, 0.3], "size": 96}
    env = make(PICKING, view="point_cloud", observation=["heightmap", side, "point_cloud"])
    observation, _ = env.reset(seed=0)
    names = ["render", "heightmap_0", "heightmap_1", "side", "point_cloud_0", "point_cloud_1"]
    assert list(env.cameras) == names
    for camera in env.cameras.values():
        assert camera.intrinsics.shape == (3, 3) and camera.extrinsics.shape == (4, 4)
        assert camera.depth().shape == (camera.camera.height, camera.camera.width)
    np.testing.assert_array_equal(env.cameras["side"].color().transpose(2, 0, 1), observation["side"])


@pytest.mark.parametrize("env_id", [PICKING, STACKING])
def test_wrist_camera_moves_with_the_gripper(make: Make, env_id: str) -> None:
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


def test_camera_from_above_has_rows_along_x_and_columns_along_y(make: Make) -> None:
    above = {"name": "above", "sensor": "rgb", "position": [0.45, 0, 2], "target": [0.45, 0, 0], "size": 100}
    fov = 2 * math.degrees(math.atan(0.225 / 1.95))  # 45 cm at the height of the cube's upper side
    env = make(PICKING, observation=[{**above, "fov": fov}])
    env.reset(seed=0)
    env.scene.robot.home(Pose.planar(0.34, -0.1, 0.2))
    env.scene["cube"].place(Pose.planar(0.57, 0.09, 0.025))
    offset = (red_pixels(env.observe()["above"].transpose(1, 2, 0)).mean(axis=0) - 49.5) * 0.45 / 100
    np.testing.assert_allclose(offset, (0.12, 0.09), atol=0.45 / 100)


def test_point_cloud_measures_the_cube(make: Make) -> None:
    env = make(PICKING, observation=["heightmap", {"name": "point_cloud", "points": 4000}])
    env.reset(seed=0)
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


def of_colour(image: np.ndarray, colour: Sequence[float]) -> np.ndarray:
    """Return the mask of the pixels of (3, size, size) that have a colour."""
    return (image == np.rint(255 * np.array(colour[:3]))[:, None, None]).all(axis=0)


def test_color_and_segmentation_show_the_cube_and_the_fingers(make: Make) -> None:
    env = make(PICKING, observation=TOP)
    env.reset(seed=0)
    images = []
    for turn, x, y in ((0.0, 0.07, 0.06), (math.pi / 2, -0.06, 0.07)):
        env.scene.robot.home(Pose.planar(0.45, 0.0, 0.2, 0.4 + turn))
        env.scene["cube"].place(Pose.planar(0.45 + x, y, 0.025, 0.3 + turn))
        images.append(env.observe())
    first, second = images
    numbers, color = first["segmentation"][0], first["color"]
    cube, fingers = of_colour(color, RED), of_colour(color, np.array(FINGER_COLOUR) / 255)
    assert np.array_equal(fingers, first["heightmap"][0] == 0.0) and np.array_equal(
        fingers, numbers == GRIPPER
    )
    assert np.array_equal(cube, numbers == 1)
    assert np.array_equal(of_colour(color, FLOOR.colour), ~cube & ~fingers)
    centroid = (np.argwhere(cube).mean(axis=0) - (SIZE - 1) / 2) * EXTENT / SIZE
    np.testing.assert_allclose(centroid, (0.07, 0.06), atol=EXTENT / SIZE / 2)
    for name in TOP:
        assert (np.rot90(first[name], 1, axes=(1, 2)) != second[name]).mean() < 1e-3, name


def test_goal_on_the_ground_is_below_the_cube(make: Make) -> None:
    env = make(PUSHING, observation=TOP)
    env.reset(seed=0)
    env.scene.robot.home(Pose.planar(0.45, 0.0, 0.2))
    env.scene["goal"].place(Pose.planar(0.5, 0.1, 0.0))
    env.scene["cube"].place(Pose.planar(0.5, 0.1, 0.025))
    seen = env.observe()
    goal, cube = of_colour(seen["color"], BLUE), of_colour(seen["color"], RED)
    area = (EXTENT / SIZE) ** 2
    assert cube.sum() * area == pytest.approx(0.05**2, rel=0.05)
    assert goal.sum() * area == pytest.approx(0.09**2 - 0.05**2, rel=0.05)
    assert np.array_equal(np.dstack([cube, goal]), np.dstack([seen["segmentation"][0] == n for n in (1, 2)]))


def test_open_loop_segmentation_numbers_slots_and_omits_the_grasped_object(make: Make) -> None:
    env = make(STACKING, observation=[*TOP, "holding"], object_scale_range=[0.6, 0.7])
    for seed in range(2):
        before, _ = env.reset(seed=seed)
        assert set(np.unique(before["segmentation"])) == {0, 1, 2, 3, 4}
    after, *_ = env.step(env.expert_action())
    assert after["holding"] == 1.0
    held = next(n for n, item in enumerate(env.scene.objects, 1) if item is env.scene.held)
    assert set(np.unique(after["segmentation"])) == {0, 1, 2, 3, 4} - {held}


# The window


class Client:
    """Stands for a physics server with a window."""

    KEY_IS_DOWN, KEY_WAS_TRIGGERED, KEY_WAS_RELEASED = 1, 2, 4
    COV_ENABLE_KEYBOARD_SHORTCUTS = 9

    def __init__(self) -> None:
        self.events: dict[int, int] = {}
        self.options: list[tuple[int, int]] = []

    def getKeyboardEvents(self) -> dict[int, int]:
        return self.events

    def configureDebugVisualizer(self, option: int, value: int) -> None:
        self.options.append((option, value))


def viewer_of(client: Client, mode: str) -> Viewer:
    config, world = SimpleNamespace(render_mode=mode), SimpleNamespace(client=client)
    return Viewer(SimpleNamespace(config=config, world=world))


def test_pressed_keys_are_those_that_went_down() -> None:
    client = Client()
    with pytest.raises(RuntimeError, match=r"^render_mode must be 'human'"):
        viewer_of(client, "rgb_array").pressed_keys()
    viewer, shift, tapped = viewer_of(client, "human"), 65306, 4
    for events, pressed in (
        ({"w": 3, "a": tapped, ".": 2, "q": 6}, [".", "a", "q", "w"]),
        ({"w": 1}, []),
        ({"w": 4, "q": tapped}, ["q"]),
        ({"w": tapped}, ["w"]),
    ):
        client.events = {shift: 3, **{ord(key): event for key, event in events.items()}}
        assert viewer.pressed_keys() == pressed
    assert client.options == [(client.COV_ENABLE_KEYBOARD_SHORTCUTS, 0)]


def test_color_without_shadows_and_depth_share_a_rendering(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    front: dict[str, Any] = {"position": [0.9, -0.3, 0.5], "target": [0.45, 0.0, 0.0], "size": 48}
    plain = {"name": "plain", "sensor": "rgb", "shadow": False, **front}
    env = make(PICKING, observation=[{"name": "rgb", **front}, plain, {"name": "depth", **front}])
    env.reset(seed=0)
    calls: list[Camera] = []
    render = Camera._render
    monkeypatch.setattr(Camera, "_render", lambda self, *args: calls.append(self) or render(self, *args))
    observation = env.observe()
    assert len(calls) == 2
    for name in ("rgb", "plain"):
        np.testing.assert_array_equal(env.cameras[name].color().transpose(2, 0, 1), observation[name])
    np.testing.assert_array_equal(env.cameras["depth"].depth(), observation["depth"][0])
    darker = observation["plain"].astype(int) - observation["rgb"]
    assert (darker >= 0).mean() > 0.99 and (darker.max(axis=0) > 10).mean() > 0.005
    env.scene["cube"].place(Pose.planar(0.5, 0.1, 0.025))
    assert (env.observe()["plain"] != observation["plain"]).any()
