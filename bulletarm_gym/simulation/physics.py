"""The two physics modes of the paper, and what counts as speed."""

import math
from dataclasses import dataclass

from bulletarm_gym.geometry import Vector

REST_RIM = 0.05
"""Lever (m) at which a body's turning counts as speed."""
REST_SPEED = 0.01
"""Greatest speed (m/s at its rim) of a body at rest: in one step gravity alone adds four times as much."""


@dataclass(frozen=True)
class Physics:
    """How exactly contacts are solved.

    :param solver_iterations: of Bullet's constraint solver, each step
    :param damping: linear and angular damping of free bodies
    :param pace: how many times longer than the quickest an arm's motion takes
    """

    solver_iterations: int
    damping: float
    pace: float


PHYSICS_MODES = {"fast": Physics(50, 0.0, 1.0), "slow": Physics(200, 0.04, 2.0)}
"""The paper's two physics modes."""


def surface_speed(linear: Vector, angular: Vector) -> float:
    """Return how fast (m/s) the surface of a body moves at most, by its velocity and its turning (rad/s)."""
    return math.hypot(*linear) + REST_RIM * math.hypot(*angular)
