"""Links of boxes and cylinders for robots whose shapes are not in a file."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
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

    def moved(self, frame: Pose) -> "Primitive":
        """Return the primitive in the outer frame of ``frame``."""
        return replace(self, pose=frame.compose(self.pose))

    def add_to(self, link: Element, visible: bool = True) -> None:
        """Add the visual and the collision element to a link."""
        x, _, z = self.extents
        sizes = {
            "box": {"size": text_of(self.extents)},
            "cylinder": {"radius": repr(x / 2.0), "length": repr(z)},
        }
        if visible:
            visual = add_geometry(link, "visual", self.kind, self.pose, **sizes[self.kind])
            add_material(visual, (*self.colour, 1.0))
        if self.solid:
            add_geometry(link, "collision", self.kind, self.pose, **sizes[self.kind])


def box(extents: Vector, centre: Vector, colour: RGB, tilt: float = 0.0, solid: bool = True) -> Primitive:
    """Return a box (m), rotated by ``tilt`` (rad) about its y axis."""
    return Primitive("box", extents, euler_pose(centre, (0.0, tilt, 0.0)), colour, solid)


def cylinder(radius: float, length: float, centre: Vector, colour: RGB, solid: bool = True) -> Primitive:
    """Return a cylinder (m) along the z axis of the link."""
    diameter = 2.0 * radius
    return Primitive("cylinder", (diameter, diameter, length), Pose(centre), colour, solid)


def add_link(root: Element, name: str, mass: float, primitives: Sequence[Primitive]) -> None:
    """Add a link of primitives with its mass (kg) at the centre of the first one.

    The inertia is that of the first one's bounding box. Bullet computes it from the collision shapes instead.
    """
    link = SubElement(root, "link", name=name)
    x, y, z = (side * side for side in primitives[0].extents)
    moments = [mass / 12.0 * (y + z), mass / 12.0 * (x + z), mass / 12.0 * (x + y)]
    add_inertial(link, primitives[0].pose, mass, np.diag(moments).tolist())
    for primitive in primitives:
        primitive.add_to(link)
