"""Checks of a robot's URDF, and its form for simulation and kinematics."""

import math
from collections.abc import Sequence
from xml.etree.ElementTree import Element

from bulletarm_gym.geometry import Pose, Vector, rotate
from bulletarm_gym.robots.editing import check_tree
from bulletarm_gym.robots.gripper import Gripper
from bulletarm_gym.simulation.urdf import (
    axis_of,
    end_of,
    find_joint,
    find_link,
    find_root,
    frame_of,
    limits_of,
    mass_of,
    number_of,
    pose_at,
    put,
    put_origin,
    text_of,
)

ROTATING = ("revolute", "continuous")
UNIT_TOLERANCE = 1e-9
"""Maximum deviation of the length of an axis from 1 without a change."""
OPPOSITE = -0.99
"""Maximum cosine between the opening directions of the two fingers."""
LIMIT_TOLERANCE = 1e-4
"""Tolerance (m) of the lower and upper limits of a finger."""
ALIGNED = 0.8
"""Minimum cosine between the opening direction of the fingers and the x axis of the tool frame."""
SHAPES = ("box", "cylinder", "sphere", "capsule", "mesh")
"""Elements of a ``<geometry>`` that Bullet reads for a robot."""


def prepare(root: Element, joints: Sequence[str], fingers: Sequence[str]) -> None:
    """Check the structure of a model and fix the joints that are neither the arm's nor the fingers'.

    :raises ValueError: the model is not a tree of links with distinct names; a joint is missing, without
        limits, coupled to another joint or of a type that is not supported; Bullet does not read a shape
    """
    check_tree(root)
    _check_shapes(root)
    for name in joints:
        _check_joint("joints", find_joint(root, name), ROTATING)
    for name in fingers:
        _check_joint("gripper.joints", find_joint(root, name), ("prismatic",))
    for joint in root.findall("joint"):
        _check_coupling(joint, joints, fingers)
    for joint in root.findall("joint"):
        if joint.get("name") not in {*joints, *fingers}:
            _fix(joint)
        else:
            _normalize_axis(joint)
    for name in fingers:
        _open_upwards(find_joint(root, name))


def _check_joint(parameter: str, joint: Element, kinds: Sequence[str]) -> None:
    """Check the type and the limits of a joint."""
    kind, name = joint.get("type"), joint.get("name")
    if kind not in kinds:
        hint = "Use on_slides()." if "prismatic" in kinds else "An omitted joint is fixed."
        must = " or ".join(kinds)
        raise ValueError(f"{parameter} must be {must}, got the {kind} joint {name!r}. {hint}")
    lower, upper = limits_of(joint)
    if kind != "continuous" and not -math.inf < lower < upper < math.inf:
        got = "no <limit>" if joint.find("limit") is None else f"{lower:g} and {upper:g}"
        hint = " Use the type continuous for a joint without limits." if kind == "revolute" else ""
        raise ValueError(f"{parameter} must have a <limit> with lower < upper, got {got} for {name!r}.{hint}")


def _check_coupling(joint: Element, joints: Sequence[str], fingers: Sequence[str]) -> None:
    """Check that no ``<mimic>`` couples a joint to a joint of the arm, or the fingers unequally."""
    mimic, name = joint.find("mimic"), joint.get("name")
    if mimic is None:
        return
    source = mimic.get("joint")
    if name in joints or source in joints:
        raise ValueError(
            f"joints must move independently, got {name!r}, which follows {source!r} by <mimic>. "
            "Couplings of arm joints are not simulated."
        )
    multiplier, offset = number_of(mimic, "multiplier", "1"), number_of(mimic, "offset")
    if name in fingers and source in fingers and (abs(multiplier) != 1.0 or offset != 0.0):
        raise ValueError(
            f"gripper.joints must move equally, got {name!r}, which follows {source!r} with the multiplier "
            f"{multiplier:g} and the offset {offset:g}"
        )


def _check_shapes(root: Element) -> None:
    for link in root.findall("link"):
        for geometry in link.iterfind("*/geometry"):
            found = [shape.tag for shape in geometry]
            if len(found) != 1 or found[0] not in SHAPES:
                got = f"{', '.join(found) or 'nothing'} in link {link.get('name')!r}"
                raise ValueError(f"<geometry> must hold one of {', '.join(SHAPES)}, got {got}")


def _fix(joint: Element) -> None:
    """Fix a joint at 0, or at its limit nearest to 0."""
    if joint.get("type") in (*ROTATING, "prismatic"):
        lower, upper = limits_of(joint)
        put_origin(joint, pose_at(joint, min(max(0.0, lower), upper)))
    joint.set("type", "fixed")


def _normalize_axis(joint: Element) -> None:
    """Set the length of an axis to 1. Bullet multiplies the position of a prismatic joint by the length."""
    axis = axis_of(joint)
    length = math.hypot(*axis)
    if length == 0.0:
        raise ValueError(f"the axis of joint {joint.get('name')!r} must have a length, got 0 0 0")
    if abs(length - 1.0) > UNIT_TOLERANCE:
        put(joint, "axis", xyz=text_of([part / length for part in axis]))


def _open_upwards(finger: Element) -> None:
    """Reverse the axis of a finger that opens to negative positions."""
    lower, upper = limits_of(finger)
    if lower < -LIMIT_TOLERANCE and upper < LIMIT_TOLERANCE:
        finger.findall("limit")[0].attrib.update(lower=repr(-upper), upper=repr(-lower))
        put(finger, "axis", xyz=text_of([-part for part in axis_of(finger)]))


def check_merged(root: Element, joints: Sequence[str], gripper: Gripper, tool: Pose) -> None:
    """Check a model without fixed joints.

    :param tool: tool frame in the link of the last joint
    :raises ValueError: the joints are not a chain that carries the fingers, a moving link has no mass, or the
        fingers do not fit the gripper or the tool frame
    """
    _check_chain(root, joints, gripper.joints)
    for joint in root.findall("joint"):
        link = find_link(root, end_of(joint, "child"))
        if not 0.0 < mass_of(link) < math.inf:
            got = f"{mass_of(link):g}" if link.find("inertial/mass") is not None else "no <inertial>"
            raise ValueError(f"the mass of link {link.get('name')!r} must be a positive number, got {got}")
    _check_fingers([find_joint(root, name) for name in gripper.joints], gripper, tool)


def _check_chain(root: Element, joints: Sequence[str], fingers: Sequence[str]) -> None:
    """Check that the joints form a chain from the base to a link that carries the fingers."""
    link = find_root(root).get("name", "")
    for name in joints:
        joint = find_joint(root, name)
        if (parent := end_of(joint, "parent")) != link:
            raise ValueError(
                f"joints must be a chain from the base to the gripper, got {name!r}, which is attached to "
                f"the link {parent!r} instead of {link!r}"
            )
        link = end_of(joint, "child")
    for name in fingers:
        finger = find_joint(root, name)
        if (parent := end_of(finger, "parent")) != link:
            raise ValueError(
                f"gripper.joints must be attached to the link {link!r} of the last joint, got {name!r}, "
                f"which is attached to {parent!r}"
            )
        child = end_of(finger, "child")
        if find_link(root, child).find("collision") is None:
            raise ValueError(f"fingers must have a collision shape, got none for link {child!r}")


def _check_fingers(fingers: Sequence[Element], gripper: Gripper, tool: Pose) -> None:
    """Check that fingers open from 0 over the stroke, in opposite directions along x of the tool frame."""
    for finger in fingers:
        name, (lower, upper) = finger.get("name"), limits_of(finger)
        if lower > LIMIT_TOLERANCE:
            raise ValueError(
                f"gripper.joints must reach 0, where the fingers meet, got {name!r} with the lower limit "
                f"{lower:g} m. Use on_slides()."
            )
        if upper < gripper.travel - LIMIT_TOLERANCE:
            raise ValueError(
                f"the limits of {name!r} must allow a stroke of {gripper.stroke:g} m, got {upper:g} m for "
                f"a travel of {gripper.travel:g} m"
            )
    one, other = (rotate(frame_of(finger).orientation, axis_of(finger)) for finger in fingers)
    if _cosine(one, other) > OPPOSITE:
        names = " and ".join(repr(finger.get("name")) for finger in fingers)
        raise ValueError(f"gripper.joints must open in opposite directions, got {names}")
    cosine = abs(_cosine(rotate(tool.orientation, (1.0, 0.0, 0.0)), one))
    if cosine < ALIGNED:
        raise ValueError(
            "tool must have its x axis along the opening direction of the fingers, got an angle of "
            f"{math.degrees(math.acos(cosine)):.0f} degrees. Rotate it about its z axis."
        )


def _cosine(one: Vector, other: Vector) -> float:
    """Return the cosine of the angle between unit vectors."""
    return sum(a * b for a, b in zip(one, other, strict=True))
