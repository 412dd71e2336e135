"""Checks of a robot's URDF, and the form of it that simulation and kinematics share."""

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from xml.etree.ElementTree import Element, SubElement

from bulletarm_gym.geometry import Pose, Vector, rotate
from bulletarm_gym.robots.kinematics import axis_of, find_joint, frame_of, limits_of, number_of
from bulletarm_gym.robots.urdf import end_of, find_link, mass_of, pose_at, put_origin

ROTATING = ("revolute", "continuous")
UNIT_TOLERANCE = 1e-9
"""Deviation of the length of an axis from 1 up to which it is left as it is."""
OPPOSITE = -0.99
"""Maximum cosine between the directions in which the two fingers open."""
LIMIT_TOLERANCE = 1e-4
"""Tolerance (m) of the comparison between a finger's lower limit and 0."""
ALIGNED = 0.8
"""Minimum cosine between the opening direction of the fingers and the x axis of the tool frame."""
SHAPES = ("box", "cylinder", "sphere", "capsule", "mesh")
"""Elements of a ``<geometry>`` that Bullet reads for a robot."""


def prepare(root: Element, joints: Sequence[str], fingers: Sequence[str]) -> None:
    """Check the structure of a model and fix the joints that are neither the arm's nor the fingers'.

    :raises ValueError: the model is not a tree of links with distinct names; a joint is missing, of a type
        that is not supported, without limits or coupled to another joint; Bullet does not read a shape
    """
    check_tree(root)
    _check_shapes(root)
    for parameter, names, kinds in (
        ("joints", joints, ROTATING),
        ("gripper.joints", fingers, ("prismatic",)),
    ):
        for name in names:
            check_kind(parameter, find_joint(root, name), kinds)
            _check_limits(parameter, find_joint(root, name))
    for joint in root.findall("joint"):
        _check_coupling(joint, joints, fingers)
    for joint in root.findall("joint"):
        if joint.get("name") not in {*joints, *fingers}:
            fix(joint)
        else:
            _normalize_axis(joint)
    for name in fingers:
        _open_upwards(find_joint(root, name))


def check_kind(parameter: str, joint: Element, kinds: Sequence[str]) -> None:
    """Check the type of a joint.

    :raises ValueError: it is another one
    """
    if joint.get("type") not in kinds:
        hint = " Use on_slides()." if "prismatic" in kinds else " An omitted joint is fixed."
        raise ValueError(
            f"{parameter} must be {' or '.join(kinds)}, got the {joint.get('type')} joint "
            f"{joint.get('name')!r}.{hint}"
        )


def _check_limits(parameter: str, joint: Element) -> None:
    lower, upper = limits_of(joint)
    if joint.get("type") == "continuous" or -math.inf < lower < upper < math.inf:
        return
    got = "no <limit>" if joint.find("limit") is None else f"{lower:g} and {upper:g}"
    hint = " Use the type continuous for a joint without limits." if joint.get("type") == "revolute" else ""
    raise ValueError(
        f"{parameter} must have a <limit> with lower < upper, got {got} for {joint.get('name')!r}.{hint}"
    )


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
                raise ValueError(
                    f"<geometry> must hold one of {', '.join(SHAPES)}, "
                    f"got {', '.join(found) or 'nothing'} in link {link.get('name')!r}"
                )


def check_tree(root: Element) -> None:
    """Check that a model is a tree of links with distinct names.

    :raises ValueError: it is not
    """
    for kind in ("link", "joint"):
        repeated = _repeated(element.get("name", "") for element in root.findall(kind))
        if repeated:
            raise ValueError(f"names of {kind}s must be distinct, got {', '.join(map(repr, repeated))} twice")
    for joint in root.findall("joint"):
        for end in ("parent", "child"):
            find_link(root, end_of(joint, end))
    repeated = _repeated(end_of(joint, "child") for joint in root.findall("joint"))
    if repeated:
        raise ValueError(f"each link must have one parent, got several for {', '.join(map(repr, repeated))}")
    find_root(root)


def _repeated(names: Iterable[str]) -> list[str]:
    return [name for name, count in Counter(names).items() if count > 1]


def find_root(root: Element) -> Element:
    """Return the link that is no joint's child.

    :raises ValueError: there is none or more than one
    """
    children = {end_of(joint, "child") for joint in root.findall("joint")}
    found = [link for link in root.findall("link") if link.get("name") not in children]
    if len(found) != 1:
        names = ", ".join(repr(link.get("name")) for link in found) or "none"
        raise ValueError(f"a model must have one root link, got {names}")
    return found[0]


def fix(joint: Element) -> None:
    """Fix a joint at 0, or at its limit nearest to 0."""
    kind = joint.get("type")
    if kind == "fixed":
        return
    if kind in (*ROTATING, "prismatic"):
        lower, upper = limits_of(joint)
        put_origin(joint, pose_at(joint, min(max(0.0, lower), upper)))
    joint.set("type", "fixed")
    for tag in ("axis", "limit", "mimic", "dynamics"):
        for element in joint.findall(tag):
            joint.remove(element)


def _normalize_axis(joint: Element) -> None:
    """Give an axis the length of 1: Bullet multiplies the position of a prismatic joint by the length."""
    axis = axis_of(joint)
    length = math.hypot(*axis)
    if length == 0.0:
        raise ValueError(f"the axis of joint {joint.get('name')!r} must have a length, got 0 0 0")
    if abs(length - 1.0) > UNIT_TOLERANCE:
        _set_axis(joint, (axis[0] / length, axis[1] / length, axis[2] / length))


def _open_upwards(finger: Element) -> None:
    """Reverse the axis of a finger whose joint opens to negative positions."""
    limit = finger.find("limit")
    lower, upper = limits_of(finger)
    if limit is not None and lower < -LIMIT_TOLERANCE and upper < LIMIT_TOLERANCE:
        limit.set("lower", repr(-upper))
        limit.set("upper", repr(-lower))
        x, y, z = axis_of(finger)
        _set_axis(finger, (-x, -y, -z))


def _set_axis(joint: Element, axis: Vector) -> None:
    for old in joint.findall("axis"):
        joint.remove(old)
    SubElement(joint, "axis", xyz=" ".join(map(repr, axis)))


def check_chain(root: Element, joints: Sequence[str], fingers: Sequence[str]) -> None:
    """Check that the joints of a model without fixed joints form a chain that carries the fingers.

    :raises ValueError: they do not
    """
    link = find_root(root).get("name", "")
    for name in joints:
        joint = find_joint(root, name)
        if end_of(joint, "parent") != link:
            raise ValueError(
                f"joints must be a chain from the base to the gripper, got {name!r}, which is attached to "
                f"the link {end_of(joint, 'parent')!r} instead of {link!r}"
            )
        link = end_of(joint, "child")
    for name in fingers:
        parent = end_of(find_joint(root, name), "parent")
        if parent != link:
            raise ValueError(
                f"gripper.joints must be attached to the link {link!r} of the last joint, got {name!r}, "
                f"which is attached to {parent!r}"
            )
    for name in fingers:
        child = end_of(find_joint(root, name), "child")
        if find_link(root, child).find("collision") is None:
            raise ValueError(f"fingers must have a collision shape, got none for link {child!r}")
    _check_fingers([find_joint(root, name) for name in fingers])


def check_opening(root: Element, finger: str, tool: Pose) -> None:
    """Check that a finger opens along the x axis of the tool frame.

    :param tool: tool frame in the link that carries the finger
    :raises ValueError: it opens in another direction
    """
    axis, opening = rotate(tool.orientation, (1.0, 0.0, 0.0)), _direction(find_joint(root, finger))
    cosine = abs(sum(a * b for a, b in zip(axis, opening, strict=True)))
    if cosine < ALIGNED:
        raise ValueError(
            "tool must have its x axis along the opening direction of the fingers, got an angle of "
            f"{math.degrees(math.acos(cosine)):.0f} degrees. Rotate it about its z axis."
        )


def check_masses(root: Element) -> None:
    """Check the masses of the links that joints move.

    :raises ValueError: one is 0 or negative: Bullet gives 1 kg to a link without ``<inertial>``
    """
    for joint in root.findall("joint"):
        link = find_link(root, end_of(joint, "child"))
        mass = mass_of(link)
        if not 0.0 < mass < math.inf:
            got = f"{mass:g}" if link.find("inertial/mass") is not None else "no <inertial>"
            raise ValueError(f"the mass of link {link.get('name')!r} must be a positive number, got {got}")


def _check_fingers(fingers: Sequence[Element]) -> None:
    for finger in fingers:
        lower, _ = limits_of(finger)
        if lower > LIMIT_TOLERANCE:
            raise ValueError(
                f"gripper.joints must reach 0, where the fingers meet, got {finger.get('name')!r} with the "
                f"lower limit {lower:g} m. Use on_slides()."
            )
    one, other = (_direction(finger) for finger in fingers)
    if sum(a * b for a, b in zip(one, other, strict=True)) > OPPOSITE:
        names = " and ".join(repr(finger.get("name")) for finger in fingers)
        raise ValueError(f"gripper.joints must open in opposite directions, got {names}")


def _direction(finger: Element) -> Vector:
    """Return the unit vector in the carrier along which a finger opens."""
    x, y, z = axis_of(finger)
    return rotate(frame_of(finger).orientation, (x, y, z))
