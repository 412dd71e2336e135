"""Surfaces: the ground of a workspace."""

from bulletarm_gym.surfaces.bump import BumpSurface
from bulletarm_gym.surfaces.ramp import RampSurface
from bulletarm_gym.surfaces.surface import FlatSurface, Surface, TraySurface

SURFACES: dict[str, type[Surface]] = {
    "flat": FlatSurface,
    "tray": TraySurface,
    "ramp": RampSurface,
    "bump": BumpSurface,
}
"""Built-in surfaces by name."""

__all__ = ["SURFACES", "BumpSurface", "FlatSurface", "RampSurface", "Surface", "TraySurface"]
