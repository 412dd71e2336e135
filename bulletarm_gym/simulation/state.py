"""Bodies of a world, their physical properties, and the state of the world in plain numbers."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from bulletarm_gym.config_checks import check_fields, colour
from bulletarm_gym.geometry import FloatArray, Pose, Vector
from bulletarm_gym.simulation.shapes import FRICTIONS, BodySpec, Colour, amounts

Twist = tuple[Vector, Vector]
"""Linear (m/s) and angular (rad/s) velocity."""
STILL: Twist = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
REST_RADIUS = 0.05
"""Distance (m) from the centre of mass at which the angular velocity of a body counts as speed."""
REST_SPEED = 0.01
"""Maximum speed (m/s) of a body at rest. Gravity adds four times as much in one simulation step."""


@dataclass(frozen=True)
class Physics:
    """Accuracy of the contact solver.

    :param solver_iterations: iterations of Bullet's constraint solver in each simulation step
    :param damping: linear and angular damping of free bodies
    :param pace: duration of an arm motion relative to the shortest one
    """

    solver_iterations: int
    damping: float
    pace: float


PHYSICS_MODES = {"fast": Physics(50, 0.0, 1.0), "slow": Physics(200, 0.04, 2.0)}
"""Values of the parameter ``physics_mode`` (the two physics modes of the paper)."""


@dataclass(frozen=True)
class Optics:
    """Light of rendered images and calibration error of all cameras.

    :param position: error (m) of the position of each camera, in its own frame
    :param rotation: rotation vector (rad) of the error, in the frame of the camera
    :param light: change of the direction to the light (world)
    :param brightness: factor on the brightness of the light
    """

    position: tuple[float, ...] = (0.0, 0.0, 0.0)
    rotation: tuple[float, ...] = (0.0, 0.0, 0.0)
    light: tuple[float, ...] = (0.0, 0.0, 0.0)
    brightness: float = 1.0

    @cached_property
    def camera_error(self) -> FloatArray:
        """Transformation (4, 4) from nominal to actual camera coordinates (m)."""
        error = np.eye(4)
        error[:3, :3] = Rotation.from_rotvec(self.rotation).as_matrix()
        error[:3, 3] = self.position
        return np.asarray(np.linalg.inv(error), np.float64)


NOMINAL = Optics()
"""Light and cameras without an error."""


class Link(NamedTuple):
    """A link of a body loaded from URDF, with the joint that moves it.

    :param joint: name of the joint
    :param parent: index of the parent link, -1 for the base
    :param mass: kg
    :param frame: principal axes of inertia at the centre of mass, in the frame of the joint
    :param inertia: moments of inertia (kg m^2) about these axes
    """

    name: str
    joint: str
    parent: int
    mass: float
    frame: Pose
    inertia: Vector


@dataclass(frozen=True)
class Body:
    """Reference to a body of a world.

    :param index: position in the world's order and in :class:`WorldState`
    :param id: number of the body in Bullet
    :param joints: indices of the movable joints in Bullet
    :param links: links of a body loaded from a URDF; index i is moved by joint i
    """

    index: int
    id: int
    spec: BodySpec
    joints: tuple[int, ...] = ()
    links: tuple[Link, ...] = ()


class Contact(NamedTuple):
    """A point where a body touches another body or is close to it.

    :param link: index of the body's link in Bullet, -1 for the base
    :param other: the other body
    :param normal: unit vector from the other body to this body, world
    :param distance: gap (m) along the normal, negative if the bodies overlap
    :param force: normal force (N) in the last simulation step
    """

    link: int
    other: Body
    normal: Vector
    distance: float
    force: float


@dataclass(frozen=True)
class Properties:
    """Physical properties of a body that a task may change at a reset.

    :param mass: kg; 0 for a fixed body
    :param friction: lateral friction coefficient
    :param rolling_friction: coefficient against rolling (m)
    :param spinning_friction: coefficient against spinning in place (m)
    :param restitution: maximum ratio of the speeds after and before an impact
    :param colour: red, green, blue and opacity, 0 to 1
    :raises ValueError: a value is not a number or out of range
    """

    mass: float
    friction: float
    rolling_friction: float
    spinning_friction: float
    restitution: float
    colour: Colour

    def __post_init__(self) -> None:
        check_fields(self, {**amounts("mass", *FRICTIONS, "restitution"), "colour": colour})

    @classmethod
    def of(cls, spec: BodySpec) -> "Properties":
        """Return the properties that a body is loaded with."""
        frictions = (spec.friction, spec.rolling_friction, spec.spinning_friction)
        return cls(spec.mass, *frictions, 0.0, spec.colour)


@dataclass(frozen=True)
class WorldState:
    """State of a world, which determines all later states.

    :param poses: pose of every body's frame
    :param twists: linear (m/s) and angular (rad/s) velocity of every body
    :param active: whether a body is in the scene or parked
    :param joints: positions (m or rad) of every body's movable joints
    :param joint_rates: velocities (m/s or rad/s) of these joints
    :param unsettled: indices of bodies that are not at rest yet after a placement or the loss of support
    :param properties: index and properties of each body whose properties differ from its specification
    """

    poses: tuple[Pose, ...]
    twists: tuple[Twist, ...]
    active: tuple[bool, ...]
    joints: tuple[tuple[float, ...], ...]
    joint_rates: tuple[tuple[float, ...], ...]
    unsettled: tuple[int, ...]
    properties: tuple[tuple[int, Properties], ...]


def surface_speed(linear: Vector, angular: Vector) -> float:
    """Return the maximum speed (m/s) of a body's surface from its velocities (m/s and rad/s)."""
    return math.hypot(*linear) + REST_RADIUS * math.hypot(*angular)
