"""Surfaces: the ground of a workspace."""

from bulletarm_gym.surfaces.bump import BumpSurface as BumpSurface
from bulletarm_gym.surfaces.ramp import RampSurface as RampSurface
from bulletarm_gym.surfaces.surface import (
    FlatSurface as FlatSurface,
    Point as Point,
    Surface as Surface,
    TraySurface as TraySurface,
)

SURFACES: dict[str, type[Surface]] = {
    "flat": FlatSurface,
    "tray": TraySurface,
    "ramp": RampSurface,
    "bump": BumpSurface,
}
"""Built-in surfaces by name."""
