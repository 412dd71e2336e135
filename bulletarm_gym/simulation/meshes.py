"""Reading of mesh files, and a check before Bullet opens them.

Bullet ignores a mesh that it cannot read, and some broken files end the process.
"""

import re
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from bulletarm_gym.geometry import FloatArray

STL_HEADER, STL_FACET = 84, 50
"""Number of bytes before the first facet of a binary STL file, and of each facet."""
VERTEX = re.compile(rb"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", re.IGNORECASE)
"""Vertex of an ASCII STL file."""


def check_mesh(path: Path) -> None:
    """Check that a mesh can be loaded. An ASCII STL file is converted for Bullet later.

    :raises ValueError: the mesh cannot be loaded; the message contains the file and the reason
    """
    try:
        status = path.stat()
        _check_version(path, status.st_mtime_ns, status.st_size)
    except (ValueError, OSError, ElementTree.ParseError) as error:
        raise ValueError(f"mesh must be a readable OBJ, STL or COLLADA file, got {path}: {error}") from error


@lru_cache(maxsize=1024)
def _check_version(path: Path, modified: int, size: int) -> None:
    check = _check_collada if path.suffix.lower() == ".dae" else mesh_parts
    check(path)


def mesh_parts(path: Path) -> list[tuple[str, FloatArray]]:
    """Return the parts of an OBJ file that have faces, or the only part of an STL file.

    :return: name of each part and the corners (3 n, 3) of its triangles in the unit of the file
    :raises ValueError: the file has no faces, a face has a vertex that does not exist, or one is not finite
    :raises OSError: the file cannot be read
    """
    suffix = path.suffix.lower()
    if suffix not in (".obj", ".stl"):
        raise ValueError(f"its format must be OBJ or STL, got {path.suffix!r}")
    parts = [(path.stem, stl_corners(path))] if suffix == ".stl" else _obj_parts(path)
    if not sum(len(points) for _, points in parts):
        raise ValueError("it has no faces")
    if not all(np.isfinite(points).all() for _, points in parts):
        raise ValueError("a vertex is not finite")
    return parts


def is_ascii_stl(path: Path) -> bool:
    """Return True if a file is an STL file in ASCII, which Bullet does not read."""
    return path.suffix.lower() == ".stl" and not _is_binary(path.read_bytes())


def _is_binary(data: bytes) -> bool:
    count = int.from_bytes(data[STL_HEADER - 4 : STL_HEADER], "little")
    return len(data) >= STL_HEADER and len(data) == STL_HEADER + STL_FACET * count


def stl_corners(path: Path) -> FloatArray:
    """Return the corners (3 n, 3) of the facets of a binary or ASCII STL file, or raise ValueError."""
    data = path.read_bytes()
    if _is_binary(data):
        facets = np.frombuffer(data[STL_HEADER:], np.uint8).reshape(-1, STL_FACET)[:, 12:48]
        return np.ascontiguousarray(facets).view("<f4").reshape(-1, 3).astype(np.float64)
    if not data.lstrip().lower().startswith(b"solid"):
        raise ValueError("its length does not agree with its number of facets")
    points = np.array([[float(number) for number in match] for match in VERTEX.findall(data)])
    if len(points) % 3 or len(points) != 3 * len(re.findall(rb"\bendfacet\b", data, re.IGNORECASE)):
        raise ValueError("its facets are not triangles")
    return points.reshape(-1, 3)


def _obj_parts(path: Path) -> list[tuple[str, FloatArray]]:
    """Return the parts of an OBJ file that have faces."""
    vertices: list[list[float]] = []
    parts: list[tuple[str, list[int]]] = [(path.stem, [])]
    text = path.read_text(encoding="utf-8-sig", errors="replace")
    # A backslash at the end of a line continues it.
    for line in text.replace("\\\r\n", " ").replace("\\\n", " ").splitlines():
        kind, *words = line.split() or [""]
        if kind in ("o", "g"):
            parts.append((" ".join(words), []))
        elif kind == "v":
            x, y, z = (float(word) for word in words[:3])
            vertices.append([x, y, z])
        elif kind == "f":
            first, *others = (_vertex(word, len(vertices)) for word in words)
            parts[-1][1].extend(corner for pair in pairwise(others) for corner in (first, *pair))
    points = np.array(vertices, dtype=np.float64).reshape(-1, 3)
    return [(name, points[indices]) for name, indices in parts if indices]


def _vertex(word: str, count: int) -> int:
    """Return the index of a face's corner. The file counts from 1, or backwards from the last vertex."""
    number = int(word.partition("/")[0])
    index = number - 1 if number > 0 else count + number
    if not 0 <= index < count:
        raise ValueError(f"a face names vertex {number} of {count}")
    return index


def _check_collada(path: Path) -> None:
    elements = [(element.tag.rpartition("}")[2], element) for element in ElementTree.parse(path).iter()]
    counts = [int(element.get("count", "0")) for tag, element in elements if tag in ("triangles", "polylist")]
    if elements[0][0] != "COLLADA" or not any(counts):
        raise ValueError("it has no <triangles> and no <polylist>")
    arrays = [element.text or "" for tag, element in elements if tag == "float_array"]
    if not np.isfinite([float(word) for text in arrays for word in text.split()]).all():
        raise ValueError("a vertex is not finite")
