"""Opening a drawer."""

import math
from collections.abc import Iterator

import numpy as np

from bulletarm_gym.config import CLOSE_LOOP, EnvConfig, TaskDefaults, TrayUse
from bulletarm_gym.experts.approach import ALIGNED, ALIGNED_YAW, HEIGHT_TOLERANCE, HOVER
from bulletarm_gym.experts.waypoints import CLOSED, Waypoint
from bulletarm_gym.geometry import Pose, planar_distance, wrap_angle
from bulletarm_gym.objects import drawer
from bulletarm_gym.objects.containers import CABINET, HANDLE, HANDLE_DISTANCE, HANDLE_RADIUS, STRUT_SPACING
from bulletarm_gym.scene import ObjectSlot, Scene
from bulletarm_gym.scene.sampling import is_within, sample_until
from bulletarm_gym.tasks.task import Task

OPENED = 0.15
"""Displacement (m) of the drawer that counts as open."""
FARTHER = 0.015
"""By how much (m) more than that the expert pulls."""
CABINET_DISTANCE = (0.15, 0.2)
"""How far (m) the cabinet is behind the workspace's centre ..."""
CABINET_ASIDE = 0.1
"""... and aside of it at most (m)."""
HOOK = (HANDLE_DISTANCE + HANDLE_RADIUS) / 2.0
"""Where (m) the gripper goes down behind the bar: in the middle between bar and drawer ..."""
BAR_CLEARANCE = 2e-3
"""... or this far (m) from the bar, where with short fingers the palm comes down before the cabinet ..."""
ALIGNED_BEFORE, ALIGNED_YAW_BEFORE = 2e-3, 0.02
"""... within this distance (m) and angle (rad), or it would come down on the cabinet."""
BELOW = 0.02
"""How far (m) the fingertips reach below the bar."""
BORDER_CLEARANCE = 5e-3
"""Distance (m) of the gripper's way to the border."""


class DrawerOpening(Task):
    """Pull a drawer open by its handle.

    Description: a cabinet, 21 x 23 x 11 cm, with a drawer that has a bar for a handle. The cabinet is fixed.
    Randomisation: the cabinet's yaw, its front towards the workspace, and its position, 15 to 20 cm behind
    the workspace's centre and up to 10 cm aside; with a fixed orientation it opens along y.
    Success: the drawer is open by more than 15 cm.
    Expert: over the gap behind the bar with the gripper closed, down, out.
    """

    defaults = TaskDefaults(
        num_objects=1,
        tray=TrayUse((False,), "the cabinet does not fit into the tray"),
        level_ground="the cabinet stands on level ground",
    )
    controls = (CLOSE_LOOP,)

    @property
    def height(self) -> float:
        """The gripper must get over the handle."""
        return HANDLE[2] + HANDLE_RADIUS

    def bodies(self, config: EnvConfig) -> list[ObjectSlot]:
        """Return the cabinet with its drawer."""
        return [ObjectSlot("drawer", (drawer("drawer"),))]

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        """Put the cabinet where the gripper can hook the handle and open the drawer."""

        def draw() -> Pose:
            offset = (
                float(rng.uniform(*CABINET_DISTANCE)),
                float(rng.uniform(-CABINET_ASIDE, CABINET_ASIDE)),
                0.0,
            )
            yaw = self._yaw(rng)
            x, y, _ = Pose.planar(*scene.config.centre, 0.0, yaw).transform(offset)
            return scene.surface.pose((x, y), yaw)

        def fits(pose: Pose) -> bool:
            return all(
                is_within(scene, pose.transform((x, 0.0, 0.0)), BORDER_CLEARANCE)
                for x in (_START, _end(scene))
            )

        scene["drawer"].place(sample_until(draw, fits))
        scene["drawer"].set_joints((0.0,))

    def _yaw(self, rng: np.random.Generator) -> float:
        if self.config.random_orientation:
            return float(rng.uniform(-math.pi, math.pi))
        return math.pi / 2.0 if rng.integers(2) else -math.pi / 2.0

    def evaluate(self, scene: Scene) -> dict[str, bool]:
        """Look how far the drawer is open."""
        return {"success": scene["drawer"].joints[0] > OPENED}

    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        """Go behind the bar, and pull."""
        item, hand = scene["drawer"], scene.robot.pose
        cabinet, opened = item.pose, item.joints[0]
        yaw = hand.yaw
        if "r" in scene.config.action_sequence:
            yaw += wrap_angle(cabinet.yaw + math.pi / 2.0 - hand.yaw, math.pi)
        x, y, z = cabinet.inverse().transform(hand.position)
        low = HANDLE[2] - BELOW
        behind = x + opened - HANDLE[0]
        if not (0.0 < behind < HANDLE_DISTANCE and abs(y) < STRUT_SPACING / 2.0 and z < HANDLE[2]):
            x, y = _start(scene) - opened, 0.0
            yield from self._hook(scene, cabinet.transform((x, y, low)), yaw)
        # No faster along the workspace's diagonals than along its sides.
        goal = cabinet.transform((max(_end(scene), x - scene.max_translation), y, low))
        yield Waypoint(Pose.planar(*goal, yaw), CLOSED, straight=True)

    def _hook(self, scene: Scene, hook: tuple[float, float, float], yaw: float) -> Iterator[Waypoint]:
        """Yield the way of the closed gripper over the cabinet's edge down behind the bar."""
        hand = scene.robot.pose
        over = CABINET[2] + HOVER
        near, turned = (ALIGNED, ALIGNED_YAW) if _is_long(scene) else (ALIGNED_BEFORE, ALIGNED_YAW_BEFORE)
        if planar_distance(hook, hand.position) > near or abs(hand.yaw - yaw) > turned:
            if hand.z < over - HEIGHT_TOLERANCE:
                yield Waypoint(Pose.planar(hand.x, hand.y, over, hand.yaw), CLOSED)
            yield Waypoint(Pose.planar(hook[0], hook[1], over, yaw), CLOSED)
        yield Waypoint(Pose.planar(*hook, yaw), CLOSED)


_START = HANDLE[0] + HOOK
"""Where (m) along the cabinet's x the gripper goes down when the drawer is shut, its fingers being long."""


def _is_long(scene: Scene) -> bool:
    """Whether the palm stays above the cabinet when the fingertips are below the bar."""
    return HANDLE[2] - BELOW + scene.robot.model.gripper.finger[2] > CABINET[2]


def _start(scene: Scene) -> float:
    """Return where (m) along the cabinet's x the gripper goes down when the drawer is shut."""
    finger = scene.robot.model.gripper.finger[1] / 2.0
    return _START if _is_long(scene) else min(_START, HANDLE[0] + HANDLE_RADIUS + finger + BAR_CLEARANCE)


def _end(scene: Scene) -> float:
    """Return where (m) along the cabinet's x the gripper is when the drawer is open."""
    finger = scene.robot.model.gripper.finger[1] / 2.0
    return HANDLE[0] + HANDLE_RADIUS + finger - OPENED - FARTHER
