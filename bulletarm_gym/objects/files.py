"""Objects from a user's OBJ, STL or URDF files.

As in Bullet, each named part of an OBJ file becomes one convex hull. A URDF gives the collision geometry,
colour, mass and friction of one rigid link. Its inertia is not used: a body has that of its shape.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from bulletarm_gym.geometry import Pose, Vector, euler_pose
from bulletarm_gym.objects.graspables import graspable
from bulletarm_gym.objects.hull import convex_hull
from bulletarm_gym.simulation.meshes import mesh_parts
from bulletarm_gym.simulation.shapes import ORIGIN, BodySpec, Box, Colour, Convex, Piece
from bulletarm_gym.simulation.urdf import mesh_path, number_of, parse_urdf

SMALLEST = 0.005
LARGEST = 0.3
"""Sides (m) of a bounding box between which an object can be handled at all: a wrong unit is noticed."""
LIGHTEST = 1e-3
HEAVIEST = 5.0
"""Minimum and maximum mass (kg) of an object, which recognise a wrong unit."""
GREY: Colour = (0.7, 0.7, 0.7, 1.0)
FRICTIONS = {
    "lateral_friction": "friction",
    "rolling_friction": "rolling_friction",
    "spinning_friction": "spinning_friction",
}
"""Elements of a URDF's ``<contact>`` and the parameters of :class:`BodySpec` that they set."""


def is_urdf(path: Path) -> bool:
    """Return True if a file's name is that of a URDF."""
    return path.suffix.lower() == ".urdf"


def load_object(path: Path, name: str) -> BodySpec:
    """Return the object of a file; what the file does not say is as in all objects to be grasped.

    :raises ValueError: it cannot be loaded
    """
    try:
        spec = _from_urdf(path, name) if is_urdf(path) else graspable(name, _hulls(path), GREY)
        if not (SMALLEST <= min(spec.extents) and max(spec.extents) <= LARGEST):
            sides = " x ".join(f"{side:.4g}" for side in spec.extents)
            raise ValueError(f"its sides must be {SMALLEST} to {LARGEST} m, got {sides}")
        if not LIGHTEST <= spec.mass <= HEAVIEST:
            raise ValueError(f"its mass must be {LIGHTEST} to {HEAVIEST} kg, got {spec.mass:g}")
    except (ValueError, OSError) as error:
        raise ValueError(f"object_set: {path} cannot be loaded: {error}") from error
    return spec


def _hulls(path: Path, scale: Vector = (1.0, 1.0, 1.0), pose: Pose = ORIGIN) -> list[Piece]:
    """Return the convex hull of every part of a mesh."""
    pieces = []
    for name, points in mesh_parts(path):
        try:
            pieces.append(Piece(Convex(convex_hull(points * np.array(scale))), pose))
        except ValueError as error:
            raise ValueError(f"{error} (part {name!r})") from error
    return pieces


def _from_urdf(path: Path, name: str) -> BodySpec:
    """Return the object of a URDF's one link."""
    root = parse_urdf(path)
    links = root.findall("link")
    if len(links) != 1:
        raise ValueError(f"it has {len(links)} links; an object to grasp is one rigid link")
    collisions = links[0].findall("collision")
    if not collisions:
        raise ValueError("its link has no collision geometry")
    pieces = [piece for collision in collisions for piece in _collision_pieces(collision, path.parent)]
    spec = graspable(name, pieces, _colour(root))
    mass, contact = links[0].find("inertial/mass"), links[0].find("contact")
    values: dict[str, Any] = {} if mass is None else {"mass": _number(mass)}
    for tag, parameter in FRICTIONS.items():
        element = None if contact is None else contact.find(tag)
        if element is not None:
            values[parameter] = _number(element)
            if not 0.0 <= values[parameter] < np.inf:
                raise ValueError(f"{tag} must be a finite number of at least 0, got {values[parameter]:g}")
    return replace(spec, **values)


def _collision_pieces(collision: Element, folder: Path) -> list[Piece]:
    pose = _origin(collision.find("origin"))
    mesh, box = collision.find("geometry/mesh"), collision.find("geometry/box")
    if box is not None:
        return [Piece(Box(_vector(box.get("size", ""))), pose)]
    if mesh is None:
        raise ValueError("its collision geometry is neither a mesh nor a box")
    file = mesh_path(mesh.get("filename", ""), folder.absolute())
    return _hulls(file, _vector(mesh.get("scale", "1 1 1")), pose)


def _origin(origin: Element | None) -> Pose:
    """Return the frame that a URDF origin describes."""
    if origin is None:
        return ORIGIN
    return euler_pose(_vector(origin.get("xyz", "0 0 0")), _vector(origin.get("rpy", "0 0 0")))


def _vector(text: str) -> Vector:
    values = [float(word) for word in text.split()]
    if len(values) != 3:
        raise ValueError(f"{text!r} is not three numbers")
    return (values[0], values[1], values[2])


def _number(element: Element) -> float:
    return number_of(element, "value", "")


def _colour(root: Element) -> Colour:
    """Return the colour of a URDF's first visual, of its own or of the material that it names."""
    material = root.find("link/visual/material")
    if material is None:
        return GREY
    named = [other for other in root.findall("material") if other.get("name") == material.get("name")]
    colour = next(
        (found for found in (one.find("color") for one in (material, *named)) if found is not None), None
    )
    if colour is None:
        return GREY
    text = colour.get("rgba", "")
    try:
        red, green, blue, alpha = (float(word) for word in text.split())
    except ValueError:
        raise ValueError(f"rgba of <color> must be four numbers, got {text!r}") from None
    if not all(0.0 <= value <= 1.0 for value in (red, green, blue, alpha)):
        raise ValueError(f"rgba of <color> must be from 0 to 1, got {text!r}")
    return (red, green, blue, alpha)
