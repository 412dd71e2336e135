"""Links of boxes and cylinders for robots whose shapes are not in a file."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from bulletarm_gym.geometry import Pose, Vector, euler_pose
from bulletarm_gym.simulation.urdf import add_geometry, add_inertial, add_material, text_of

RGB: TypeAlias = tuple[float, float, float]
"""Red, green and blue, 0 to 1."""

DARK: RGB = (0.25, 0.25, 0.27)
LIGHT: RGB = (0.55, 0.57, 0.60)


@dataclass(frozen=True)
class Primitive:
    """A box, or a cylinder along its z axis.

    :param kind: ``"box"`` or ``"cylinder"``
    :param extents: side lengths (m) of the bounding box
    :param pose: pose of the centre in the link
    :param solid: whether it collides; if False it is only rendered
    """

    kind: str
    extents: Vector
    pose: Pose
    colour: RGB
    solid: bool = True

    def add_to(self, link: Element, frame: Pose | None = None, visible: bool = True) -> None:
        """Add the visual and the collision element to a link.

        :param frame: pose in the link of the frame that the primitive is in, by default the link's frame
        """
        pose = self.pose if frame is None else frame.compose(self.pose)
        x, _, z = self.extents
        size = {"radius": repr(x / 2.0), "length": repr(z)}
        if self.kind == "box":
            size = {"size": text_of(self.extents)}
        if visible:
            add_material(add_geometry(link, "visual", self.kind, pose, **size), (*self.colour, 1.0))
        if self.solid:
            add_geometry(link, "collision", self.kind, pose, **size)


def box(extents: Vector, centre: Vector, colour: RGB, tilt: float = 0.0, solid: bool = True) -> Primitive:
    """Return a box (m), rotated by ``tilt`` (rad) about its y axis."""
    return Primitive("box", extents, euler_pose(centre, (0.0, tilt, 0.0)), colour, solid)


def cylinder(radius: float, length: float, centre: Vector, colour: RGB, solid: bool = True) -> Primitive:
    """Return a cylinder (m) along the z axis of the link."""
    return Primitive("cylinder", (2.0 * radius, 2.0 * radius, length), Pose(centre), colour, solid)


def add_link(root: Element, name: str, mass: float, primitives: Sequence[Primitive]) -> None:
    """Add a link of primitives with its mass (kg) at the centre of the first one.

    Bullet computes the inertia from the collision shapes.
    """
    link = SubElement(root, "link", name=name)
    add_inertial(link, primitives[0].pose, mass, np.eye(3).tolist())
    for primitive in primitives:
        primitive.add_to(link)
