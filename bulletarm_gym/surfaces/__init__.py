"""Surfaces: the ground of a workspace."""

from bulletarm_gym.extensions import SURFACE_PATHS, find_class
from bulletarm_gym.surfaces.bump import BumpSurface
from bulletarm_gym.surfaces.flat import FlatSurface, TraySurface
from bulletarm_gym.surfaces.ramp import RampSurface
from bulletarm_gym.surfaces.surface import Point, Surface

SURFACES: dict[str, type[Surface]] = {
    "flat": FlatSurface,
    "tray": TraySurface,
    "ramp": RampSurface,
    "bump": BumpSurface,
}
"""Built-in surfaces by name."""

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
    """Return the class of a built-in or registered surface, or that of an import path ``"module:Class"``.

    :raises ValueError: the surface is unknown
    """
    return find_class("surface", name, SURFACES, SURFACE_PATHS, Surface)


def make_surface(name: str, workspace: list[list[float]], site: Point) -> Surface:
    """Return a surface, not loaded yet.

    :param site: width and length (m) of the base of the task's structure
    :raises ValueError: the surface is unknown
    """
    return find_surface(name)(workspace, site)
