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

__all__ = [
    "SURFACES",
    "BumpSurface",
    "FlatSurface",
    "Point",
    "RampSurface",
    "Surface",
    "TraySurface",
]
