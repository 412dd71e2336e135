"""Camera, keyboard and line marks of PyBullet's window."""

import math
from collections.abc import Sequence

from bulletarm_gym.geometry import Vector
from bulletarm_gym.simulation.world import World

Segment = tuple[Vector, Vector]
"""Start and end (m) of a line."""


def look(world: World, eye: Vector, target: Vector) -> None:
    """Set the camera of the window to a position and a target (m), and hide the panels."""
    client = world.client
    across, along, up = (a - b for a, b in zip(eye, target, strict=True))
    distance = math.dist(eye, target)
    yaw, pitch = math.degrees(math.atan2(across, -along)), math.degrees(math.asin(up / distance))
    client.configureDebugVisualizer(client.COV_ENABLE_GUI, 0)
    client.resetDebugVisualizerCamera(distance, yaw, -pitch, target)


class Keyboard:
    """Keys of a window. PyBullet's own shortcuts are switched off.

    PyBullet reports what happened to a key since the last call. For a key that was pressed and released in
    between, it reports the release only.

    :param world: the world that the window shows
    """

    def __init__(self, world: World) -> None:
        self._client = world.client
        self._client.configureDebugVisualizer(self._client.COV_ENABLE_KEYBOARD_SHORTCUTS, 0)
        self._down: set[int] = set()

    def pressed(self) -> list[str]:
        """Return the characters of the keys pressed since the last call; empty without a window."""
        events = self._client.getKeyboardEvents()
        triggered = {key for key, event in events.items() if event & self._client.KEY_WAS_TRIGGERED}
        released = {key for key, event in events.items() if event & self._client.KEY_WAS_RELEASED}
        pressed = sorted(triggered | (released - self._down))
        self._down = (self._down | set(events)) - released
        return [chr(key) for key in pressed if chr(key).isascii() and chr(key).isprintable()]


def draw_segments(world: World, segments: Sequence[Segment], replaced: Sequence[int] = ()) -> list[int]:
    """Draw orange lines (m, world), 3 pixels wide, in the window, in place of earlier lines.

    :param replaced: return value of the last call
    :return: numbers of the lines
    """
    options = [{"replaceItemUniqueId": item} for item in replaced] or [{}] * len(segments)
    return [
        world.client.addUserDebugLine(start, end, (1.0, 0.35, 0.2), 3.0, **option)
        for (start, end), option in zip(segments, options, strict=True)
    ]
