"""What a person does in PyBullet's window, and what is drawn there for them alone."""

from collections.abc import Sequence

from bulletarm_gym.geometry import Vector
from bulletarm_gym.simulation.client import Client

MARK_WIDTH = 3.0
"""Pixels."""
MARK_COLOUR = (1.0, 0.35, 0.2)

Segment = tuple[Vector, Vector]


def take_keyboard(client: Client) -> None:
    """Keep the window from taking letters as commands of its own, and hide its panels."""
    client.configureDebugVisualizer(client.COV_ENABLE_KEYBOARD_SHORTCUTS, 0)
    client.configureDebugVisualizer(client.COV_ENABLE_GUI, 0)


def pressed_keys(client: Client) -> list[str]:
    """Return the characters whose keys went down since the last call; without a window none."""
    events = client.getKeyboardEvents()
    return [
        chr(key)
        for key, state in sorted(events.items())
        if state & client.KEY_WAS_TRIGGERED and chr(key).isascii() and chr(key).isprintable()
    ]


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
