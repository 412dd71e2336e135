"""Grippers with two parallel fingers.

The tool frame lies between the fingertips. Its z axis points back to the arm, upwards when the gripper points
down. Its x axis is the opening direction.
"""

import math
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, field
from xml.etree.ElementTree import Element

from bulletarm_gym.config_checks import check_argument, check_fields, function, instances, numbers, rule
from bulletarm_gym.geometry import Pose, Vector, euler_pose
from bulletarm_gym.geometry.poses import pose_check
from bulletarm_gym.robots.editing import (
    DARK,
    LIGHT,
    RGB,
    Primitive,
    add_link,
    box,
    check_element,
    joints_below,
)
from bulletarm_gym.simulation.urdf import add_joint, find

FINGER_MASS = 0.05
"""Mass (kg) of a finger of a :class:`ParallelJaw`."""
JOINTS = instances(str, "names of joints", can_be_empty=False)
"""Check of names of joints."""


@dataclass(frozen=True, kw_only=True)
class Gripper:
    """Two fingers on prismatic joints. A joint is at 0 where the fingers meet and grows when they open.

    :param joints: names of the finger joints
    :param stroke: maximum opening between the pads (m)
    :param finger: side lengths (m) of a finger: thickness along the opening, width, length beyond the palm
    :param force: closing force of each finger (N)
    :param speed: maximum speed of each finger (m/s)
    :param friction: friction coefficient of the pads; the product with an object's coefficient is effective
    :param shoulder: thickness (m) of the thicker upper part of a finger, and the height (m) above the
        fingertips where it begins
    :param palm: side lengths (m) of the palm's bounding box along the opening, across it, and upwards from
        the fingers' roots, for collision tests of experts; 0 if it is narrower than the fingers
    :raises ValueError: a value has a wrong length, or a number is not finite or not positive
    """

    stroke: float
    finger: Vector
    palm: Vector = (0.0, 0.0, 0.0)
    joints: tuple[str, str] = ("left_finger_joint", "right_finger_joint")
    force: float = 30.0
    speed: float = 0.4
    friction: float = 1.5
    shoulder: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        counts = {"finger": 3, "palm": 3, "shoulder": 2}
        lengths = {name: numbers("non-negative", count) for name, count in counts.items()}
        names = rule("a tuple of the names of two joints", lambda pair: len(pair) == 2, JOINTS)
        one = dict.fromkeys(("stroke", "force", "speed", "friction"), numbers("positive"))
        check_fields(self, {**one, **lengths, "joints": names})

    @property
    def overhang(self) -> float:
        """Distance (m) by which the palm is wider than the open fingers, negative if it is narrower."""
        return self.palm[0] / 2.0 - self.half_width()

    def half_width(self, ratio: float = 1.0) -> float:
        """Return the distance (m) from the centre to the outer side of a finger at an opening ratio."""
        return ratio * self.stroke / 2.0 + self.finger[0]

    def lowest(self, pose: Pose) -> float:
        """Return the height (m) of the lowest point of the open fingers, tilted or upright."""
        x, y, z, w = pose.orientation
        along, across = 2.0 * abs(x * z - w * y), 2.0 * abs(y * z + w * x)
        return pose.z - along * self.half_width() - across * self.finger[1] / 2.0


@dataclass(frozen=True, kw_only=True)
class ParallelJaw(Gripper):
    """A gripper of primitives for the flange of any arm. The flange's z axis points along the approach.

    :param palm: side lengths (m) of the box that carries the fingers, which is part of the model
    :param colour: colour of the fingers
    :param housing: further shapes of the palm in the frame of the flange
    :param trim: further shapes of a finger; x points outwards from the pad, z along the finger from the palm
    """

    palm: Vector = field()
    colour: RGB = LIGHT
    housing: tuple[Primitive, ...] = ()
    trim: tuple[Primitive, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        check_fields(self, dict.fromkeys(("housing", "trim"), instances(Primitive, "primitives")))

    def tool(self, flange: Pose) -> Pose:
        """Return the tool frame in the link that contains the flange."""
        flange, length = check_argument("flange", flange, pose_check), self.palm[2] + self.finger[2]
        return flange.compose(euler_pose((0.0, 0.0, length), (math.pi, 0.0, 0.0)))

    def fitted(self, arm: Callable[[], Element], link: str, flange: Pose) -> Element:
        """Return the URDF of an arm with the palm as part of a link and the fingers as further links.

        :param arm: function that returns the URDF of the arm
        :param flange: pose of the flange in the link
        :raises ValueError: ``arm`` returns something else, the model has no such link, or the link carries a
            gripper
        """
        flange = check_argument("flange", flange, pose_check)
        check_argument("arm", arm, function)
        check_element("arm()", root := deepcopy(arm()))
        carrier = find(root, "link", link)
        for joint in joints_below(root, link):
            if joint.get("type") != "fixed":
                raise ValueError(
                    f"link must carry no gripper, got {link!r} with the joint {joint.get('name')!r}. "
                    "Use without(model, LINK) in load."
                )
        for primitive in (box(self.palm, (0.0, 0.0, self.palm[2] / 2.0), DARK), *self.housing):
            primitive.add_to(carrier, flange)
        thickness, _, length = self.finger
        pad = box(self.finger, (thickness / 2.0, 0.0, length / 2.0), self.colour)
        for joint_name, yaw in zip(self.joints, (0.0, math.pi), strict=True):
            finger, mount = joint_name.removesuffix("_joint"), Pose.planar(0.0, 0.0, self.palm[2], yaw)
            add_link(root, finger, FINGER_MASS, (pad, *self.trim))
            ends, pose, axis = (link, finger), flange.compose(mount), (1.0, 0.0, 0.0)
            add_joint(root, "prismatic", joint_name, ends, pose, axis, (0.0, self.stroke / 2.0))
        return root
