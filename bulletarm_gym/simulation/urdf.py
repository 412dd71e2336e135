"""Reading and writing of URDF elements."""

import math
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, ParseError, SubElement
from xml.parsers import expat

from scipy.spatial.transform import Rotation

from bulletarm_gym.geometry import Pose, Vector, euler_angles, euler_pose
from bulletarm_gym.simulation.shapes import check_mesh

PACKAGE, FILE = "package://", "file://"
"""Prefixes of file names in ROS: of a file in a package, and of any file."""


def _parse_xml(path: Path) -> Element:
    """Return the root element of an XML file. Prefixes stay part of names and need no declaration."""
    builder = ElementTree.TreeBuilder()
    parser = expat.ParserCreate()
    parser.buffer_text = True
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    try:
        parser.Parse(path.read_bytes().lstrip(), True)
    except (expat.ExpatError, ValueError) as error:  # ValueError: an encoding that is not supported
        raise ParseError(str(error)) from error
    return builder.close()


def parse_urdf(path: Path) -> Element:
    """Return the root element of a URDF without the extensions of other programs, or raise ValueError."""
    must = f"model must be a URDF file, got {path}, "
    try:
        root = _parse_xml(path)
    except ParseError as error:
        raise ValueError(f"{must}which is not XML: {error}") from error
    if any(element.tag.startswith("xacro:") for element in root.iter()):
        raise ValueError(f"{must}a xacro file. Run `xacro FILE > robot.urdf`.")
    if root.tag != "robot":
        raise ValueError(f"{must}whose root element is <{root.tag}>. Convert it to URDF.")
    if any("quat_xyzw" in element.attrib for element in root.iter("origin")):
        raise ValueError(f"origins must have rpy angles, got quat_xyzw of URDF 1.1 in {path}")
    for element in list(root.iter()):
        element.attrib = {name: value for name, value in element.attrib.items() if ":" not in name}
        element[:] = [child for child in element if ":" not in child.tag]
    _check_cycles(root)
    return root


def _check_cycles(root: Element) -> None:
    """Raise ValueError if a link is attached to itself by joints."""
    parents = {end_of(joint, "child"): end_of(joint, "parent") for joint in root.findall("joint")}
    while top := [link for link, parent in parents.items() if parent not in parents]:
        parents = {link: parent for link, parent in parents.items() if link not in top}
    if parents:
        raise ValueError(f"joints must form a tree, got links in or below a cycle: {', '.join(parents)}")


def read_urdf(path: str | PathLike[str], check_meshes: bool = True) -> Element:
    """Return the root element of a URDF with absolute paths of its meshes.

    :param check_meshes: check that Bullet can read the meshes
    :raises ValueError: the file is not a URDF, or a mesh is missing or cannot be read
    :raises OSError: the file cannot be read
    """
    file = Path(path).absolute()
    root = parse_urdf(file)
    for mesh in root.iter("mesh"):
        mesh.set("filename", str(mesh_path(mesh.get("filename", ""), file.parent)))
    if check_meshes:
        for name in dict.fromkeys(mesh.get("filename", "") for mesh in root.iter("mesh")):
            check_mesh(Path(name))
    return root


def load_model(relative: str) -> Element:
    """Return the root element of a URDF of ``pybullet_data``."""
    import pybullet_data

    return read_urdf(Path(pybullet_data.getDataPath()) / relative, check_meshes=False)


def mesh_path(name: str, folder: Path) -> Path:
    """Return the absolute path of a mesh in the URDF of a folder, or raise ValueError if it does not exist.

    As in PyBullet, the package of a ``package://`` path is a folder above the URDF or next to such a folder.
    """
    for place in [folder, *folder.parents] if name.startswith(PACKAGE) else [folder]:
        found = place / name.removeprefix(PACKAGE).removeprefix(FILE)
        if found.is_file():
            return found
    raise ValueError(f"the mesh {name!r} of a model in {folder} is not there")


def to_text(root: Element) -> str:
    """Return the text of a model, in short lines: Bullet breaks lines of more than 1,023 characters."""
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode")


def find(root: Element, tag: str, name: str) -> Element:
    """Return the ``"link"`` or ``"joint"`` of a name, or raise ValueError."""
    for element in root.findall(tag):  # an XPath cannot contain a name with quotes
        if element.get("name") == name:
            return element
    raise ValueError(f"the model has no {tag} {name!r}")


def find_root(root: Element) -> Element:
    """Return the only link that is not the child of a joint, or raise ValueError."""
    children = {end_of(joint, "child") for joint in root.findall("joint")}
    found = [link for link in root.findall("link") if link.get("name") not in children]
    if len(found) != 1:
        names = ", ".join(repr(link.get("name")) for link in found) or "none"
        raise ValueError(f"a model must have one root link, got {names}")
    return found[0]


def end_of(joint: Element, end: str) -> str:
    """Return the name of a joint's ``"parent"`` or ``"child"`` link, or raise ValueError."""
    element = joint.find(end)
    if element is None:
        raise ValueError(f"joint {joint.get('name')!r} must have a <{end}>")
    return element.get("link", "")


def children_of(root: Element, link: str) -> list[Element]:
    """Return the joints attached to a link."""
    return [joint for joint in root.findall("joint") if end_of(joint, "parent") == link]


def numbers_of(element: Element | None, key: str, count: int, default: str = "") -> list[float]:
    """Return the ``count`` finite numbers in an attribute, or raise ValueError."""
    text = default if element is None else element.get(key, default)
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    if len(values) != count or not all(map(math.isfinite, values)):
        wanted = "a finite number" if count == 1 else f"{count} finite numbers"
        tag = "" if element is None else element.tag
        raise ValueError(f"{key} of <{tag}> must be {wanted}, got {text!r}")
    return values


def number_of(element: Element, key: str, default: str = "0") -> float:
    """Return the number in an attribute, or raise ValueError."""
    return numbers_of(element, key, 1, default)[0]


def vector_of(element: Element | None, key: str, default: str = "0 0 0") -> Vector:
    """Return the three numbers in an attribute, or raise ValueError."""
    x, y, z = numbers_of(element, key, 3, default)
    return (x, y, z)


def frame_of(element: Element) -> Pose:
    """Return the ``origin`` of an element in the parent frame."""
    origin = element.find("origin")
    return euler_pose(vector_of(origin, "xyz"), vector_of(origin, "rpy"))


def axis_of(joint: Element) -> Vector:
    """Return the axis of a joint in its own frame, of any length, or raise ValueError."""
    axis = vector_of(joint.find("axis"), "xyz", "1 0 0")
    if not any(axis):
        raise ValueError(f"the axis of joint {joint.get('name')!r} must have a length, got 0 0 0")
    return axis


def limits_of(joint: Element) -> tuple[float, float]:
    """Return the lower and upper limit (rad or m) of a joint, infinite for a continuous joint."""
    limit = joint.find("limit")
    if joint.get("type") == "continuous" or limit is None:
        return (-math.inf, math.inf)
    return (number_of(limit, "lower"), number_of(limit, "upper"))


def pose_at(joint: Element, position: float) -> Pose:
    """Return the pose of a joint's child link in the parent link at a position (rad or m)."""
    kind, frame = joint.get("type"), frame_of(joint)
    if kind not in ("revolute", "continuous", "prismatic"):
        return frame
    x, y, z = axis_of(joint)
    length = math.hypot(x, y, z)
    x, y, z = (position * part / length for part in (x, y, z))
    if kind == "prismatic":
        return frame.compose(Pose((x, y, z)))
    return frame.compose(Pose((0.0, 0.0, 0.0), tuple(Rotation.from_rotvec((x, y, z)).as_quat().tolist())))


def mass_of(link: Element) -> float:
    """Return the mass (kg) of a link, 0 without ``<inertial>``."""
    mass = link.find("inertial/mass")
    return 0.0 if mass is None else number_of(mass, "value")


def text_of(values: Sequence[float]) -> str:
    """Return the text of some numbers, exactly."""
    return " ".join(repr(value) for value in values)


def put(element: Element, tag: str, **attributes: str) -> None:
    """Replace the child elements of a tag by one element."""
    for old in element.findall(tag):
        element.remove(old)
    SubElement(element, tag, attributes)


def put_origin(element: Element, pose: Pose) -> None:
    """Replace the ``origin`` of an element."""
    put(element, "origin", xyz=text_of(pose.position), rpy=text_of(euler_angles(pose.orientation)))


def add_geometry(
    link: Element, tag: str, shape: str, size: Mapping[str, str], pose: Pose, colour: Sequence[float] = ()
) -> None:
    """Add a ``"visual"`` or ``"collision"`` element with a shape at a pose of the link.

    :param size: attributes of the shape
    :param colour: red, green, blue and opacity of a visual element
    """
    element = SubElement(link, tag)
    put_origin(element, pose)
    put(SubElement(element, "geometry"), shape, **size)
    if colour:
        material = SubElement(element, "material", name="colour " + text_of(colour))
        put(material, "color", rgba=text_of(colour))


def add_inertial(link: Element, origin: Pose, mass: float, tensor: Sequence[Sequence[float]]) -> None:
    """Add mass (kg) and inertia (kg m^2), a (3, 3) tensor about the centre of mass, to a link."""
    inertial = SubElement(link, "inertial")
    put_origin(inertial, origin)
    put(inertial, "mass", value=repr(mass))
    names = {"ixx": (0, 0), "iyy": (1, 1), "izz": (2, 2), "ixy": (0, 1), "ixz": (0, 2), "iyz": (1, 2)}
    put(inertial, "inertia", **{name: repr(tensor[row][column]) for name, (row, column) in names.items()})


def add_joint(
    root: Element,
    kind: str,
    name: str,
    links: tuple[str, str],
    origin: Pose,
    axis: Vector,
    limits: tuple[float, float] | None = None,
) -> None:
    """Add a joint between a parent and a child link, with its limits (rad or m)."""
    joint = SubElement(root, "joint", name=name, type=kind)
    put(joint, "parent", link=links[0])
    put(joint, "child", link=links[1])
    put_origin(joint, origin)
    put(joint, "axis", xyz=text_of(axis))
    if limits is not None:
        bounds = {"lower": repr(limits[0]), "upper": repr(limits[1])}
        put(joint, "limit", **bounds, effort="100", velocity="10")  # motors have limits of their own
