"""Grippers with two parallel fingers.

The tool frame lies between the fingertips. Its z axis points back to the arm, upwards when the gripper points
down. Its x axis is the opening direction.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from xml.etree.ElementTree import Element

from bulletarm_gym.geometry import Pose, Vector, euler_pose
from bulletarm_gym.robots import checks
from bulletarm_gym.robots.primitives import DARK, LIGHT, RGB, Primitive, add_link, box
from bulletarm_gym.simulation.urdf import add_joint, children_of, end_of, find_link

FINGER_MASS = 0.05
"""Mass (kg) of a finger of a :class:`ParallelJaw`."""


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
        """Check the values."""
        lengths = ("three lengths (m) of at least 0", partial(checks.numbers, count=3, low=0.0))
        fields: dict[str, tuple[str, checks.Converter]] = {
            **dict.fromkeys(("stroke", "force", "speed", "friction"), ("a positive number", checks.positive)),
            "finger": lengths,
            "palm": lengths,
            "shoulder": (
                "a thickness and a height (m) of at least 0",
                partial(checks.numbers, count=2, low=0.0),
            ),
            "joints": ("a tuple of 2 names", partial(checks.names, count=2)),
        }
        checks.convert_fields(self, "gripper.", fields)

    @property
    def travel(self) -> float:
        """Maximum displacement (m) of a finger."""
        return self.stroke / 2.0

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

    @property
    def length(self) -> float:
        """Distance (m) from the flange to the fingertips."""
        return self.palm[2] + self.finger[2]

    def tool(self, flange: Pose) -> Pose:
        """Return the tool frame in the link that contains the flange."""
        return flange.compose(euler_pose((0.0, 0.0, self.length), (math.pi, 0.0, 0.0)))

    def fitted(self, arm: Callable[[], Element], link: str, flange: Pose) -> Element:
        """Return the URDF of an arm with the palm as part of a link and the fingers as further links.

        :param arm: function that returns the URDF of the arm
        :param flange: pose of the flange in the link
        :raises ValueError: the model has no such link, or the link carries a gripper
        """
        root = arm()
        _check_free(root, link)
        palm = box(self.palm, (0.0, 0.0, self.palm[2] / 2.0), DARK)
        carrier = find_link(root, link)
        for primitive in (palm, *self.housing):
            primitive.moved(flange).add_to(carrier)
        for name, yaw in zip(self.joints, (0.0, math.pi), strict=True):
            self._add_finger(root, name, link, flange.compose(Pose.planar(0.0, 0.0, self.palm[2], yaw)))
        return root

    def _add_finger(self, root: Element, joint: str, parent: str, mount: Pose) -> None:
        thickness, _, length = self.finger
        child = joint.removesuffix("_joint")
        pad = box(self.finger, (thickness / 2.0, 0.0, length / 2.0), self.colour)
        add_link(root, child, FINGER_MASS, (pad, *self.trim))
        limits, axis = (0.0, self.travel), (1.0, 0.0, 0.0)
        add_joint(root, "prismatic", joint, (parent, child), mount, axis, limits, self.force, self.speed)


def _check_free(root: Element, link: str) -> None:
    """Raise ValueError if a joint moves a link attached to ``link``, as on a flange with a gripper."""
    attached = [link]
    for name in attached:
        for joint in children_of(root, name):
            if joint.get("type") != "fixed":
                raise ValueError(
                    f"link must carry no gripper, got {link!r} with the joint {joint.get('name')!r}. "
                    f"Use without(model, {name!r}) in load."
                )
            if (child := end_of(joint, "child")) not in attached:
                attached.append(child)
