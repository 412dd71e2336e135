"""Tutorial 3: a task of your own, in a module that processes can import."""

import math
from collections.abc import Iterator

import numpy as np

import bulletarm_gym
from bulletarm_gym.config import EnvConfig, TaskDefaults
from bulletarm_gym.experts.approach import grasp
from bulletarm_gym.geometry import Pose, planar_distance
from bulletarm_gym.objects import cube
from bulletarm_gym.scene import ObjectSlot, Scene, scaled
from bulletarm_gym.scene.predicates import is_held
from bulletarm_gym.scene.sampling import scatter, stand
from bulletarm_gym.tasks import CLOSED, Task, Waypoint


class BlockCentring(Task):
    """Carry a cube above the middle of the workspace."""

    defaults = TaskDefaults(num_objects=1)
    controls = ("close_loop",)

    def bodies(self, config: EnvConfig) -> list[ObjectSlot]:
        return [scaled(config, "cube", cube)]

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        (point,) = scatter(scene, rng, [0.06], 0.0)
        stand(scene, scene["cube"], point, rng, math.pi / 4)

    def evaluate(self, scene: Scene) -> dict[str, bool]:
        near = planar_distance(scene["cube"].pose.position, self.config.centre) < 0.02
        return {"success": near and is_held(scene, scene["cube"]), "is_near": near}

    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        obj = scene["cube"]
        if not is_held(scene, obj):
            yield from grasp(scene, obj.pose, scene.world.top(obj.body), math.pi / 2)
        yield Waypoint(Pose.planar(*self.config.centre, 0.1, scene.robot.pose.yaw), CLOSED)


bulletarm_gym.register_task("BlockCentring", BlockCentring)
