"""Connection to a physics server of PyBullet."""

import ctypes
import math
import os
import sys
import tempfile
import weakref
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

from gymnasium.error import ClosedEnvironmentError

from bulletarm_gym.geometry import Vector
from bulletarm_gym.simulation.world import World

__all__ = ["Client", "has_display", "pybullet"]


@contextmanager
def _without_banner(descriptor: int) -> Iterator[None]:
    """Leave out the line that PyBullet prints when it is imported. C code writes past ``sys.stderr``."""
    try:
        original = os.dup(descriptor)
    except OSError:  # the descriptor is closed, as in a daemon
        yield
        return
    with os.fdopen(original, "wb", buffering=0) as stream, tempfile.TemporaryFile() as buffer:
        os.dup2(buffer.fileno(), descriptor)
        try:
            yield
        finally:
            if os.name == "posix":
                ctypes.CDLL(None).fflush(None)  # the buffers of C's stdout
            os.dup2(stream.fileno(), descriptor)
            buffer.seek(0)
            stream.writelines(line for line in buffer if not line.startswith(b"pybullet build"))


with _without_banner(1), _without_banner(2):  # releases of PyBullet differ in the stream
    import pybullet


class Client:
    """A physics server with PyBullet's functions as attributes.

    The clients of a process are independent. A client is released by :meth:`close`, or when it is garbage
    collected.

    :param gui: open PyBullet's window instead of computing headless
    :raises RuntimeError: ``gui`` without a display (PyBullet would end the process), or PyBullet has no
        server left
    """

    def __init__(self, gui: bool = False) -> None:
        if gui and not has_display():
            raise RuntimeError(
                'render_mode="human" opens a window, but no display was found '
                "(DISPLAY and WAYLAND_DISPLAY are not set). "
                'Use render_mode="rgb_array" on a machine without a display.'
            )
        self.id: int = pybullet.connect(pybullet.GUI if gui else pybullet.DIRECT)
        if self.id < 0:
            raise RuntimeError("PyBullet has no physics server left. Close environments that are not used.")
        self._release = weakref.finalize(self, _disconnect, self.id)

    def __getattr__(self, name: str) -> Any:
        """Return a constant of PyBullet, or a function bound to this server.

        :raises ClosedEnvironmentError: the client is closed (PyBullet gives its number to the next client)
        """
        self.check_open()
        value = getattr(pybullet, name)
        bound = partial(value, physicsClientId=self.id) if callable(value) else value
        setattr(self, name, bound)
        return bound

    def check_open(self) -> None:
        """Raise ClosedEnvironmentError if the server is released."""
        if not self._release.alive:
            raise ClosedEnvironmentError("the environment is closed. Make a new one with gymnasium.make().")

    def close(self) -> None:
        """Release the server. A second call does nothing."""
        self._release()
        self.__dict__ = {"id": self.id, "_release": self._release}  # drops the bound functions


def _disconnect(client_id: int) -> None:
    if pybullet.isConnected(client_id):
        pybullet.disconnect(client_id)


def has_display() -> bool:
    """Return True if a window can be opened."""
    needs_server = sys.platform.startswith("linux")
    return not needs_server or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


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
