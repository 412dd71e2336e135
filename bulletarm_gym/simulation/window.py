"""What a person does in PyBullet's window, and what is drawn there for them alone."""

import math
from collections.abc import Sequence

from bulletarm_gym.geometry import Vector
from bulletarm_gym.simulation.client import Client

MARK_WIDTH = 3.0
"""Pixels."""
MARK_COLOUR = (1.0, 0.35, 0.2)

Segment = tuple[Vector, Vector]


def look(client: Client, eye: Vector, target: Vector) -> None:
    """Show the window's picture alone, without panels, from a place (m, world) that looks at another."""
    across, along, up = (a - b for a, b in zip(eye, target, strict=True))
    distance = math.dist(eye, target)
    yaw, pitch = math.degrees(math.atan2(across, -along)), math.degrees(math.asin(up / distance))
    client.configureDebugVisualizer(client.COV_ENABLE_GUI, 0)
    client.resetDebugVisualizerCamera(distance, yaw, -pitch, target)


class Keyboard:
    """The keys of a window, which from then on takes no letters as commands of its own.

    What a key did since the last look is all that PyBullet tells. Of one that went down and up again in
    between, as it does while a step is computed, it tells only that it was released.

    :param client: whose window
    """

    def __init__(self, client: Client) -> None:
        self._client = client
        client.configureDebugVisualizer(client.COV_ENABLE_KEYBOARD_SHORTCUTS, 0)
        self._down: set[int] = set()

    def pressed(self) -> list[str]:
        """Return the characters whose keys went down since the last call; without a window none."""
        events = self._client.getKeyboardEvents()
        went_down = [key for key, did in sorted(events.items()) if self._went_down(key, did)]
        ups = {key for key, did in events.items() if did & self._client.KEY_WAS_RELEASED}
        self._down = (self._down | set(events)) - ups
        return [chr(key) for key in went_down if chr(key).isascii() and chr(key).isprintable()]

    def _went_down(self, key: int, did: int) -> bool:
        released = did & self._client.KEY_WAS_RELEASED and key not in self._down
        return bool(did & self._client.KEY_WAS_TRIGGERED or released)


def draw_segments(client: Client, segments: Sequence[Segment], replaced: Sequence[int] = ()) -> list[int]:
    """Draw lines (m, world) in the window only, instead of earlier ones.

    :param replaced: what the last call returned
    :return: what the next call replaces
    """
    old = [{"replaceItemUniqueId": item} for item in replaced] or [{}] * len(segments)
    return [
        client.addUserDebugLine(start, end, MARK_COLOUR, MARK_WIDTH, **options)
        for (start, end), options in zip(segments, old, strict=True)
    ]
