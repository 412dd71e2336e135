"""Where things stand."""

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

__all__ = ["SURFACES", "BumpSurface", "FlatSurface", "RampSurface", "Surface", "TraySurface", "make_surface"]


def make_surface(name: str, workspace: list[list[float]], site: Point) -> Surface:
    """Return a surface, not loaded yet.

    :param site: width and length (m) of the base of what the task builds
    :raises ValueError: there is no surface of that name
    """
    if name not in SURFACES:
        known = ", ".join(repr(other) for other in SURFACES)
        raise ValueError(f"surface: got {name!r}, takes one of {known}")
    return SURFACES[name](workspace, site)
