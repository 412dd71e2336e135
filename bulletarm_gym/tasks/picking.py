"""Picking up a block."""

import math
from abc import abstractmethod
from collections.abc import Iterator

import numpy as np

from bulletarm_gym.config import CLOSE_LOOP, EnvConfig, TaskDefaults
from bulletarm_gym.experts.approach import grasp, side_symmetry, side_yaw
from bulletarm_gym.experts.waypoints import CLOSED, Waypoint
from bulletarm_gym.geometry import Pose
from bulletarm_gym.objects import cube
from bulletarm_gym.scene import ObjectSlot, Scene, scaled
from bulletarm_gym.scene.predicates import is_held
from bulletarm_gym.tasks.reaching import place_cube
from bulletarm_gym.tasks.task import Task

YAW_SPREAD = math.pi / 4.0


class Lift(Task):
    """Base class of tasks in which a cube is lifted.

    Success: the gripper holds the cube and is higher than ``lift_height``, 15 cm.
    """

    controls = (CLOSE_LOOP,)

    @property
    def height(self) -> float:
        """Height (m) to which the gripper must lift."""
        return self.config.lift_height

    def evaluate(self, scene: Scene) -> dict[str, bool]:
        """Return whether the cube is held above ``lift_height``."""
        held = is_held(scene, scene["cube"])
        return {"success": held and scene.robot.pose.z > self.config.lift_height, "is_held": held}

    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        """Grasp the cube, then lift."""
        tool = scene.robot.pose
        if not is_held(scene, scene["cube"]):
            yield from self._grasp(scene)
        height = max(tool.z, self.config.lift_height) + scene.max_translation
        yield Waypoint(Pose.planar(tool.x, tool.y, height, tool.yaw), CLOSED)

    @abstractmethod
    def _grasp(self, scene: Scene) -> Iterator[Waypoint]:
        """Yield the waypoints of the grasp."""


class BlockPicking(Lift):
    """Grasp a cube and lift it.

    Description: one 5 cm cube stands on the surface.
    Randomisation: the cube's position in the workspace, its yaw in +-45 degrees.
    Success: the gripper holds the cube and is higher than ``lift_height``, 15 cm.
    Expert: descend to the cube's centre with the fingers along its sides, close, lift.
    """

    defaults = TaskDefaults(num_objects=1, lifts=True)

    def bodies(self, config: EnvConfig) -> list[ObjectSlot]:
        """Return the cube."""
        return [scaled(config, "cube", cube)]

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        """Place the cube."""
        place_cube(scene, rng, YAW_SPREAD)

    def _grasp(self, scene: Scene) -> Iterator[Waypoint]:
        block = scene["cube"]
        symmetry = side_symmetry(block.pose)
        yaw = block.pose.yaw if symmetry < math.pi else side_yaw(block.pose)
        target = Pose.planar(*block.pose.position, yaw)
        yield from grasp(scene, target, scene.world.top(block.body), symmetry)
