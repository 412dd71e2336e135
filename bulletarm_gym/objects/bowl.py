"""The bowl: hollow, made of sectors."""

from bulletarm_gym.objects.solids import Wall, ring, vessel
from bulletarm_gym.simulation.shapes import YELLOW, BodySpec

DIAMETER = 0.16
"""At scale 1 (m; paper, Block in Bowl)."""
HEIGHT = 0.07
"""At scale 1 (m; paper, Block in Bowl)."""
FOOT_RADIUS = 0.048
"""Where (m) the outside meets the ground: inside, a cube of 5 cm still lies flat."""
BELLY_RADIUS = 0.072
BELLY_HEIGHT = 0.03
"""Where (m) the wall bends, steeper above."""
THICKNESS = 0.006
BASE = 0.006
SECTORS = 12
"""A multiple of 4: the bounding box is then as wide as the circle."""
MASS = 0.1


def bowl(name: str, scale: float) -> BodySpec:
    """Return a bowl open to the top, its frame on its axis in the middle of its height."""
    profile = ((FOOT_RADIUS, 0.0), (BELLY_RADIUS, BELLY_HEIGHT), (DIAMETER / 2.0, HEIGHT))
    foot, belly, rim = (
        Wall(inner=(radius - THICKNESS) * scale, outer=radius * scale, height=(height - HEIGHT / 2.0) * scale)
        for radius, height in profile
    )
    pieces = [*vessel(foot, belly, BASE * scale, SECTORS), *ring(belly, rim, SECTORS)]
    return BodySpec(name, tuple(pieces), MASS, colour=YELLOW)
