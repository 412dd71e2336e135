"""Where things stand."""

from bulletarm_gym.extensions import SURFACE_PATHS, find_class
from bulletarm_gym.surfaces.bump import BumpSurface
from bulletarm_gym.surfaces.flat import FlatSurface
from bulletarm_gym.surfaces.ramp import RampSurface
from bulletarm_gym.surfaces.surface import Point, Surface
from bulletarm_gym.surfaces.tray import TraySurface

SURFACES: dict[str, type[Surface]] = {
    "flat": FlatSurface,
    "tray": TraySurface,
    "ramp": RampSurface,
    "bump": BumpSurface,
}

__all__ = [
    "SURFACES",
    "BumpSurface",
    "FlatSurface",
    "Point",
    "RampSurface",
    "Surface",
    "TraySurface",
    "find_surface",
    "make_surface",
]


def find_surface(name: str) -> type[Surface]:
    """Return the class of a surface by its name, ours or registered, or by its path ``"module:Class"``.

    :raises ValueError: there is no such surface
    """
    return find_class("surface", name, SURFACES, SURFACE_PATHS, Surface)


def make_surface(name: str, workspace: list[list[float]], site: Point) -> Surface:
    """Return a surface, not loaded yet.

    :param site: width and length (m) of the base of what the task builds
    :raises ValueError: there is no surface of that name
    """
    return find_surface(name)(workspace, site)
