"""Checks of a robot's URDF, and its form for simulation and kinematics."""

import math
from collections.abc import Sequence
from xml.etree.ElementTree import Element

import numpy as np

from bulletarm_gym.geometry import Pose, rotate
from bulletarm_gym.robots.gripper import Gripper
from bulletarm_gym.simulation import urdf

ROTATING, SLIDING = ("revolute", "continuous"), ("prismatic",)
OPPOSITE = -0.99
"""Maximum cosine between the opening directions of the two fingers."""
LIMIT_TOLERANCE = 1e-4
"""Tolerance (m) of the lower and upper limits of a finger."""
ALIGNED = 0.8
"""Minimum cosine between the opening direction of the fingers and the x axis of the tool frame."""
SHAPES = {"box", "cylinder", "sphere", "capsule", "mesh"}
"""Elements of a ``<geometry>`` that Bullet reads for a robot."""


def prepare(root: Element, joints: Sequence[str], gripper: Gripper, tool: Pose) -> None:
    """Check a model, fix the joints that are neither the arm's nor the fingers', and merge fixed links.

    :param joints: names of the arm's joints
    :param tool: tool frame in the link of the last joint
    :raises ValueError: names are not distinct; the joints are not a chain of rotating joints that carries two
        sliding fingers; a shape, limit, coupling or mass is not supported; the fingers do not fit the gripper
        or the tool frame
    """
    for kind in ("link", "joint"):
        names = [element.get("name", "") for element in root.findall(kind)]
        repeated = {name for name in names if names.count(name) > 1}
        _require(not repeated, f"names of {kind}s must be distinct, got {repeated} more than once")
    for link in root.findall("link"):
        unknown = {shape.tag for shape in link.iterfind("*/geometry/*")} - SHAPES
        got = f"{unknown} in link {link.get('name')!r}"
        _require(not unknown, f"<geometry> must be one of {', '.join(sorted(SHAPES))}, got {got}")
    kinds = {**dict.fromkeys(joints, ROTATING), **dict.fromkeys(gripper.joints, SLIDING)}
    for name, allowed in kinds.items():
        _check_joint(urdf.find(root, "joint", name), allowed)
    for joint in root.findall("joint"):
        _check_coupling(joint, joints, gripper.joints)
        if joint.get("name") in kinds:
            _normalize_axis(joint)
        else:
            _fix(joint)
    merge_fixed(root)
    _check_chain(root, joints, gripper.joints)
    _check_fingers([urdf.find(root, "joint", name) for name in gripper.joints], gripper, tool)


def _require(is_valid: bool, message: str) -> None:
    if not is_valid:
        raise ValueError(message)


def _check_joint(joint: Element, kinds: Sequence[str]) -> None:
    kind, name, (lower, upper) = joint.get("type"), joint.get("name"), urdf.limits_of(joint)
    parameter, hint = ("joints", "") if kinds == ROTATING else ("gripper.joints", " Use on_slides().")
    must = f"{parameter} must be {' or '.join(kinds)}"
    _require(kind in kinds, f"{must}, got the {kind} joint {name!r}.{hint}")
    is_limited = kind == "continuous" or -math.inf < lower < upper < math.inf
    got = f"{lower:g} and {upper:g} for the {kind} joint {name!r}"
    _require(is_limited, f"{parameter} must have a <limit> with lower < upper, got {got}")


def _check_coupling(joint: Element, joints: Sequence[str], fingers: Sequence[str]) -> None:
    """Check that no ``<mimic>`` couples a joint to a joint of the arm, or the fingers unequally."""
    mimic, name = joint.find("mimic"), joint.get("name")
    if mimic is None:
        return
    source = mimic.get("joint")
    got = f"{name!r}, which follows {source!r} by <mimic>"
    _require(not {name, source} & {*joints}, f"joints must move independently, got {got}")
    is_equal = abs(urdf.number_of(mimic, "multiplier", "1")) == 1.0 and urdf.number_of(mimic, "offset") == 0.0
    _require(is_equal or not {name, source} <= {*fingers}, f"gripper.joints must move equally, got {got}")


def _fix(joint: Element) -> None:
    """Fix a joint at 0, or at its limit nearest to 0."""
    if joint.get("type") in (*ROTATING, *SLIDING):
        lower, upper = urdf.limits_of(joint)
        urdf.put_origin(joint, urdf.pose_at(joint, min(max(0.0, lower), upper)))
    joint.set("type", "fixed")


def _normalize_axis(joint: Element) -> None:
    """Set the length of the axis to 1, by which Bullet multiplies positions; let fingers open upwards."""
    length, (lower, upper) = math.hypot(*urdf.axis_of(joint)), urdf.limits_of(joint)
    if joint.get("type") in SLIDING and lower < -LIMIT_TOLERANCE and upper < LIMIT_TOLERANCE:
        joint.findall("limit")[0].attrib.update(lower=repr(-upper), upper=repr(-lower))
        length = -length
    urdf.put(joint, "axis", xyz=urdf.text_of([part / length for part in urdf.axis_of(joint)]))


def merge_fixed(root: Element) -> None:
    """Merge links on fixed joints into their parents. Bullet simulates them as slowly as moving links."""
    for joint in root.findall("joint[@type='fixed']"):
        parent, child = (urdf.find(root, "link", urdf.end_of(joint, end)) for end in ("parent", "child"))
        mount = urdf.frame_of(joint)
        _add_mass(parent, child, mount)
        shapes = [*child.findall("visual"), *child.findall("collision")]
        attached = urdf.children_of(root, child.get("name", ""))
        for element in [*shapes, *attached]:
            urdf.put_origin(element, mount.compose(urdf.frame_of(element)))
        parent.extend(shapes)
        for other in attached:
            other.findall("parent")[0].set("link", urdf.end_of(joint, "parent"))
        root.remove(joint)
        root.remove(child)


def _add_mass(link: Element, other: Element, mount: Pose) -> None:
    """Add the mass of another link, 0 without ``<inertial>``, at the common centre of mass."""
    added = other.find("inertial")
    if added is None or urdf.mass_of(other) == 0.0:
        return
    if link.find("inertial") is None:
        urdf.add_inertial(link, Pose((0.0, 0.0, 0.0)), 0.0, np.eye(3).tolist())
    own = link.findall("inertial")[0]
    total = urdf.mass_of(link) + urdf.mass_of(other)
    share = urdf.mass_of(other) / total
    pairs = zip(urdf.frame_of(own).position, mount.transform(urdf.frame_of(added).position), strict=True)
    x, y, z = ((1.0 - share) * first + share * second for first, second in pairs)
    own.findall("mass")[0].set("value", repr(total))
    urdf.put_origin(own, Pose((x, y, z)))


def _check_chain(root: Element, joints: Sequence[str], fingers: Sequence[str]) -> None:
    """Check that the joints form a chain from the base to a link that carries the fingers."""
    last = urdf.find_root(root).get("name", "")
    for name in (*joints, *fingers):
        joint = urdf.find(root, "joint", name)
        parent, link = urdf.end_of(joint, "parent"), urdf.find(root, "link", urdf.end_of(joint, "child"))
        got = f"{name!r}, which is attached to the link {parent!r} instead of {last!r}"
        _require(parent == last, f"joints must be a chain from the base to the gripper, got {got}")
        mass, of = urdf.mass_of(link), f"of link {link.get('name')!r}"
        _require(0.0 < mass < math.inf, f"the mass {of} must be a positive number, got {mass:g}")
        has_shape = name in joints or link.find("collision") is not None
        _require(has_shape, f"fingers must have a <collision> shape, got none {of}")
        last = link.get("name", "") if name in joints else last


def _check_fingers(fingers: Sequence[Element], gripper: Gripper, tool: Pose) -> None:
    """Check that fingers open from 0 over the stroke, in opposite directions along x of the tool frame."""
    for finger in fingers:
        lower, upper = urdf.limits_of(finger)
        is_wide = lower <= LIMIT_TOLERANCE and upper >= gripper.stroke / 2.0 - LIMIT_TOLERANCE
        must = f"move from 0, where the fingers meet, by half the stroke of {gripper.stroke:g} m"
        got = f"{finger.get('name')!r} from {lower:g} to {upper:g} m. Use on_slides() or another stroke."
        _require(is_wide, f"gripper.joints must {must}, got {got}")
    one, other = (rotate(urdf.frame_of(finger).orientation, urdf.axis_of(finger)) for finger in fingers)
    is_opposite = float(np.dot(one, other)) < OPPOSITE
    _require(is_opposite, f"gripper.joints must open in opposite directions, got {gripper.joints}")
    cosine = abs(float(np.dot(rotate(tool.orientation, (1.0, 0.0, 0.0)), one)))
    angle = f"{math.degrees(math.acos(min(cosine, 1.0))):.0f} degrees"
    _require(cosine > ALIGNED, f"tool must have x along the opening direction of the fingers, got {angle}")
