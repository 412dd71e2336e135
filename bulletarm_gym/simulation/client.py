"""Connection to a physics server of PyBullet."""

import ctypes
import os
import sys
import tempfile
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

from gymnasium.error import ClosedEnvironmentError

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
