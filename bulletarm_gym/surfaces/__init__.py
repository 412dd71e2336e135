"""Where things stand."""

from bulletarm_gym.surfaces.flat import FlatSurface
from bulletarm_gym.surfaces.surface import Surface
from bulletarm_gym.surfaces.tray import TraySurface

SURFACES: dict[str, type[Surface]] = {"flat": FlatSurface, "tray": TraySurface}

__all__ = ["SURFACES", "FlatSurface", "Surface", "TraySurface"]
