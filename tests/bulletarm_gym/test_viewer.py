"""What people look at and press, without a display."""

from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest

import bulletarm_gym  # noqa: F401
from bulletarm_gym.observations.viewer import Viewer
from bulletarm_gym.simulation import window

ENV_ID = "BulletArm/CloseLoopBlockPicking-v0"


class Window:
    """Stands for a physics server with a window."""

    KEY_IS_DOWN, KEY_WAS_TRIGGERED, KEY_WAS_RELEASED = 1, 2, 4
    COV_ENABLE_KEYBOARD_SHORTCUTS, COV_ENABLE_GUI = 9, 1

    def __init__(self) -> None:
        self.events: dict[int, int] = {}
        self.options: list[tuple[int, int]] = []
        self.lines: list[dict[str, Any]] = []

    def getKeyboardEvents(self) -> dict[int, int]:
        return self.events

    def configureDebugVisualizer(self, option: int, value: int) -> None:
        self.options.append((option, value))

    def resetDebugVisualizerCamera(self, *camera: Any) -> None:
        self.camera = camera

    def addUserDebugLine(self, *line: Any, **options: Any) -> int:
        self.lines.append({"line": line, **options})
        return len(self.lines)


def test_close_up_shows_the_workspace() -> None:
    env: Any = gymnasium.make(ENV_ID).unwrapped
    env.reset(seed=0)
    picture = env.viewer.close_up(64)
    assert picture.shape == (64, 64, 3) and picture.dtype == np.uint8
    red = (picture[..., 0] > 120) & (picture[..., 1] < 60)
    assert 10 < red.sum() < 400
    env.close()


def test_looking_changes_nothing() -> None:
    looked, other = (gymnasium.make(ENV_ID) for _ in range(2))
    for env in (looked, other):
        env.reset(seed=0)
    for _ in range(4):
        viewer = looked.get_wrapper_attr("viewer")
        viewer.close_up(16)
        viewer.mark((0.4, 0.0, 0.1), 0.3)
        action = looked.get_wrapper_attr("expert_action")()
        first, second = looked.step(action)[0], other.step(action)[0]
        np.testing.assert_array_equal(first["heightmap"], second["heightmap"])


def test_keys_need_a_window() -> None:
    env: Any = gymnasium.make(ENV_ID).unwrapped
    with pytest.raises(RuntimeError, match=r"^render_mode must be 'human'"):
        env.viewer.pressed_keys()


def test_keys_that_went_down() -> None:
    client: Any = Window()
    scene: Any = SimpleNamespace(
        config=SimpleNamespace(render_mode="human"), world=SimpleNamespace(client=client)
    )
    viewer = Viewer(scene)
    shift, tapped, held = 65306, 4, 1
    client.events = {ord("w"): 3, ord("a"): tapped, shift: 3, ord("."): 2, ord("q"): 6}
    assert viewer.pressed_keys() == [".", "a", "q", "w"]
    assert client.options == [(client.COV_ENABLE_KEYBOARD_SHORTCUTS, 0)]
    client.events = {ord("w"): held}
    assert viewer.pressed_keys() == []
    client.events = {ord("w"): 4, ord("q"): tapped}
    assert viewer.pressed_keys() == ["q"]
    client.events = {ord("w"): tapped}
    assert viewer.pressed_keys() == ["w"]
    assert len(client.options) == 1


def test_the_window_looks_where_close_ups_do() -> None:
    client: Any = Window()
    eye, target = (1.0, -1.0, 2.0**0.5 + 0.1), (0.0, 0.0, 0.1)
    window.look(SimpleNamespace(client=client), eye, target)
    assert client.options == [(client.COV_ENABLE_GUI, 0)]
    distance, yaw, pitch, seen = client.camera
    assert (distance, yaw, pitch) == pytest.approx((2.0, 45.0, -45.0)) and seen == target


def test_a_mark_replaces_the_last_one() -> None:
    client: Any = Window()
    world: Any = SimpleNamespace(client=client)
    segments = [((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)), ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))]
    first = window.draw_segments(world, segments)
    window.draw_segments(world, segments, first)
    assert [line.get("replaceItemUniqueId") for line in client.lines] == [None, None, 1, 2]
