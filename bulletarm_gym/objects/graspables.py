"""The 86 objects of Object Grasping, made by formula.

The paper uses 86 objects of GraspNet-1Billion, whose meshes have other licences. These have similar sizes
(sorted sides about 4 x 6 x 10 cm) and a similar diversity: household objects, tools, round and angular
solids. In every resting pose each has a part that the narrowest gripper, 75 mm, can grasp from above. Sizes
follow from a fixed seed, so that a name identifies a shape.
"""

from collections.abc import Callable, Sequence
from functools import cache

import numpy as np

from bulletarm_gym.objects.solids import block, cylinder, laid_flat, lathe, superquadric, vessel
from bulletarm_gym.simulation.shapes import BodySpec, Colour, Piece

SEED = 86
"""Seed of the sizes and colours."""
MASS = 0.15
"""Mass (kg) of each object."""
FRICTION = 0.6
"""Friction coefficient of each object."""
ANGULAR_DAMPING = 4.0
"""Damping that stops rolling objects; rolling friction would triple the cost of a contact."""

Shape = Callable[..., list[Piece]]
Ranges = tuple[tuple[float, float], ...]

FAMILIES: list[tuple[str, int, Shape, Ranges, tuple[int, ...]]] = []
"""Name, number of objects, shape, ranges of its lengths (m) and numbers of sides of each family.

There are 86 objects in total (paper, Object Grasping).
"""


def _family(
    count: int, *ranges: tuple[float, float], sides: tuple[int, ...] = ()
) -> Callable[[Shape], Shape]:
    """Register a shape as a family of objects."""

    def register(shape: Shape) -> Shape:
        FAMILIES.append((shape.__name__.lstrip("_"), count, shape, ranges, sides))
        return shape

    return register


@_family(8, (0.022, 0.045), (0.035, 0.06), (0.055, 0.14))
def _box(short: float, mid: float, long: float) -> list[Piece]:
    return [block((mid, long, short))]


@_family(6, (0.018, 0.03), (0.04, 0.11))
def _can(radius: float, height: float) -> list[Piece]:
    return [lathe([(0.9 * radius, 0.0), (radius, 0.004), (radius, height - 0.004), (0.9 * radius, height)])]


@_family(5, (0.022, 0.031), (0.05, 0.12), sides=(4, 6, 8))
def _prism(radius: float, height: float, sides: int) -> list[Piece]:
    return [cylinder(radius, height, sides)]


@_family(7, (0.018, 0.03), (0.02, 0.055), (0.018, 0.03), (0.35, 1.0), (0.35, 1.0))
def _superquadric(a: float, b: float, c: float, vertical: float, horizontal: float) -> list[Piece]:
    return [superquadric((a, b, c), (vertical, horizontal))]


@_family(3, (0.018, 0.031))
def _ball(radius: float) -> list[Piece]:
    return [superquadric((radius, radius, radius), (1.0, 1.0))]


@_family(9, (0.019, 0.029), (0.05, 0.09), (0.012, 0.028), (0.008, 0.014), (0.018, 0.032))
def _bottle(radius: float, body: float, shoulder: float, neck: float, length: float) -> list[Piece]:
    top = body + shoulder
    return [
        lathe([(0.92 * radius, 0.0), (radius, 0.005), (radius, body), (neck, top)]),
        lathe([(neck, top - 0.002), (neck, top + length)]),
    ]


@_family(
    5,
    (0.018, 0.026),
    (0.009, 0.014),
    (0.022, 0.031),
    (0.02, 0.028),
    (0.015, 0.025),
    (0.045, 0.065),
    (0.075, 0.105),
)
def _vase(
    foot: float, waist: float, belly: float, lip: float, low: float, mid: float, high: float
) -> list[Piece]:
    return [
        lathe([(foot, 0.0), (waist, low)]),
        lathe([(waist, low), (belly, mid), (waist, 0.75 * high)]),
        lathe([(waist, 0.75 * high), (lip, high)]),
    ]


@_family(4, (0.021, 0.026), (0.026, 0.031), (0.06, 0.09))
def _cup(low: float, high: float, height: float, wall: float = 0.005) -> list[Piece]:
    return vessel((low - wall, low, 0.0), (high - wall, high, height), wall)


@_family(3, (0.024, 0.03), (0.055, 0.075), (0.018, 0.026))
def _mug(radius: float, height: float, reach: float) -> list[Piece]:
    wall = 0.005
    cup = vessel((radius - wall, radius, 0.0), (radius - wall, radius, height), wall, sectors=6)
    grip = block((0.01, 0.014, 0.6 * height), (radius + reach, 0.0, height / 2.0))
    arm = block((reach, 0.014, 0.01), (radius + reach / 2.0 - 0.003, 0.0, 0.75 * height))
    return [*cup, grip, arm]


@_family(4, (0.022, 0.026), (0.04, 0.048), (0.035, 0.048))
def _bowl(low: float, high: float, height: float) -> list[Piece]:
    return _cup(low, high, height, wall=0.006)


@_family(4, (0.022, 0.035), (0.02, 0.032), (0.08, 0.12), (0.05, 0.08))
def _angle(thick: float, width: float, long: float, short: float) -> list[Piece]:
    return [
        block((width, long, thick)),
        block((short - width, width, thick), (short / 2.0, (width - long) / 2.0, 0.0)),
    ]


@_family(4, (0.022, 0.035), (0.018, 0.03), (0.05, 0.09), (0.06, 0.1))
def _tee(thick: float, width: float, stem: float, bar: float) -> list[Piece]:
    return [block((bar, width, thick)), block((width, stem, thick), (0.0, (width + stem) / 2.0, 0.0))]


@_family(3, (0.022, 0.032), (0.016, 0.024), (0.075, 0.1), (0.03, 0.05))
def _channel(thick: float, width: float, base: float, arm: float) -> list[Piece]:
    offset = (base - width) / 2.0
    arms = [block((width, arm, thick), (side * offset, (arm + width) / 2.0, 0.0)) for side in (-1.0, 1.0)]
    return [block((base, width, thick)), *arms]


@_family(2, (0.02, 0.03), (0.018, 0.026), (0.06, 0.09))
def _cross(thick: float, width: float, span: float) -> list[Piece]:
    arm = (span - width) / 2.0
    offset = (width + arm) / 2.0
    arms = [block((width, arm, thick), (0.0, side * offset, 0.0)) for side in (-1.0, 1.0)]
    return [block((span, width, thick)), *arms]


@_family(4, (0.1, 0.13), (0.009, 0.012), (0.055, 0.08), (0.022, 0.03))
def _hammer(length: float, grip: float, head: float, width: float) -> list[Piece]:
    handle = lathe([(grip, 0.0), (1.15 * grip, 0.02), (0.9 * grip, length)], 8)
    return [handle, block((head, width, width), (0.0, 0.0, length + width / 2.0 - 0.002))]


@_family(3, (0.012, 0.017), (0.05, 0.07), (0.05, 0.075))
def _screwdriver(grip: float, handle: float, shaft: float) -> list[Piece]:
    return [
        lathe([(0.8 * grip, 0.0), (grip, 0.008), (grip, handle - 0.01), (0.6 * grip, handle)], 8),
        lathe([(0.007, handle - 0.002), (0.007, handle + shaft)], 6),
    ]


@_family(3, (0.08, 0.11), (0.013, 0.017), (0.018, 0.024), (0.014, 0.018))
def _spoon(length: float, width: float, bowl: float, thick: float) -> list[Piece]:
    scoop = superquadric((bowl, 1.4 * bowl, 0.6 * thick), (0.6, 1.0), levels=4)
    return [block((width, length, thick), (0.0, length / 2.0 + bowl, 0.0)), scoop]


@_family(3, (0.019, 0.027), (0.018, 0.028), (0.009, 0.013), (0.04, 0.06))
def _dumbbell(weight: float, width: float, grip: float, length: float) -> list[Piece]:
    ends = [(0.0, width), (width + length, 2.0 * width + length)]
    discs = [[(0.85 * weight, low), (weight, low + 0.005), (weight, high)] for low, high in ends]
    return [*map(lathe, discs), lathe([(grip, width - 0.001), (grip, width + length + 0.001)], 8)]


@_family(3, (0.024, 0.031), (0.018, 0.026), (0.01, 0.015), (0.03, 0.05))
def _mushroom(cap: float, height: float, stem: float, length: float) -> list[Piece]:
    return [
        lathe([(1.1 * stem, 0.0), (stem, length)], 8),
        lathe([(0.95 * cap, length - 0.001), (cap, length + 0.4 * height), (0.5 * cap, length + height)]),
    ]


@_family(3, (0.024, 0.031), (0.008, 0.016), (0.05, 0.09))
def _cone(base: float, tip: float, height: float) -> list[Piece]:
    return [lathe([(0.97 * base, 0.0), (base, 0.004), (tip, height)])]


@cache
def graspables() -> tuple[BodySpec, ...]:
    """Return the 86 objects, each in its resting frame."""
    specs: list[BodySpec] = []
    for family, (name, count, shape, ranges, sides) in enumerate(FAMILIES):
        for number in range(count):
            rng = np.random.default_rng((SEED, family, number))
            lengths = [round(float(rng.uniform(low, high)), 4) for low, high in ranges]
            pieces = shape(*lengths, *([int(rng.choice(sides))] if sides else []))
            red, green, blue = rng.uniform(0.35, 0.95, 3).round(2).tolist()
            specs.append(graspable(f"{name}_{number}", laid_flat(pieces), (red, green, blue, 1.0)))
    return tuple(specs)


def graspable(name: str, pieces: Sequence[Piece], colour: Colour) -> BodySpec:
    """Return a body with the mass and friction of all objects to grasp."""
    return BodySpec(name, tuple(pieces), MASS, FRICTION, angular_damping=ANGULAR_DAMPING, colour=colour)
