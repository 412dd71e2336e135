"""XML files of models."""

from pathlib import Path
from xml.etree.ElementTree import Element, ParseError, TreeBuilder
from xml.parsers import expat

ROOTS = {
    "mujoco": "an MJCF file. Convert it to URDF",
    "mujocoinclude": "an MJCF file. Convert it to URDF",
    "sdf": "an SDF file. Convert it to URDF",
}
"""Root elements of models in other formats."""


def parse_xml(path: Path) -> Element:
    """Return the root element of an XML file; prefixes stay part of names and need no declaration.

    :raises ParseError: it is not XML
    :raises OSError: it cannot be read
    """
    builder = TreeBuilder()
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
    """Return the root element of a URDF without the extensions of other programs.

    :raises ValueError: it is not XML, or in another format
    :raises OSError: it cannot be read
    """
    try:
        root = parse_xml(path)
    except ParseError as error:
        raise ValueError(f"model must be a URDF file, got {path}, which is not XML: {error}") from error
    if any(element.tag.startswith("xacro:") for element in root.iter()):
        raise ValueError(
            f"model must be a URDF file, got {path}, a xacro file. Run `xacro FILE > robot.urdf`"
        )
    if root.tag != "robot":
        kind = ROOTS.get(root.tag, f"whose root element is <{root.tag}>")
        raise ValueError(f"model must be a URDF file, got {path}, {kind}")
    if any("quat_xyzw" in element.attrib for element in root.iter("origin")):
        raise ValueError(f"origins must have rpy angles, got quat_xyzw of URDF 1.1 in {path}")
    _remove_extensions(root)
    return root


def _remove_extensions(element: Element) -> None:
    """Remove the elements and attributes of other programs, which have a prefix such as ``drake:``."""
    for name in [name for name in element.attrib if ":" in name]:
        del element.attrib[name]
    for child in list(element):
        if ":" in child.tag:
            element.remove(child)
        else:
            _remove_extensions(child)
