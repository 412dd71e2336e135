"""A parallel-jaw gripper of boxes, to be fitted to any arm's flange.

Frames: the palm's z axis points along the approach; the tool frame at the fingertips points back (z up when
the gripper looks down) and its x axis is the direction in which the fingers open, as the tasks expect of
every arm.
"""

import math
from dataclasses import dataclass
from xml.etree import ElementTree

from bulletarm_gym.geometry import Pose, Vector
from bulletarm_gym.robots.kinematics import euler_pose

FINGERS = ("left_finger", "right_finger")
FINGER_JOINTS = ("left_finger_joint", "right_finger_joint")
DARK = "0.25 0.25 0.27 1"
LIGHT = "0.55 0.57 0.60 1"


@dataclass(frozen=True)
class ParallelJaw:
    """Sizes of a gripper whose two fingers slide apart.

    :param stroke: greatest opening between the pads (m)
    :param palm: side lengths (m) of the palm
    :param finger: side lengths (m) of a finger: thickness along the opening, width, length beyond the palm
    :param force: with which each finger closes (N)
    :param speed: of each finger (m/s)
    :param friction: of the pads; with a block's own friction of 1 it is the coefficient of the contact
    """

    stroke: float = 0.085
    palm: Vector = (0.125, 0.055, 0.06)
    finger: Vector = (0.012, 0.019, 0.09)
    force: float = 30.0
    speed: float = 0.4
    friction: float = 1.5

    @property
    def length(self) -> float:
        """Metres from the flange to the fingertips."""
        return self.palm[2] + self.finger[2]

    @property
    def travel(self) -> float:
        """Greatest displacement (m) of one finger."""
        return self.stroke / 2.0

    def tool(self, flange: Pose) -> Pose:
        """Return the tool frame in the link whose flange is given."""
        return flange.compose(euler_pose((0.0, 0.0, self.length), (math.pi, 0.0, 0.0)))

    def attach(self, root: ElementTree.Element, link: str, flange: Pose) -> None:
        """Add the palm to a link of a model and the fingers as links of their own."""
        parent = root.find(f"link[@name='{link}']")
        if parent is None:
            raise ValueError(f"the model has no link {link!r}")
        width, depth, height = self.palm
        palm = flange.compose(Pose((0.0, 0.0, height / 2.0)))
        for element in _box_elements((width, depth, height), palm, DARK):
            parent.append(element)
        for sign, finger, joint in zip((1.0, -1.0), FINGERS, FINGER_JOINTS, strict=True):
            root.append(self._finger_link(finger, sign))
            root.append(self._finger_joint(joint, link, finger, sign, flange))

    def _finger_link(self, name: str, sign: float) -> ElementTree.Element:
        thickness, _, length = self.finger
        centre = Pose((sign * thickness / 2.0, 0.0, length / 2.0))
        link = ElementTree.Element("link", name=name)
        inertial = ElementTree.SubElement(link, "inertial")
        ElementTree.SubElement(inertial, "origin", xyz=_text(centre.position))
        ElementTree.SubElement(inertial, "mass", value=str(FINGER_MASS))
        ElementTree.SubElement(inertial, "inertia", _inertia(FINGER_MASS, self.finger))
        link.extend(_box_elements(self.finger, centre, LIGHT))
        return link

    def _finger_joint(
        self, name: str, parent: str, child: str, sign: float, flange: Pose
    ) -> ElementTree.Element:
        root = flange.compose(Pose((0.0, 0.0, self.palm[2])))
        joint = ElementTree.Element("joint", name=name, type="prismatic")
        ElementTree.SubElement(joint, "parent", link=parent)
        ElementTree.SubElement(joint, "child", link=child)
        ElementTree.SubElement(joint, "origin", xyz=_text(root.position), rpy=_text((0.0, 0.0, root.yaw)))
        ElementTree.SubElement(joint, "axis", xyz=_text((sign, 0.0, 0.0)))
        limits = {
            "lower": "0",
            "upper": str(self.travel),
            "effort": str(self.force),
            "velocity": str(self.speed),
        }
        ElementTree.SubElement(joint, "limit", limits)
        return joint


FINGER_MASS = 0.05


def _box_elements(extents: Vector, centre: Pose, colour: str) -> list[ElementTree.Element]:
    elements = []
    for kind in ("visual", "collision"):
        element = ElementTree.Element(kind)
        ElementTree.SubElement(
            element, "origin", xyz=_text(centre.position), rpy=_text((0.0, 0.0, centre.yaw))
        )
        geometry = ElementTree.SubElement(element, "geometry")
        ElementTree.SubElement(geometry, "box", size=_text(extents))
        if kind == "visual":
            material = ElementTree.SubElement(element, "material", name=f"gripper {colour}")
            ElementTree.SubElement(material, "color", rgba=colour)
        elements.append(element)
    return elements


def _inertia(mass: float, extents: Vector) -> dict[str, str]:
    x, y, z = (side * side for side in extents)
    diagonal = {"ixx": y + z, "iyy": x + z, "izz": x + y}
    values = {key: str(mass / 12.0 * value) for key, value in diagonal.items()}
    return values | {"ixy": "0", "ixz": "0", "iyz": "0"}


def _text(values: Vector) -> str:
    return " ".join(repr(value) for value in values)
