"""Where things stand."""

from bulletarm_gym.surfaces.flat import FlatSurface
from bulletarm_gym.surfaces.surface import Surface

SURFACES: dict[str, type[Surface]] = {"flat": FlatSurface}

__all__ = ["SURFACES", "FlatSurface", "Surface"]
