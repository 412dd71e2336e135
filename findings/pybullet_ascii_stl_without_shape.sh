#!/usr/bin/env bash
# PyBullet 3.2.7: loadURDF() accepts an ASCII STL mesh but leaves the link without its collision shape.
# It prints a warning and returns a body as usual. The same mesh as a binary STL file has its shape.
# Seen: 0 collision shapes with ASCII, 1 with binary.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check pybullet==3.2.7 numpy==2.2.6
"$folder/venv/bin/python" - "$folder" <<'PYTHON'
import pathlib
import struct
import sys

import pybullet

folder = pathlib.Path(sys.argv[1])
corners = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]
facets = [[corners[i] for i in face] for face in ((0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3))]
text = "".join(
    "facet normal 0 0 0\nouter loop\n" + "".join("vertex %g %g %g\n" % point for point in facet) + "endloop\nendfacet\n"
    for facet in facets
)
(folder / "ascii.stl").write_text(f"solid a\n{text}endsolid a\n")
data = b"".join(struct.pack("<12fH", 0, 0, 0, *sum(facet, ()), 0) for facet in facets)
(folder / "binary.stl").write_bytes(b"\0" * 80 + struct.pack("<I", len(facets)) + data)
pybullet.connect(pybullet.DIRECT)
counts = {}
for kind in ("ascii", "binary"):
    path = folder / f"{kind}.urdf"
    path.write_text(
        f'<robot name="a"><link name="a"><collision><geometry><mesh filename="{kind}.stl"/></geometry></collision></link></robot>'
    )
    counts[kind] = len(pybullet.getCollisionShapeData(pybullet.loadURDF(str(path)), -1))
print("collision shapes:", counts)
assert counts == {"ascii": 0, "binary": 1}, counts
PYTHON
