r"""A table with a step: two levels, and an edge that is sampled at every reset.

cd examples
python -m bulletarm_gym.check BulletArm/CloseLoopBlockPicking-v0 -n 50 \
    --gym-packages step_surface --env-kwargs surface:step
"""

import math

import numpy as np
from numpy.typing import ArrayLike

import bulletarm_gym
from bulletarm_gym.geometry import FloatArray, Footprint, PlacementError, Pose
from bulletarm_gym.simulation import BodySpec, Box, Piece, World
from bulletarm_gym.surfaces import FlatSurface

STEP = 0.03
"""Height (m) of the step."""
SHIFT = 0.04
"""Largest distance (m) of the edge from the middle of the workspace."""
CLEARANCE = 0.03
"""Space (m) for a finger below the edge."""


class StepSurface(FlatSurface):
    """A table whose far half is 3 cm higher."""

    def load(self, world: World) -> None:
        """Load the ground plane and the plate."""
        super().load(world)
        self._world = world
        size = 1.5 * (self.workspace[0][1] - self.workspace[0][0])
        plate = Piece(Box((size, size, STEP)), Pose((size / 2, 0.0, STEP / 2)))
        self._plate = world.add(BodySpec("step", (plate,), mass=0.0, colour=(0.80, 0.72, 0.55, 1.0)))
        self.bodies.append(self._plate)

    def arrange(self, rng: np.random.Generator) -> None:
        """Sample the edge."""
        x, y = self.centre
        yaw = rng.uniform(-math.pi / 6, math.pi / 6)
        self._world.place(self._plate, Pose.planar(x + rng.uniform(-SHIFT, SHIFT), y, 0.0, yaw))

    def _beyond(self, points: ArrayLike) -> FloatArray:
        """Return the distances (m) of points beyond the edge, negative before it."""
        edge = self._world.poses[self._plate.index]
        beyond: FloatArray = (np.asarray(points) - edge.position[:2]) @ (
            math.cos(edge.yaw),
            math.sin(edge.yaw),
        )
        return beyond

    def heights(self, points: ArrayLike) -> FloatArray:
        """Return the height of each point."""
        return np.where(self._beyond(points) >= 0.0, STEP, 0.0)

    def fits(self, footprint: Footprint, margin: float = 0.0) -> bool:
        """Return True if a footprint is inside the workspace and not over or below the edge."""
        beyond = self._beyond(footprint.points)
        is_apart = bool(beyond.min() >= 0.0 or beyond.max() <= -CLEARANCE)
        return is_apart and super().fits(footprint, margin)

    def fits_site(self, footprint: Footprint) -> bool:
        """Return True if a footprint is on the lower level."""
        is_low = bool(self._beyond(footprint.points).max() <= -CLEARANCE)
        return is_low and super().fits(footprint)

    def sample_position(self, rng: np.random.Generator, margin: float) -> tuple[float, float]:
        """Sample a point at least ``margin`` (m) from the border and from the edge."""
        for _ in range(200):
            point = super().sample_position(rng, margin)
            if not -margin - CLEARANCE < self._beyond([point])[0] < margin:
                return point
        raise PlacementError(f"the step leaves no space for a margin of {margin:.3f} m")


bulletarm_gym.register_surface("step", StepSurface)
bulletarm_gym.register_task("BlockStacking", "bulletarm_gym.tasks.stacking:BlockStacking", surface="step")
