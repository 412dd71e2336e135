"""Universal Robots UR5 of primitives, with a parallel jaw or with a Robotiq 2F-85.

Joint frames and masses are those Universal Robots publishes (DH parameters of the UR5); the shapes are ours.
"""

import math
from dataclasses import dataclass, replace
from functools import partial
from xml.etree.ElementTree import Element, SubElement

from bulletarm_gym.geometry import Pose, Vector, euler_pose
from bulletarm_gym.robots.gripper import ParallelJaw
from bulletarm_gym.robots.model import RobotModel
from bulletarm_gym.robots.urdf import DARK, Colour, Part, add_joint, add_link, box, cylinder

SILVER: Colour = (0.72, 0.74, 0.76)
BLUE: Colour = (0.36, 0.62, 0.82)
BLACK: Colour = (0.16, 0.16, 0.17)
GREY: Colour = (0.45, 0.46, 0.48)
QUARTER = math.pi / 2.0
LIMIT = 2.0 * math.pi
"""Joint limit (rad) in both directions (UR5 data sheet)."""
MAX_SPEED = math.pi
"""Maximum joint speed (rad/s; UR5 data sheet)."""
TORQUES = (150.0, 150.0, 150.0, 28.0, 28.0, 28.0)
"""Maximum torque (N m) of each joint (Universal Robots, "Max. joint torques")."""
Y_AXIS, Z_AXIS = (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
ALONG_X = (0.0, QUARTER, 0.0)
"""Turns z onto x: the upper arm and the forearm lie along z of their links, level when all joints are 0."""


@dataclass(frozen=True)
class Segment:
    """A link and the joint that carries it.

    :param origin: of the joint in the link before
    :param axis: of the joint
    :param mass: kg
    """

    name: str
    origin: Pose
    axis: Vector
    mass: float
    parts: tuple[Part, ...]


def _joint_housing(radius: float, length: float, height: float, cap: float) -> tuple[Part, ...]:
    """Return the drum about a joint along y at a height of its link, and its blue cap at y = ``cap`` (m)."""
    return (
        cylinder(radius, length, (0.0, 0.0, height), SILVER, "y"),
        cylinder(0.92 * radius, 0.012, (0.0, cap, height), BLUE, "y", solid=False),
    )


SEGMENTS = (
    Segment(
        "shoulder",
        Pose((0.0, 0.0, 0.0892)),
        Z_AXIS,
        3.7,
        (
            cylinder(0.06, 0.13, (0.0, 0.0, 0.0), SILVER),
            cylinder(0.058, 0.08, (0.0, 0.04, 0.0), SILVER, "y", solid=False),
            cylinder(0.056, 0.012, (0.0, 0.0, 0.068), BLUE, solid=False),
        ),
    ),
    Segment(
        "upper_arm",
        euler_pose((0.0, 0.1359, 0.0), ALONG_X),
        Y_AXIS,
        8.393,
        (
            cylinder(0.047, 0.425, (0.0, 0.0, 0.2125), SILVER),
            *_joint_housing(0.06, 0.12, 0.0, 0.064),
            *_joint_housing(0.056, 0.115, 0.425, 0.061),
        ),
    ),
    Segment(
        "forearm",
        Pose((0.0, -0.1197, 0.425)),
        Y_AXIS,
        2.33,
        (
            cylinder(0.038, 0.3923, (0.0, 0.0, 0.19615), SILVER),
            *_joint_housing(0.05, 0.115, 0.0, -0.061),
            *_joint_housing(0.04, 0.085, 0.3923, -0.046),
        ),
    ),
    Segment(
        "wrist_1",
        euler_pose((0.0, 0.0, 0.3923), ALONG_X),
        Y_AXIS,
        1.219,
        (
            cylinder(0.0375, 0.09, (0.0, 0.09, 0.0), SILVER),
            cylinder(0.0375, 0.06, (0.0, 0.062, 0.0), SILVER, "y", solid=False),
            cylinder(0.035, 0.01, (0.0, 0.09, -0.05), BLUE, solid=False),
        ),
    ),
    Segment(
        "wrist_2",
        Pose((0.0, 0.093, 0.0)),
        Z_AXIS,
        1.219,
        (
            cylinder(0.0375, 0.09, (0.0, 0.0, 0.0947), SILVER, "y"),
            cylinder(0.0375, 0.04, (0.0, 0.0, 0.062), SILVER, solid=False),
            cylinder(0.035, 0.01, (0.0, -0.05, 0.0947), BLUE, "y", solid=False),
        ),
    ),
    Segment(
        "wrist_3",
        Pose((0.0, 0.0, 0.0947)),
        Y_AXIS,
        0.1879,
        (cylinder(0.0375, 0.034, (0.0, 0.0653, 0.0), DARK, "y"),),
    ),
)


def arm() -> Element:
    """Return the model of the bare arm."""
    root = Element("robot", name="ur5")
    foot = cylinder(0.075, 0.03, (0.0, 0.0, 0.015), BLACK)
    add_link(root, "base", 4.0, (foot,))
    parent = "base"
    for segment, torque in zip(SEGMENTS, TORQUES, strict=True):
        add_link(root, segment.name, segment.mass, segment.parts)
        links = (parent, segment.name)
        joint = add_joint(root, "revolute", f"{segment.name}_joint", links, segment.origin, segment.axis)
        limits = {"lower": -LIMIT, "upper": LIMIT, "effort": torque, "velocity": MAX_SPEED}
        SubElement(joint, "limit", {key: repr(value) for key, value in limits.items()})
        parent = segment.name
    return root


FLANGE = euler_pose((0.0, 0.0823, 0.0), (-QUARTER, 0.0, 0.0))
"""In the last link, whose y axis is the approach."""
JAW = ParallelJaw(stroke=0.075, palm=(0.11, 0.05, 0.055), finger=(0.005, 0.025, 0.06))
ROBOTIQ_2F85 = ParallelJaw(
    stroke=0.085,
    palm=(0.07, 0.05, 0.08),
    finger=(0.012, 0.022, 0.07),
    colour=BLACK,
    housing=(
        cylinder(0.0375, 0.02, (0.0, 0.0, 0.01), GREY, solid=False),
        cylinder(0.037, 0.045, (0.0, 0.0, 0.0425), BLACK, solid=False),
        box((0.086, 0.036, 0.03), (0.0, 0.0, 0.063), DARK, solid=False),
    ),
    trim=(
        box((0.011, 0.028, 0.066), (0.008, 0.0, 0.002), GREY, tilt=0.6, solid=False),
        box((0.012, 0.024, 0.042), (0.0185, 0.0, 0.034), BLACK, tilt=-0.4, solid=False),
        box((0.004, 0.0226, 0.036), (0.0021, 0.0, 0.0525), GREY, solid=False),
    ),
)
"""Stroke as in the data sheet of the 2F-85; the fingers run on slides instead of its linkage, for what a
linkage of position-driven joints grasps it does not hold."""
OFFSET = 0.25
"""Angle (rad) by which the shoulder turns past the fingertips: the wrist runs 0.109 m beside its middle."""
LIFT, ELBOW = -1.3, 1.9

UR5 = RobotModel(
    name="ur5",
    load=partial(JAW.fitted, arm, "wrist_3", FLANGE),
    joints=tuple(f"{segment.name}_joint" for segment in SEGMENTS),
    tool=JAW.tool(FLANGE),
    gripper=JAW,
    base=Pose((-0.08, 0.0, 0.2)),
    posture=(-OFFSET, LIFT, ELBOW, -QUARTER - LIFT - ELBOW, -QUARTER, -QUARTER - OFFSET),
    force=TORQUES,
)

UR5_ROBOTIQ = replace(
    UR5,
    name="ur5_robotiq",
    load=partial(ROBOTIQ_2F85.fitted, arm, "wrist_3", FLANGE),
    tool=ROBOTIQ_2F85.tool(FLANGE),
    gripper=ROBOTIQ_2F85,
)
