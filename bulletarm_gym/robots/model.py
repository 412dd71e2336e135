"""What an arm is, as data."""

import math
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from bulletarm_gym.geometry import FloatArray, Pose
from bulletarm_gym.robots.gripper import ParallelJaw
from bulletarm_gym.robots.kinematics import Chain


@dataclass(frozen=True)
class RobotModel:
    """An arm and its gripper.

    :param name: the value of the parameter ``robot``
    :param arm: reads the arm's URDF, without a gripper
    :param joints: names of the revolute joints, from the base to the flange
    :param flange_link: the link that carries the gripper
    :param flange: the gripper's mount in that link
    :param base: of the arm, in the world; chosen so that every pose of the default workspaces can be reached
    :param posture: joint positions (rad) near which poses are sought: gripper down, elbow up, before the base
    :param force: greatest torque (N m) of each joint
    """

    name: str
    arm: Callable[[], ElementTree.Element]
    joints: tuple[str, ...]
    flange_link: str
    flange: Pose
    gripper: ParallelJaw
    base: Pose
    posture: tuple[float, ...]
    force: float

    @cached_property
    def urdf(self) -> ElementTree.Element:
        """The model with its gripper, its arm joints without limits.

        The original release ignores the limits too; with them an arm on the floor cannot reach the whole
        workspace at every tilt, and its wrist could not turn on and on.
        """
        root = self.arm()
        for name in self.joints:
            joint = root.find(f"joint[@name='{name}']")
            if joint is None:
                raise ValueError(f"robot {self.name!r}: the model has no joint {name!r}")
            joint.set("type", "continuous")
            for limit in joint.findall("limit"):
                joint.remove(limit)
        self.gripper.attach(root, self.flange_link, self.flange)
        return root

    @cached_property
    def chain(self) -> Chain:
        """Kinematics from the world to the fingertips."""
        return Chain.from_urdf(self.urdf, list(self.joints), self.base, self.gripper.tool(self.flange))

    def inverse(self, pose: Pose) -> tuple[FloatArray, float]:
        """Return joint positions (n,) rad for a fingertip pose, and the error that remains (m or rad).

        The search starts from the model's posture, turned about the base towards the pose and about the
        flange to its yaw, so the answer depends on the pose alone.
        """
        start = np.array(self.posture)
        azimuth = math.atan2(pose.y - self.base.y, pose.x - self.base.x)
        start[0] += azimuth
        start[-1] -= pose.yaw - azimuth
        return self.chain.inverse(pose, start)

    def write_urdf(self, folder: Path) -> Path:
        """Write the model for the simulator to load."""
        path = folder / f"{self.name}.urdf"
        ElementTree.ElementTree(self.urdf).write(path)
        return path

    def temporary_urdf(self) -> tempfile.TemporaryDirectory[str]:
        """Return a folder that holds the model until it is left."""
        folder = tempfile.TemporaryDirectory(prefix="bulletarm_")
        self.write_urdf(Path(folder.name))
        return folder
