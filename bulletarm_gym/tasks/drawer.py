"""Opening a drawer."""

import math
from collections.abc import Iterator

import numpy as np

from bulletarm_gym.config import CLOSE_LOOP, EnvConfig, TaskDefaults
from bulletarm_gym.experts import CLOSED, Waypoint
from bulletarm_gym.experts.approach import ALIGNED, ALIGNED_YAW, HOVER, pass_above, rotates
from bulletarm_gym.geometry import Pose, planar_distance, wrap_angle
from bulletarm_gym.objects import drawer
from bulletarm_gym.objects.containers import CABINET, HANDLE, HANDLE_DISTANCE, HANDLE_RADIUS, STRUT_SPACING
from bulletarm_gym.robots.gripper import Gripper
from bulletarm_gym.scene import ObjectSlot, Scene
from bulletarm_gym.scene.sampling import is_within, sample_until
from bulletarm_gym.tasks.task import Task

OPENED = 0.15
"""Displacement (m) of the drawer that counts as open."""
MARGIN = 0.015
"""Displacement (m) of the expert's pull in addition to :data:`OPENED`."""
CABINET_DISTANCE = (0.15, 0.2)
"""Range of the cabinet's distance (m) behind the workspace's centre."""
CABINET_ASIDE = 0.1
"""Largest sideways distance (m) of the cabinet from the workspace's centre."""
HOOK = HANDLE[0] + (HANDLE_DISTANCE + HANDLE_RADIUS) / 2.0
"""Position (m) along the closed cabinet's x axis in the middle between bar and drawer."""
BAR_CLEARANCE = 2e-3
"""Gap (m) to the bar of a gripper with short fingers, whose palm descends in front of the cabinet."""
PRECISE, PRECISE_YAW = 2e-3, 0.02
"""Distance (m) and yaw (rad) within which that gripper descends."""
FINGERTIP_HEIGHT = HANDLE[2] - 0.02
"""Height (m) of the fingertips behind the bar."""
BORDER_CLEARANCE = 5e-3
"""Distance (m) of the gripper's path to the workspace's border."""


class DrawerOpening(Task):
    """Pull a drawer open by its handle.

    Description: a fixed cabinet, 21 x 23 x 11 cm, with a drawer that has a bar as its handle.
    Randomisation: the cabinet's yaw, its front towards the workspace, and its position, 15 to 20 cm behind
    the workspace's centre and up to 10 cm sideways; with a fixed orientation it opens along y.
    Success: the drawer is open by more than 15 cm.
    Expert: move the closed gripper above the gap behind the bar, lower, pull.
    """

    instructions = ("Pull a drawer open by its handle.", "Open the drawer.", "Pull the handle of the drawer.")
    defaults = TaskDefaults(
        num_objects=1,
        no_tray="the cabinet does not fit into the tray",
        level_ground="the cabinet stands on level ground",
    )
    controls = (CLOSE_LOOP,)
    height = HANDLE[2] + HANDLE_RADIUS

    def bodies(self, config: EnvConfig) -> list[ObjectSlot]:
        return [ObjectSlot("drawer", (drawer("drawer"),))]

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        ends = (HOOK, _open_position(scene.robot.model.gripper))

        def draw() -> Pose:
            distance = float(rng.uniform(*CABINET_DISTANCE))
            aside = float(rng.uniform(-CABINET_ASIDE, CABINET_ASIDE))
            if self.config.random_orientation:
                yaw = float(rng.uniform(-math.pi, math.pi))
            else:
                yaw = math.pi / 2.0 if rng.integers(2) else -math.pi / 2.0
            x, y, _ = Pose.planar(*scene.config.centre, 0.0, yaw).transform((distance, aside, 0.0))
            return scene.surface.pose((x, y), yaw)

        def fits(pose: Pose) -> bool:
            return all(is_within(scene, pose.transform((x, 0.0, 0.0)), BORDER_CLEARANCE) for x in ends)

        scene["drawer"].place(sample_until(draw, fits))
        scene["drawer"].set_joints((0.0,))

    def evaluate(self, scene: Scene) -> dict[str, bool]:
        return {"success": scene["drawer"].joints[0] > OPENED}

    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        tool, gripper = scene.robot.pose, scene.robot.model.gripper
        cabinet, opened = scene["drawer"].pose, scene["drawer"].joints[0]
        yaw = tool.yaw
        if rotates(scene):
            yaw += wrap_angle(cabinet.yaw + math.pi / 2.0 - tool.yaw, math.pi)
        x, y, z = cabinet.inverse().transform(tool.position)
        behind = x + opened - HANDLE[0]
        if not (0.0 < behind < HANDLE_DISTANCE and abs(y) < STRUT_SPACING / 2.0 and z < HANDLE[2]):
            x, y, near, near_yaw = HOOK - opened, 0.0, ALIGNED, ALIGNED_YAW
            if FINGERTIP_HEIGHT + gripper.finger[2] <= CABINET[2]:  # short fingers
                near_bar = HANDLE[0] + HANDLE_RADIUS + gripper.finger[1] / 2.0 + BAR_CLEARANCE
                x, near, near_yaw = min(HOOK, near_bar) - opened, PRECISE, PRECISE_YAW
            hook = Pose.planar(*cabinet.transform((x, y, FINGERTIP_HEIGHT)), yaw)
            if planar_distance(hook.position, tool.position) > near or abs(tool.yaw - yaw) > near_yaw:
                yield from pass_above(tool, hook, CABINET[2] + HOVER)
            yield Waypoint(hook, CLOSED)
        # The speed is the same along the workspace's diagonals and sides.
        end = max(_open_position(gripper), x - scene.max_translation)
        goal = cabinet.transform((end, y, FINGERTIP_HEIGHT))
        yield Waypoint(Pose.planar(*goal, yaw), CLOSED, straight=True)


def _open_position(gripper: Gripper) -> float:
    """Return the position (m) of the gripper along the cabinet's x axis when the drawer is open."""
    return HANDLE[0] + HANDLE_RADIUS + gripper.finger[1] / 2.0 - OPENED - MARGIN
