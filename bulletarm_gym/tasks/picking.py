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
    """The base of tasks that are solved once a cube is held in the air.

    Success: the gripper holds the cube and is higher than ``lift_height``, 15 cm.
    """

    controls = (CLOSE_LOOP,)

    @property
    def height(self) -> float:
        """Up to where the gripper must lift."""
        return self.config.lift_height

    def evaluate(self, scene: Scene) -> dict[str, bool]:
        """Look whether the cube is held, and how high."""
        held = is_held(scene, scene["cube"])
        return {"success": held and scene.robot.pose.z > self.config.lift_height, "is_held": held}

    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        """Grasp the cube, then lift."""
        hand = scene.robot.pose
        if not is_held(scene, scene["cube"]):
            yield from self._grasp(scene)
        height = max(hand.z, self.config.lift_height) + scene.max_translation
        yield Waypoint(Pose.planar(hand.x, hand.y, height, hand.yaw), CLOSED)

    @abstractmethod
    def _grasp(self, scene: Scene) -> Iterator[Waypoint]:
        """Get the cube between the fingers."""


class BlockPicking(Lift):
    """Grasp a cube and lift it.

    Description: one 5 cm cube stands on the floor.
    Randomisation: the cube's position in the workspace, its yaw in +-45 degrees.
    Success: the gripper holds the cube and is higher than ``lift_height``, 15 cm.
    Expert: down to the cube's centre with the fingers along its sides, close, straight up.
    """

    defaults = TaskDefaults(num_objects=1, lifts=True)

    def bodies(self, config: EnvConfig) -> list[ObjectSlot]:
        """Return the cube."""
        return [scaled(config, "cube", cube)]

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        """Put the cube anywhere."""
        place_cube(scene, rng, YAW_SPREAD)

    def _grasp(self, scene: Scene) -> Iterator[Waypoint]:
        item = scene["cube"]
        symmetry = side_symmetry(item.pose)
        yaw = item.pose.yaw if symmetry < math.pi else side_yaw(item.pose)
        target = Pose.planar(*item.pose.position, yaw)
        yield from grasp(scene, target, scene.world.top(item.body), symmetry)
