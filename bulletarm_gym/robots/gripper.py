"""Grippers of two fingers that slide apart: what an arm must know of them, and one to be fitted to a flange.

The tool frame lies between the fingertips: it points back (z up when the gripper looks down) and its x axis
is the direction in which the fingers open, as the tasks expect of every arm.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from xml.etree.ElementTree import Element, SubElement

from bulletarm_gym.config_checks import Check
from bulletarm_gym.geometry import Pose, Vector, euler_pose
from bulletarm_gym.robots import checks
from bulletarm_gym.robots.urdf import (
    DARK,
    LIGHT,
    Colour,
    Part,
    add_joint,
    add_link,
    add_parts,
    box,
    end_of,
    find_link,
)

FINGER_MASS = 0.05


@dataclass(frozen=True, kw_only=True)
class Gripper:
    """Two fingers on prismatic joints; each joint is 0 where they meet and grows as they open.

    :param joints: names of the fingers' joints
    :param stroke: greatest opening between the pads (m)
    :param finger: side lengths (m) of a finger: thickness along the opening, width, length beyond the palm
    :param force: with which each finger closes (N)
    :param speed: of each finger (m/s)
    :param friction: of the pads; with a block's own friction of 1 it is the coefficient of the contact
    :param shoulder: thickness (m) of a finger's thicker upper part, and the height (m) over the fingertips at
        which it begins
    :param palm: side lengths (m) of the box that carries the fingers: along the opening, across it, upwards
        from their roots; experts keep a wide one out of what stands beside an item. 0 where it is narrow
    :raises ValueError: a number is not finite or not positive, or a value has another length
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
        lengths = checks.numbers("three lengths (m) of at least 0", 3, 0.0)
        fields: dict[str, Check] = {
            **dict.fromkeys(("stroke", "force", "speed", "friction"), checks.positive),
            "finger": lengths,
            "palm": lengths,
            "shoulder": checks.numbers("a thickness and a height (m) of at least 0", 2, 0.0),
            "joints": checks.names(2),
        }
        checks.check_fields(self, "gripper.", fields)

    @property
    def travel(self) -> float:
        """Greatest displacement (m) of one finger."""
        return self.stroke / 2.0

    @property
    def overhang(self) -> float:
        """How far (m) the palm reaches out beyond the open fingers; negative where it is narrower."""
        return self.palm[0] / 2.0 - self.half_width()

    def half_width(self, ratio: float = 1.0) -> float:
        """Return the distance (m) from the middle to the outer side of a finger at an opening ratio."""
        return ratio * self.stroke / 2.0 + self.finger[0]

    def lowest(self, pose: Pose) -> float:
        """Return the height (m) of the open gripper's lowest point: tilted, it reaches below its middle."""
        x, y, z, w = pose.orientation
        along, across = 2.0 * abs(x * z - w * y), 2.0 * abs(y * z + w * x)
        return pose.z - along * self.half_width() - across * self.finger[1] / 2.0


@dataclass(frozen=True, kw_only=True)
class ParallelJaw(Gripper):
    """A gripper of primitives for any arm's flange, whose z axis points along the approach.

    :param palm: of the box that carries the fingers; it is part of the model
    :param colour: of the fingers
    :param housing: what else is seen of the palm, in the flange's frame
    :param trim: what else is seen of a finger: x outwards from its pad, z along it from the palm
    """

    palm: Vector = field()
    colour: Colour = LIGHT
    housing: tuple[Part, ...] = ()
    trim: tuple[Part, ...] = ()

    @property
    def length(self) -> float:
        """Metres from the flange to the fingertips."""
        return self.palm[2] + self.finger[2]

    def tool(self, flange: Pose) -> Pose:
        """Return the tool frame in the link whose flange is given."""
        return flange.compose(euler_pose((0.0, 0.0, self.length), (math.pi, 0.0, 0.0)))

    def fitted(self, arm: Callable[[], Element], link: str, flange: Pose) -> Element:
        """Return an arm's model with the palm as part of a link and the fingers as links of their own.

        :param arm: reads or makes the model
        :raises ValueError: the model has no such link, or the link carries a gripper
        """
        root = arm()
        _check_free(root, link)
        palm = box(self.palm, (0.0, 0.0, self.palm[2] / 2.0), DARK)
        add_parts(find_link(root, link), [part.seen_from(flange) for part in (palm, *self.housing)])
        for name, yaw in zip(self.joints, (0.0, math.pi), strict=True):
            self._add_finger(root, name, link, flange.compose(Pose.planar(0.0, 0.0, self.palm[2], yaw)))
        return root

    def _add_finger(self, root: Element, joint: str, parent: str, mount: Pose) -> None:
        thickness, _, length = self.finger
        child = joint.removesuffix("_joint")
        pad = box(self.finger, (thickness / 2.0, 0.0, length / 2.0), self.colour)
        add_link(root, child, FINGER_MASS, (pad, *self.trim))
        element = add_joint(root, "prismatic", joint, (parent, child), mount, (1.0, 0.0, 0.0))
        limits = {"lower": 0.0, "upper": self.travel, "effort": self.force, "velocity": self.speed}
        SubElement(element, "limit", {key: repr(value) for key, value in limits.items()})


def _check_free(root: Element, link: str) -> None:
    """Check that no joint moves what is attached to a link.

    :raises ValueError: one does, as on a flange that carries a gripper
    """
    carried = [link]
    for name in carried:
        for joint in (joint for joint in root.findall("joint") if end_of(joint, "parent") == name):
            if joint.get("type") != "fixed":
                raise ValueError(
                    f"link must carry no gripper, got {link!r} with the joint {joint.get('name')!r}. "
                    f"Use without(model, {name!r}) in load."
                )
            if (child := end_of(joint, "child")) not in carried:
                carried.append(child)
