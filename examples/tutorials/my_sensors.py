"""Tutorial 5: a sensor of your own, in a module that processes can import."""

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

import bulletarm_gym
from bulletarm_gym.observations import Sensor, View
from bulletarm_gym.scene import Scene

SKIN = 1e-3  # beams begin this far (m) below the fingertips


class Rangefinder(Sensor):
    """Distance (m) from each fingertip to what is below it, along the fingers."""

    def __init__(self, scene: Scene, reach: float = 0.3) -> None:
        super().__init__(scene)
        if not 0.0 < reach <= 2.0:
            raise ValueError(f"reach must be at most 2 m, got {reach!r}")
        self.reach = reach

    @property
    def space(self) -> spaces.Box:
        return spaces.Box(0.0, self.reach, (2,), np.float32)

    def read(self, view: View) -> NDArray[np.float32]:
        robot, world = self.scene.robot, self.scene.world
        side = (robot.opening + robot.model.gripper.finger[0]) / 2.0
        starts, ends = (
            [robot.pose.transform((x, 0.0, z)) for x in (side, -side)] for z in (-SKIN, -self.reach)
        )
        shares = world.cast_rays(starts, ends)
        return np.array([SKIN + share * (self.reach - SKIN) for share in shares], np.float32)


bulletarm_gym.register_sensor("rangefinder", Rangefinder)
