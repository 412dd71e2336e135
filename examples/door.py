"""A door on a hinge between two posts, and the task of pushing it open.

cd examples
python -m bulletarm_gym.check BulletArm/CloseLoopDoorOpening-v0 -n 50 --gym-packages door
"""

import math
from collections.abc import Iterator

import numpy as np

import bulletarm_gym
from bulletarm_gym.config import EnvConfig, TaskDefaults
from bulletarm_gym.geometry import Pose, planar_distance, wrap_angle
from bulletarm_gym.scene import ObjectSlot, Scene
from bulletarm_gym.scene.sampling import is_within, sample_until
from bulletarm_gym.simulation import BodySpec, Box, Hinge, Piece
from bulletarm_gym.tasks import CLOSED, Task, Waypoint

LENGTH, THICKNESS, TOP = 0.14, 0.012, 0.07
"""Dimensions (m) of the door."""
OPENED, LIMIT = math.radians(60), math.radians(100)
"""Angle that counts as open, and maximum angle (rad)."""
PUSHED = 0.11
"""Distance (m) of the pushed point from the hinge."""
LOW, HIGH = 0.035, 0.1
"""Heights (m) of the fingertips during a push and above the door."""
STEP = 0.4
"""Angle (rad) between the door and the target of a push."""


def door(name: str) -> BodySpec:
    """Return a door that rotates about the z axis of its frame. It is closed along x and opens towards +y."""
    posts = [Piece(Box((0.02, 0.02, TOP)), Pose((x, 0.0, TOP / 2))) for x in (-0.012, LENGTH + 0.014)]
    panel = Piece(Box((LENGTH, THICKNESS, TOP - 0.01)), Pose((LENGTH / 2, 0.0, TOP / 2)))
    axis, limits = (0.0, 0.0, 1.0), (0.0, LIMIT)
    hinge = Hinge("door", (panel,), mass=0.3, axis=axis, limits=limits, resistance=0.02)
    return BodySpec(name, tuple(posts), mass=0.0, colour=(0.4, 0.4, 0.45, 1.0), parts=(hinge,))


class DoorOpening(Task):
    """Push a door open by more than 60 degrees."""

    defaults = TaskDefaults(
        num_objects=1,
        no_tray="the door does not fit into the tray",
        level_ground="the door stands upright",
    )
    controls = ("close_loop",)

    def bodies(self, config: EnvConfig) -> list[ObjectSlot]:
        """Return the door."""
        return [ObjectSlot("door", (door("door"),))]

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        """Place the closed door so that the gripper reaches it at all angles."""

        def draw() -> Pose:
            yaw = rng.uniform(-math.pi, math.pi) if self.config.random_orientation else 0.0
            return scene.surface.pose(scene.surface.sample_position(rng, 0.0), yaw)

        def fits(pose: Pose) -> bool:
            path = [beside(scene, pose, angle, 0.02) for angle in (0.0, 0.5, 1.0, 1.5)]
            return all(is_within(scene, place.position, 0.005) for place in path)

        scene["door"].place(sample_until(draw, fits, attempts=2000))
        scene["door"].set_joints((0.0,))

    def evaluate(self, scene: Scene) -> dict[str, bool]:
        """Return whether the door is open."""
        return {"success": scene["door"].joints[0] > OPENED}

    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        """Move behind the door, and push."""
        obj, tool = scene["door"], scene.robot.pose
        angle = obj.joints[0]
        start = aligned(scene, beside(scene, obj.pose, angle, 0.012))
        _, ahead, _ = panel_frame(obj.pose, angle).inverse().transform(tool.position)
        apart = planar_distance(start.position, tool.position)
        is_behind = apart < 0.03 and ahead < 0.0
        if (tool.z > LOW + 0.01 and apart > 0.008) or not is_behind:
            if tool.z < HIGH - 0.005:
                yield Waypoint(Pose.planar(tool.x, tool.y, HIGH, tool.yaw), CLOSED)
            yield Waypoint(Pose.planar(start.x, start.y, HIGH, start.yaw), CLOSED)
        if tool.z > LOW + 0.01:
            yield Waypoint(start, CLOSED)
        yield Waypoint(aligned(scene, beside(scene, obj.pose, angle + STEP, 0.0)), CLOSED, straight=True)


def panel_frame(pose: Pose, angle: float) -> Pose:
    """Return the frame of the panel: x along it, y in the opening direction."""
    return pose.compose(Pose.planar(0.0, 0.0, 0.0, angle))


def beside(scene: Scene, pose: Pose, angle: float, gap: float) -> Pose:
    """Return the pose of the closed fingers at a distance (m) from the door at an angle (rad)."""
    across = -(THICKNESS + scene.robot.model.gripper.finger[1]) / 2 - gap
    return panel_frame(pose, angle).compose(Pose((PUSHED, across, LOW)))


def aligned(scene: Scene, pose: Pose) -> Pose:
    """Return a pose with the fingers along the door, with the smaller of the two rotations."""
    tool = scene.robot.pose
    rotates = "r" in scene.config.action_sequence
    rotation = wrap_angle(pose.yaw - tool.yaw, math.pi) if rotates else 0.0
    return Pose.planar(*pose.position, tool.yaw + rotation)


bulletarm_gym.register_task("DoorOpening", DoorOpening)
