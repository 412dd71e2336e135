"""Simulation of bodies until they rest."""

from collections.abc import Sequence

from bulletarm_gym.simulation.physics import REST_SPEED
from bulletarm_gym.simulation.state import Body
from bulletarm_gym.simulation.world import World

CREEP_SPEED = 1e-3
"""Speed (m/s at its rim) below which changes from step to step are noise of the contact solver."""
CALM_STEPS = 24
"""Simulation steps after which bodies slower than :data:`REST_SPEED` rest, although some speed up."""


def settle(world: World, bodies: Sequence[Body], limit: int) -> None:
    """Advance until bodies rest, at most ``limit`` simulation steps, and read the world into its state.

    A body rests if it is slow in two consecutive steps and does not speed up, as one that tips over does.
    """
    speeds, calm = [world.speed(body) for body in bodies], 0
    for _ in range(limit):
        world.step()
        before, speeds = speeds, [world.speed(body) for body in bodies]
        calm = calm + 1 if all(speed < REST_SPEED for speed in speeds) else 0
        steady = all(now <= max(old, CREEP_SPEED) for old, now in zip(before, speeds, strict=True))
        if calm > 1 and (steady or calm > CALM_STEPS):
            break
    world.end()
    world.unsettled.clear()
