"""What an arm is, as data."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from xml.etree import ElementTree

import numpy as np

from bulletarm_gym.geometry import FloatArray, Pose
from bulletarm_gym.robots.gripper import Gripper
from bulletarm_gym.robots.kinematics import Chain
from bulletarm_gym.robots.urdf import DARK, add_parts, cylinder, merge_fixed

PLINTH_RADIUS = 0.09
"""Of the stand (m) under an arm whose base is above the ground; it stays clear of the workspaces."""
TRAVEL_TOLERANCE = 1e-4
"""What a stroke and the joints' limits may differ by (m)."""


@dataclass(frozen=True)
class RobotModel:
    """An arm and its gripper.

    :param name: the value of the parameter ``robot``
    :param load: reads or makes the URDF of the arm with its gripper, see
        :func:`~bulletarm_gym.robots.read_urdf`
    :param joints: names of the revolute joints, from the base to the gripper
    :param tool: the gripper's tool frame, between the fingertips, in the link that the last joint moves: z
        back towards the arm, x along which the fingers open
    :param gripper: the fingers in that model
    :param base: of the arm, in the world; chosen so that every pose of the default workspaces can be reached
    :param posture: joint positions (rad) near which poses are sought: gripper down, elbow up, before the base
    :param force: greatest torque (N m) of each joint; what the pace of the simulation takes is more than most
        real arms have
    """

    name: str
    load: Callable[[], ElementTree.Element]
    joints: tuple[str, ...]
    tool: Pose
    gripper: Gripper
    base: Pose
    posture: tuple[float, ...]
    force: float

    @cached_property
    def urdf(self) -> ElementTree.Element:
        """The model on its plinth, its first link being the root, its arm joints without limits.

        With limits an arm on the floor cannot reach the whole workspace at every tilt, and its wrist could
        not turn on and on.

        :raises ValueError: a joint is missing, or a finger's ends before the gripper's stroke does
        """
        root = self.load()
        merge_fixed(root)
        for name in self.gripper.joints:
            self._check_travel(self._joint(root, name))
        for name in self.joints:
            joint = self._joint(root, name)
            joint.set("type", "continuous")
            for limit in joint.findall("limit"):
                joint.remove(limit)
        if self.base.z > 0.0:
            # Only seen: ramps reach under the arm, and what touches something cannot be moved at once.
            plinth = cylinder(PLINTH_RADIUS, self.base.z, (0.0, 0.0, -self.base.z / 2.0), DARK, solid=False)
            add_parts(root.findall("link")[0], [plinth])
        return root

    def _joint(self, root: ElementTree.Element, name: str) -> ElementTree.Element:
        joint = root.find(f"joint[@name='{name}']")
        if joint is None:
            raise ValueError(f"robot {self.name!r}: the model has no joint {name!r}")
        return joint

    def _check_travel(self, finger: ElementTree.Element) -> None:
        """Compare what the gripper says with what the model lets a finger do."""
        limit = finger.find("limit")
        upper = math.inf if limit is None else float(limit.get("upper", "0"))
        if upper < self.gripper.travel - TRAVEL_TOLERANCE:
            raise ValueError(
                f"robot {self.name!r}: the gripper's stroke of {self.gripper.stroke:g} m takes each finger "
                f"{self.gripper.travel:g} m, but {finger.get('name')!r} ends at {upper:g} m in the model"
            )

    @cached_property
    def chain(self) -> Chain:
        """Kinematics from the world to the fingertips."""
        return Chain.from_urdf(self.urdf, list(self.joints), self.base, self.tool)

    def inverse(self, pose: Pose) -> tuple[FloatArray, float]:
        """Return joint positions (n,) rad for a fingertip pose, and the error that remains (m or rad).

        The search first goes from the model's posture to the same place with the gripper upright and turned
        with the arm, then to the pose itself, so neighbours end near each other. The answer depends on the
        pose alone.
        """
        x, y = pose.x - self.base.x, pose.y - self.base.y
        azimuth = math.atan2(y, x)
        upright = Pose.planar(self.base.x + math.hypot(x, y), self.base.y, pose.z)
        start, _ = self.chain.inverse(upright, np.array(self.posture))
        start[0] += azimuth
        start[-1] -= pose.yaw - azimuth
        return self.chain.inverse(pose, start)

    @cached_property
    def xml(self) -> str:
        """The model as the simulator loads it."""
        ElementTree.indent(self.urdf)  # Bullet breaks lines of more than 1,023 characters, wherever that is
        return ElementTree.tostring(self.urdf, encoding="unicode")
