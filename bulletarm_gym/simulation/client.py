"""A connection to a physics server of one's own."""

import os
import sys
import weakref
from collections.abc import Callable
from functools import partial
from typing import Any

from gymnasium.error import ClosedEnvironmentError

from bulletarm_gym.simulation.engine import pybullet


class Client:
    """One physics server; PyBullet's functions as attributes, bound to it.

    Any number of clients live in a process without touching each other. A client is released by
    :meth:`close`, or when it is garbage collected.

    :param gui: open PyBullet's window instead of computing headless
    :raises RuntimeError: ``gui`` without a display (PyBullet itself would end the whole process)
    """

    def __init__(self, gui: bool = False) -> None:
        if gui and not has_display():
            raise RuntimeError(
                'render_mode="human" opens a window, but no display was found '
                "(DISPLAY and WAYLAND_DISPLAY are not set); "
                'use render_mode="rgb_array" on a machine without one'
            )
        self.id: int = pybullet.connect(pybullet.GUI if gui else pybullet.DIRECT)
        if self.id < 0:
            raise RuntimeError(
                "PyBullet refused another physics server; close environments that are no longer used"
            )
        self._release = weakref.finalize(self, _disconnect, self.id)

    def __getattr__(self, name: str) -> Any:
        """Bind a function of PyBullet to this server, once; constants pass as they are.

        :raises ClosedEnvironmentError: the client is closed (PyBullet gives its number to the next one)
        """
        self.check_open()
        value = getattr(pybullet, name)
        bound = partial(value, physicsClientId=self.id) if callable(value) else value
        setattr(self, name, bound)
        return bound

    def check_open(self) -> None:
        """Check that the server has not been released.

        :raises ClosedEnvironmentError: it has
        """
        if not self._release.alive:
            raise ClosedEnvironmentError("the environment is closed. Make a new one with gymnasium.make().")

    def replace(self, name: str, wrap: Callable[["partial[Any]"], "partial[Any]"]) -> None:
        """Put a function of this server's into another one, through which it is called from now on."""
        setattr(self, name, wrap(getattr(self, name)))

    def close(self) -> None:
        """Release the server; a second call does nothing."""
        self._release()
        kept = {name: value for name, value in vars(self).items() if not isinstance(value, partial)}
        self.__dict__ = kept


def _disconnect(client_id: int) -> None:
    if pybullet.isConnected(client_id):
        pybullet.disconnect(client_id)


def has_display() -> bool:
    """Whether a window can be opened."""
    needs_server = sys.platform.startswith("linux")
    return not needs_server or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
