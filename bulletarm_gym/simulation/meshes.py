"""Mesh files: their points, and a check of each before Bullet opens it.

Bullet ignores a mesh that it cannot read, and some broken files end the process.
"""

import re
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from xml.etree.ElementTree import ParseError

import numpy as np

from bulletarm_gym.geometry import FloatArray
from bulletarm_gym.simulation.xml import parse_xml

FORMATS = (".obj", ".stl", ".dae")
"""File name extensions, in capitals or small letters, of the meshes that Bullet reads."""
STL_HEADER, STL_FACET = 84, 50
"""Bytes of a binary STL file before the first facet and of each facet."""
VERTEX = re.compile(rb"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", re.IGNORECASE)

Part = tuple[str, FloatArray]
"""Name of a part and the corners (n, 3) of its faces in the unit of the file."""


def check_mesh(path: Path) -> None:
    """Check that Bullet can read a mesh, or an ASCII STL file, which is converted for it.

    :raises ValueError: it cannot; the message names the file and the reason
    """
    try:
        status = path.stat()
        _check_version(path, status.st_mtime_ns, status.st_size)
    except (ValueError, OSError, ParseError) as error:
        raise ValueError(f"mesh must be a readable OBJ, STL or COLLADA file, got {path}: {error}") from error


@lru_cache(maxsize=1024)
def _check_version(path: Path, modified: int, size: int) -> None:
    """Check a version of a file once."""
    if path.suffix.lower() == ".dae":
        _check_collada(path)
    else:
        mesh_parts(path)


def mesh_parts(path: Path) -> list[Part]:
    """Return the parts of an OBJ file that have faces, or the one part of an STL file.

    :raises ValueError: the file has no faces, a face has a vertex that does not exist or is not finite
    :raises OSError: the file cannot be read
    """
    if path.suffix.lower() not in (".obj", ".stl"):
        raise ValueError(f"its format must be OBJ or STL, got {path.suffix!r}")
    parts = [(path.stem, stl_corners(path))] if path.suffix.lower() == ".stl" else _obj_parts(path)
    if not sum(len(points) for _, points in parts):
        raise ValueError("it has no faces")
    if not all(np.isfinite(points).all() for _, points in parts):
        raise ValueError("a vertex is not finite")
    return parts


def is_ascii_stl(path: Path) -> bool:
    """Return True if a file is an STL file in ASCII, which Bullet does not read."""
    return path.suffix.lower() == ".stl" and not _is_binary(path)


def _is_binary(path: Path) -> bool:
    with path.open("rb") as file:
        header = file.read(STL_HEADER)
    count = int.from_bytes(header[-4:], "little")
    return len(header) == STL_HEADER and path.stat().st_size == STL_HEADER + STL_FACET * count


def stl_corners(path: Path) -> FloatArray:
    """Return the corners (3 n, 3) of the facets of a binary or ASCII STL file.

    :raises ValueError: it is neither
    """
    data = path.read_bytes()
    if _is_binary(path):
        facets = np.frombuffer(data[STL_HEADER:], np.uint8).reshape(-1, STL_FACET)[:, 12:48]
        return np.ascontiguousarray(facets).view("<f4").reshape(-1, 3).astype(np.float64)
    if not data.lstrip().lower().startswith(b"solid"):
        raise ValueError("its length does not agree with its number of facets")
    points = np.array([[float(number) for number in match] for match in VERTEX.findall(data)])
    if len(points) % 3 or len(points) != 3 * len(re.findall(rb"\bendfacet\b", data, re.IGNORECASE)):
        raise ValueError("its facets are not triangles")
    return points.reshape(-1, 3)


def _obj_parts(path: Path) -> list[Part]:
    """Return the parts of an OBJ file that have faces."""
    vertices: list[list[float]] = []
    parts: list[tuple[str, list[int]]] = [(path.stem, [])]
    for line in _lines(path):
        kind, *words = line.split() or [""]
        if kind in ("o", "g"):
            parts.append((" ".join(words), []))
        elif kind == "v":
            x, y, z = (float(word) for word in words[:3])
            vertices.append([x, y, z])
        elif kind == "f":
            parts[-1][1].extend(_vertex(word, len(vertices)) for word in words)
    points = np.array(vertices, dtype=np.float64).reshape(-1, 3)
    return [(name, points[indices]) for name, indices in parts if indices]


def _lines(path: Path) -> Iterator[str]:
    """Yield the lines of a text file; a line that ends in a backslash goes on in the next one."""
    text = path.read_text(encoding="utf-8-sig", errors="replace")
    yield from text.replace("\\\r\n", " ").replace("\\\n", " ").splitlines()


def _vertex(word: str, count: int) -> int:
    """Return the index of a face's corner, which counts from 1, or backwards from the last vertex."""
    number = int(word.partition("/")[0])
    index = number - 1 if number > 0 else count + number
    if not 0 <= index < count:
        raise ValueError(f"a face names vertex {number} of {count}")
    return index


def _check_collada(path: Path) -> None:
    root = parse_xml(path)
    faces = [face for kind in ("triangles", "polylist") for face in root.iter(kind)]
    if root.tag != "COLLADA" or not any(int(face.get("count", "0")) for face in faces):
        raise ValueError("it has no <triangles> and no <polylist>")
    for array in root.iter("float_array"):
        if not all(np.isfinite([float(word) for word in (array.text or "").split()])):
            raise ValueError("a vertex is not finite")
