"""Creation of bodies in Bullet from their specifications."""

import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement, fromstring

import numpy as np

from bulletarm_gym.geometry import Pose, matrix
from bulletarm_gym.simulation import urdf
from bulletarm_gym.simulation.client import Client, pybullet
from bulletarm_gym.simulation.shapes import ORIGIN, BodySpec, Box, Hinge, Piece, ascii_stl_as_obj, wavefront
from bulletarm_gym.simulation.state import Link, Properties

BASE = "base"
"""Name of the link that carries the moving parts of a body."""


def load_rigid(client: Client, spec: BodySpec, damping: float) -> int:
    """Load a body without moving parts, with the inertia of its shape, and return its number in Bullet."""
    frame, _ = spec.mass_properties
    body_id = client.createMultiBody(
        spec.mass,
        _collision_shape(client, spec),
        _visual_shape(client, spec),
        baseInertialFramePosition=frame.position,
        baseInertialFrameOrientation=frame.orientation,
    )
    _set_base_dynamics(client, body_id, spec, damping)
    return int(body_id)


def load_jointed(client: Client, spec: BodySpec, damping: float) -> int:
    """Load a body with moving parts, and return its number in Bullet, which reads joint limits from URDF."""
    is_free = spec.mass > 0.0
    has_hinges = any(isinstance(part, Hinge) for part in spec.parts)
    # A part that slides in a fixed body does not rotate: its inertia has no effect.
    flags = client.URDF_USE_INERTIA_FROM_FILE if is_free or has_hinges else 0
    with tempfile.TemporaryDirectory(prefix="bulletarm_") as folder:
        path = Path(folder, "body.urdf")
        path.write_text(_write_urdf(spec, Path(folder)))
        body_id = client.loadURDF(str(path), useFixedBase=not is_free, flags=flags)
    _set_base_dynamics(client, body_id, spec, damping)
    for joint, part in enumerate(spec.parts):
        client.changeDynamics(body_id, joint, lateralFriction=part.friction, jointDamping=0.0)
    set_resistance(client, body_id, spec)
    return int(body_id)


def set_resistance(client: Client, body_id: int, spec: BodySpec, factor: float = 1.0) -> None:
    """Set the resistance of the moving parts of a body to that of its specification times a factor."""
    for joint, part in enumerate(spec.parts):
        client.setJointMotorControl2(
            body_id, joint, client.VELOCITY_CONTROL, targetVelocity=0.0, force=factor * part.resistance
        )


def load_urdf(client: Client, name: str, xml: str, pose: Pose) -> tuple[int, tuple[Link, ...]]:
    """Load a body fixed to the world from a URDF, and switch off the default motors of its joints.

    :return: number of the body in Bullet; its links without the base
    :raises ValueError: Bullet cannot load the model
    """
    with ExitStack() as files, _temporary_file(_convert_meshes(xml, files), ".urdf") as path:
        try:
            body_id = int(client.loadURDF(path, pose.position, pose.orientation, useFixedBase=True))
        except pybullet.error as error:
            raise ValueError(f"model {name!r} must be a URDF that PyBullet loads, got: {error}") from error
    links = tuple(_link(client, body_id, index) for index in range(client.getNumJoints(body_id)))
    forces = [0.0] * len(links)
    client.setJointMotorControlArray(body_id, list(range(len(links))), client.VELOCITY_CONTROL, forces=forces)
    return body_id, links


def _link(client: Client, body_id: int, index: int) -> Link:
    info = client.getJointInfo(body_id, index)
    mass, _, inertia, *frame = client.getDynamicsInfo(body_id, index)[:5]
    return Link(info[12].decode(), info[1].decode(), info[16], mass, Pose(*frame), inertia)


def load_plane(client: Client, spec: BodySpec) -> int:
    """Load the infinite plane z = 0 with the friction and the visual shape of a specification."""
    shape = client.createCollisionShape(client.GEOM_PLANE)
    body_id = client.createMultiBody(0, shape, _visual_shape(client, spec))
    client.changeDynamics(body_id, -1, lateralFriction=spec.friction)
    return int(body_id)


def set_dynamics(client: Client, body_id: int, spec: BodySpec, properties: Properties) -> None:
    """Set frictions, restitution and mass of a body; the inertia changes in proportion to the mass."""
    inertia: dict[str, Any] = {}
    if spec.mass > 0.0:
        moments = [moment * (properties.mass / spec.mass) for moment in spec.mass_properties[1]]
        inertia = {"mass": properties.mass, "localInertiaDiagonal": moments}
    client.changeDynamics(
        body_id,
        -1,
        lateralFriction=properties.friction,
        rollingFriction=properties.rolling_friction,
        spinningFriction=properties.spinning_friction,
        restitution=properties.restitution,
        **inertia,
    )


def _set_base_dynamics(client: Client, body_id: int, spec: BodySpec, damping: float) -> None:
    client.changeDynamics(body_id, -1, linearDamping=damping, angularDamping=damping + spec.angular_damping)
    set_dynamics(client, body_id, spec, Properties.of(spec))


@contextmanager
def _temporary_file(text: str, suffix: str) -> Iterator[str]:
    """Write a text to a file that Bullet reads. A folder would take milliseconds to remove."""
    with tempfile.NamedTemporaryFile("w", prefix="bulletarm_", suffix=suffix) as file:
        file.write(text)
        file.flush()
        yield file.name


def _convert_meshes(xml: str, files: ExitStack) -> str:
    """Return a URDF in which temporary OBJ files replace ASCII STL files, which Bullet does not read."""
    root = fromstring(xml)
    converted: dict[str, str] = {}
    for mesh in root.iter("mesh"):
        name = mesh.get("filename", "")
        if name not in converted and (text := ascii_stl_as_obj(Path(name))):
            converted[name] = files.enter_context(_temporary_file(text, ".obj"))
        mesh.set("filename", converted.get(name, name))
    return urdf.to_text(root) if converted else xml


def _write_urdf(spec: BodySpec, folder: Path) -> str:
    """Return the URDF of a body with moving parts, and write its meshes to a folder."""
    root, is_free = Element("robot", name=spec.name), spec.mass > 0.0
    _add_link(root, BodySpec(BASE, spec.pieces, spec.mass, colour=spec.colour), folder, is_free)
    for part in spec.parts:
        # The frame of a hinge's link has its origin on the axis.
        origin = Pose(part.pivot) if isinstance(part, Hinge) else ORIGIN
        pieces = tuple(Piece(piece.shape, origin.inverse().compose(piece.pose)) for piece in part.pieces)
        _add_link(root, BodySpec(part.name, pieces, part.mass, colour=part.colour), folder, is_free)
        kind = "revolute" if isinstance(part, Hinge) else "prismatic"
        urdf.add_joint(root, kind, part.name, (BASE, part.name), origin, part.axis, part.limits)
    return urdf.to_text(root)


def _add_link(root: Element, spec: BodySpec, folder: Path, is_free: bool) -> None:
    """Add a link with the pieces of a specification."""
    link = SubElement(root, "link", name=spec.name)
    frame, moments = spec.mass_properties  # Bullet reports the pose of the inertial frame of a free body
    rotation = matrix(ORIGIN if is_free else frame)
    tensor = rotation @ (rotation * moments).T
    urdf.add_inertial(link, frame if is_free else Pose(frame.position), spec.mass, tensor.tolist())
    for number, piece in enumerate(spec.pieces):
        path = folder / f"{spec.name}_{number}.obj"
        path.write_text(wavefront([piece]))
        file = {"filename": str(path)}
        urdf.add_geometry(link, "visual", "mesh", file, ORIGIN, spec.colour)
        if isinstance(piece.shape, Box):
            size = {"size": urdf.text_of(piece.shape.extents)}
            urdf.add_geometry(link, "collision", "box", size, piece.pose)
        else:
            urdf.add_geometry(link, "collision", "mesh", file, ORIGIN)


def _collision_shape(client: Client, spec: BodySpec) -> int:
    boxes = [piece.shape for piece in spec.pieces if isinstance(piece.shape, Box)]
    if len(boxes) < len(spec.pieces):
        with _temporary_file(wavefront(spec.pieces), ".obj") as path:
            return int(client.createCollisionShape(client.GEOM_MESH, fileName=path))
    # Boxes collide faster and more stably than the hulls of their corners.
    shape = client.createCollisionShapeArray(
        shapeTypes=[client.GEOM_BOX] * len(boxes),
        halfExtents=[[extent / 2.0 for extent in box.extents] for box in boxes],
        collisionFramePositions=[piece.pose.position for piece in spec.pieces],
        collisionFrameOrientations=[piece.pose.orientation for piece in spec.pieces],
    )
    return int(shape)


def _visual_shape(client: Client, spec: BodySpec) -> int:
    arrays = _mesh_arguments(spec.mesh.vertices[spec.mesh.faces].tobytes())
    return int(client.createVisualShape(client.GEOM_MESH, rgbaColor=spec.colour, **arrays))


@cache
def _mesh_arguments(triangles: bytes) -> dict[str, list[Any]]:
    """Return PyBullet's arguments for float64 triangles (m), cached: PyBullet never releases lists."""
    corners = np.frombuffer(triangles).reshape(-1, 3, 3)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)  # faces may have no area
    vertices = corners.reshape(-1, 3).tolist()
    indices = list(range(len(vertices)))
    return {"vertices": vertices, "indices": indices, "normals": np.repeat(normals, 3, axis=0).tolist()}
