"""Making bodies in Bullet from what they are specified to be."""

import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from bulletarm_gym.geometry import Mesh, Pose
from bulletarm_gym.simulation.client import Client
from bulletarm_gym.simulation.engine import pybullet
from bulletarm_gym.simulation.meshes import is_ascii_stl, stl_corners
from bulletarm_gym.simulation.properties import Properties, set_dynamics
from bulletarm_gym.simulation.shapes import BodySpec, Box, Convex, Piece, flat_normals, wavefront
from bulletarm_gym.simulation.urdf import write_urdf


def load_rigid(client: Client, spec: BodySpec, damping: float) -> int:
    """Load a body in one piece, with its true inertia.

    :param damping: linear and angular
    :return: its id in Bullet
    """
    frame, _ = spec.mass_properties
    body_id = client.createMultiBody(
        spec.mass,
        _collision_shape(client, spec),
        _visual_shape(client, spec),
        baseInertialFramePosition=frame.position,
        baseInertialFrameOrientation=frame.orientation,
    )
    _set_damping(client, body_id, spec, damping)
    set_dynamics(client, body_id, spec, Properties.of(spec))
    return int(body_id)


def load_jointed(client: Client, spec: BodySpec, damping: float) -> int:
    """Load a body with parts that slide or turn; without a mass it is fixed to the world.

    :param damping: linear and angular
    :return: its id in Bullet; its joints are numbered like ``spec.parts``
    """
    free = spec.mass > 0.0
    # A part that only slides in a fixed body does not rotate: its inertia has no effect.
    flags = client.URDF_USE_INERTIA_FROM_FILE if free or spec.hinges else 0
    with tempfile.TemporaryDirectory(prefix="bulletarm_") as folder:
        path = str(write_urdf(spec, Path(folder)))
        body_id = client.loadURDF(path, useFixedBase=not free, flags=flags)
    _set_damping(client, body_id, spec, damping)
    set_dynamics(client, body_id, spec, Properties.of(spec))
    for joint, part in enumerate(spec.parts):
        client.changeDynamics(body_id, joint, lateralFriction=part.friction, jointDamping=0.0)
        client.setJointMotorControl2(
            body_id, joint, client.VELOCITY_CONTROL, targetVelocity=0.0, force=part.resistance
        )
    return int(body_id)


def load_urdf(client: Client, name: str, xml: str, pose: Pose) -> tuple[int, tuple[int, ...]]:
    """Load a body that is fixed to the world from its URDF, its joints free of Bullet's own brakes.

    :param name: of the model, for messages
    :return: its id in Bullet; the indices of its movable joints
    :raises ValueError: Bullet refuses the model
    """
    with ExitStack() as files, _temporary_file(_convert_meshes(xml, files), ".urdf") as path:
        try:
            body_id = int(client.loadURDF(path, pose.position, pose.orientation, useFixedBase=True))
        except pybullet.error as error:
            raise ValueError(f"model {name!r} must be a URDF that PyBullet loads, got: {error}") from error
    infos = [client.getJointInfo(body_id, joint) for joint in range(client.getNumJoints(body_id))]
    joints = tuple(int(info[0]) for info in infos if info[2] != client.JOINT_FIXED)
    client.setJointMotorControlArray(body_id, joints, client.VELOCITY_CONTROL, forces=[0.0] * len(joints))
    return body_id, joints


def _convert_meshes(xml: str, files: ExitStack) -> str:
    """Return a URDF in which temporary OBJ files replace ASCII STL files, which Bullet does not read."""
    if ".stl" not in xml.lower():
        return xml
    root = ElementTree.fromstring(xml)
    converted: dict[str, str] = {}
    for mesh in root.iter("mesh"):
        name = mesh.get("filename", "")
        if name not in converted and is_ascii_stl(Path(name)):
            corners = stl_corners(Path(name))
            faces = np.arange(len(corners)).reshape(-1, 3)
            text = wavefront([Piece(Convex(Mesh.of(corners, faces)))])
            converted[name] = files.enter_context(_temporary_file(text, ".obj"))
        mesh.set("filename", converted.get(name, name))
    return ElementTree.tostring(root, encoding="unicode") if converted else xml


def load_plane(client: Client, spec: BodySpec) -> int:
    """Load the endless plane z = 0; ``spec`` gives its friction and picture."""
    shape = client.createCollisionShape(client.GEOM_PLANE)
    body_id = client.createMultiBody(0, shape, _visual_shape(client, spec))
    client.changeDynamics(body_id, -1, lateralFriction=spec.friction)
    return int(body_id)


@contextmanager
def _temporary_file(text: str, suffix: str) -> Iterator[str]:
    """Hold a text in a file, as Bullet reads meshes and models. (Removing a folder, too, takes milliseconds.)

    :param suffix: of the file's name, which Bullet tells the format by
    :return: a context of the file's path
    """
    with tempfile.NamedTemporaryFile("w", prefix="bulletarm_", suffix=suffix) as file:
        file.write(text)
        file.flush()
        yield file.name


def _set_damping(client: Client, body_id: int, spec: BodySpec, damping: float) -> None:
    client.changeDynamics(body_id, -1, linearDamping=damping, angularDamping=damping + spec.angular_damping)


def _collision_shape(client: Client, spec: BodySpec) -> int:
    piece = spec.pieces[0]
    if len(spec.pieces) == 1 and isinstance(piece.shape, Box):
        return int(
            client.createCollisionShape(
                client.GEOM_BOX,
                halfExtents=[extent / 2.0 for extent in piece.shape.extents],
                collisionFramePosition=piece.pose.position,
                collisionFrameOrientation=piece.pose.orientation,
            )
        )
    if all(isinstance(piece.shape, Box) for piece in spec.pieces):
        return int(_box_compound(client, spec))
    with _temporary_file(wavefront(spec.pieces), ".obj") as path:
        return int(client.createCollisionShape(client.GEOM_MESH, fileName=path))


def _box_compound(client: Client, spec: BodySpec) -> int:
    """Boxes collide quicker and steadier as boxes than as hulls of their corners."""
    boxes = [piece.shape for piece in spec.pieces if isinstance(piece.shape, Box)]
    shape: int = client.createCollisionShapeArray(
        shapeTypes=[client.GEOM_BOX] * len(boxes),
        halfExtents=[[extent / 2.0 for extent in box.extents] for box in boxes],
        collisionFramePositions=[piece.pose.position for piece in spec.pieces],
        collisionFrameOrientations=[piece.pose.orientation for piece in spec.pieces],
    )
    return shape


def _visual_shape(client: Client, spec: BodySpec) -> int:
    mesh = spec.mesh
    arrays = _mesh_arguments(mesh.vertices[mesh.faces].tobytes())
    return int(client.createVisualShape(client.GEOM_MESH, rgbaColor=spec.colour, **arrays))


@cache
def _mesh_arguments(triangles: bytes) -> dict[str, list[Any]]:
    """Return what PyBullet takes for float64 triangles (m), the same lists whenever it is asked for them.

    PyBullet never lets go of the lists that it is given (their reference counts stay raised): those of every
    body would stay in memory after their environment is closed.
    """
    corners = np.frombuffer(triangles).reshape(-1, 3)
    normals = flat_normals(corners.reshape(-1, 3, 3))
    return {"vertices": corners.tolist(), "indices": list(range(len(corners))), "normals": normals}
