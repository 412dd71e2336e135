"""The 86 objects of Object Grasping, made by formula.

The paper uses 86 objects of GraspNet-1Billion, whose meshes have other licences. These have similar sizes
(sorted sides about 4 x 6 x 10 cm) and a similar diversity: household objects, tools, round and angular
solids. In every resting pose each has a part that the narrowest gripper, 75 mm, can grasp from above. Sizes
follow from a fixed seed, so that a name identifies a shape.
"""

from collections.abc import Callable
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

Shaper = Callable[[np.random.Generator], list[Piece]]


def _between(rng: np.random.Generator, *ranges: tuple[float, float]) -> list[float]:
    """Sample one length (m) from each range, rounded to 0.1 mm."""
    return [round(float(rng.uniform(low, high)), 4) for low, high in ranges]


def _box(rng: np.random.Generator) -> list[Piece]:
    short, mid, long = _between(rng, (0.022, 0.045), (0.035, 0.06), (0.055, 0.14))
    return [block((mid, long, short))]


def _can(rng: np.random.Generator) -> list[Piece]:
    radius, height = _between(rng, (0.018, 0.03), (0.04, 0.11))
    return [lathe([(0.9 * radius, 0.0), (radius, 0.004), (radius, height - 0.004), (0.9 * radius, height)])]


def _prism(rng: np.random.Generator) -> list[Piece]:
    radius, height = _between(rng, (0.022, 0.031), (0.05, 0.12))
    return [cylinder(radius, height, int(rng.choice([4, 6, 8])))]


def _superquadric(rng: np.random.Generator) -> list[Piece]:
    a, b, c = _between(rng, (0.018, 0.03), (0.02, 0.055), (0.018, 0.03))
    vertical, horizontal = _between(rng, (0.35, 1.0), (0.35, 1.0))
    return [superquadric((a, b, c), (vertical, horizontal))]


def _ball(rng: np.random.Generator) -> list[Piece]:
    (radius,) = _between(rng, (0.018, 0.031))
    return [superquadric((radius, radius, radius), (1.0, 1.0))]


def _bottle(rng: np.random.Generator) -> list[Piece]:
    radius, body, shoulder, neck, length = _between(
        rng, (0.019, 0.029), (0.05, 0.09), (0.012, 0.028), (0.008, 0.014), (0.018, 0.032)
    )
    top = body + shoulder
    return [
        lathe([(0.92 * radius, 0.0), (radius, 0.005), (radius, body), (neck, top)]),
        lathe([(neck, top - 0.002), (neck, top + length)]),
    ]


def _vase(rng: np.random.Generator) -> list[Piece]:
    foot, waist, belly, lip = _between(rng, (0.018, 0.026), (0.009, 0.014), (0.022, 0.031), (0.02, 0.028))
    low, mid, high = _between(rng, (0.015, 0.025), (0.045, 0.065), (0.075, 0.105))
    return [
        lathe([(foot, 0.0), (waist, low)]),
        lathe([(waist, low), (belly, mid), (waist, 0.75 * high)]),
        lathe([(waist, 0.75 * high), (lip, high)]),
    ]


def _cup(rng: np.random.Generator) -> list[Piece]:
    low, high, height = _between(rng, (0.021, 0.026), (0.026, 0.031), (0.06, 0.09))
    wall = 0.005
    return vessel((low - wall, low, 0.0), (high - wall, high, height), wall)


def _mug(rng: np.random.Generator) -> list[Piece]:
    radius, height, reach = _between(rng, (0.024, 0.03), (0.055, 0.075), (0.018, 0.026))
    wall = 0.005
    cup = vessel((radius - wall, radius, 0.0), (radius - wall, radius, height), wall, sectors=6)
    grip = block((0.01, 0.014, 0.6 * height), (radius + reach, 0.0, height / 2.0))
    arm = block((reach, 0.014, 0.01), (radius + reach / 2.0 - 0.003, 0.0, 0.75 * height))
    return [*cup, grip, arm]


def _bowl(rng: np.random.Generator) -> list[Piece]:
    low, high, height = _between(rng, (0.022, 0.026), (0.04, 0.048), (0.035, 0.048))
    wall = 0.006
    return vessel((low - wall, low, 0.0), (high - wall, high, height), wall)


def _angle(rng: np.random.Generator) -> list[Piece]:
    thick, width, long, short = _between(rng, (0.022, 0.035), (0.02, 0.032), (0.08, 0.12), (0.05, 0.08))
    return [
        block((width, long, thick)),
        block((short - width, width, thick), (short / 2.0, (width - long) / 2.0, 0.0)),
    ]


def _tee(rng: np.random.Generator) -> list[Piece]:
    thick, width, stem, bar = _between(rng, (0.022, 0.035), (0.018, 0.03), (0.05, 0.09), (0.06, 0.1))
    return [block((bar, width, thick)), block((width, stem, thick), (0.0, (width + stem) / 2.0, 0.0))]


def _channel(rng: np.random.Generator) -> list[Piece]:
    thick, width, base, arm = _between(rng, (0.022, 0.032), (0.016, 0.024), (0.075, 0.1), (0.03, 0.05))
    offset = (base - width) / 2.0
    arms = [block((width, arm, thick), (side * offset, (arm + width) / 2.0, 0.0)) for side in (-1.0, 1.0)]
    return [block((base, width, thick)), *arms]


def _cross(rng: np.random.Generator) -> list[Piece]:
    thick, width, span = _between(rng, (0.02, 0.03), (0.018, 0.026), (0.06, 0.09))
    arm = (span - width) / 2.0
    offset = (width + arm) / 2.0
    arms = [block((width, arm, thick), (0.0, side * offset, 0.0)) for side in (-1.0, 1.0)]
    return [block((span, width, thick)), *arms]


def _hammer(rng: np.random.Generator) -> list[Piece]:
    length, grip, head, width = _between(rng, (0.1, 0.13), (0.009, 0.012), (0.055, 0.08), (0.022, 0.03))
    handle = lathe([(grip, 0.0), (1.15 * grip, 0.02), (0.9 * grip, length)], 8)
    return [handle, block((head, width, width), (0.0, 0.0, length + width / 2.0 - 0.002))]


def _screwdriver(rng: np.random.Generator) -> list[Piece]:
    grip, handle, shaft = _between(rng, (0.012, 0.017), (0.05, 0.07), (0.05, 0.075))
    return [
        lathe([(0.8 * grip, 0.0), (grip, 0.008), (grip, handle - 0.01), (0.6 * grip, handle)], 8),
        lathe([(0.007, handle - 0.002), (0.007, handle + shaft)], 6),
    ]


def _spoon(rng: np.random.Generator) -> list[Piece]:
    length, width, bowl, thick = _between(rng, (0.08, 0.11), (0.013, 0.017), (0.018, 0.024), (0.014, 0.018))
    scoop = superquadric((bowl, 1.4 * bowl, 0.6 * thick), (0.6, 1.0), levels=4)
    return [block((width, length, thick), (0.0, length / 2.0 + bowl, 0.0)), scoop]


def _dumbbell(rng: np.random.Generator) -> list[Piece]:
    weight, width, grip, length = _between(rng, (0.019, 0.027), (0.018, 0.028), (0.009, 0.013), (0.04, 0.06))
    ends = [(0.0, width), (width + length, 2.0 * width + length)]
    discs = [[(0.85 * weight, low), (weight, low + 0.005), (weight, high)] for low, high in ends]
    return [*map(lathe, discs), lathe([(grip, width - 0.001), (grip, width + length + 0.001)], 8)]


def _mushroom(rng: np.random.Generator) -> list[Piece]:
    cap, height, stem, length = _between(rng, (0.024, 0.031), (0.018, 0.026), (0.01, 0.015), (0.03, 0.05))
    return [
        lathe([(1.1 * stem, 0.0), (stem, length)], 8),
        lathe([(0.95 * cap, length - 0.001), (cap, length + 0.4 * height), (0.5 * cap, length + height)]),
    ]


def _cone(rng: np.random.Generator) -> list[Piece]:
    base, tip, height = _between(rng, (0.024, 0.031), (0.008, 0.016), (0.05, 0.09))
    return [lathe([(0.97 * base, 0.0), (base, 0.004), (tip, height)])]


FAMILIES: tuple[tuple[str, int, Shaper], ...] = (
    ("box", 8, _box),
    ("can", 6, _can),
    ("prism", 5, _prism),
    ("superquadric", 7, _superquadric),
    ("ball", 3, _ball),
    ("bottle", 9, _bottle),
    ("vase", 5, _vase),
    ("cup", 4, _cup),
    ("mug", 3, _mug),
    ("bowl", 4, _bowl),
    ("angle", 4, _angle),
    ("tee", 4, _tee),
    ("channel", 3, _channel),
    ("cross", 2, _cross),
    ("hammer", 4, _hammer),
    ("screwdriver", 3, _screwdriver),
    ("spoon", 3, _spoon),
    ("dumbbell", 3, _dumbbell),
    ("mushroom", 3, _mushroom),
    ("cone", 3, _cone),
)
"""Name, number of objects and shape of each family; 86 objects in total (paper, Object Grasping)."""


@cache
def graspables() -> tuple[BodySpec, ...]:
    """Return the 86 objects, each in its resting frame."""
    specs: list[BodySpec] = []
    for family, (name, count, shape) in enumerate(FAMILIES):
        for number in range(count):
            rng = np.random.default_rng((SEED, family, number))
            specs.append(graspable(f"{name}_{number}", shape(rng), _colour(rng)))
    return tuple(specs)


def graspable(name: str, pieces: list[Piece], colour: Colour) -> BodySpec:
    """Return a body in its resting frame, with the mass and friction of all objects to grasp."""
    return BodySpec(name, laid_flat(pieces), MASS, FRICTION, angular_damping=ANGULAR_DAMPING, colour=colour)


def _colour(rng: np.random.Generator) -> Colour:
    """Sample a light colour."""
    red, green, blue = rng.uniform(0.35, 0.95, 3).round(2).tolist()
    return (red, green, blue, 1.0)
