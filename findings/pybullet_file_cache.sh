#!/usr/bin/env bash
# PyBullet 3.2.7: a client reads a URDF or mesh file once. After the file is rewritten under its old name the client still
# returns the old model, without a message, until it disconnects. Seen: size 1 and 1 in one client, 2 in a new client.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check pybullet==3.2.7 numpy==2.2.6
"$folder/venv/bin/python" - "$folder" <<'PYTHON'
import pathlib
import sys

import pybullet

path = pathlib.Path(sys.argv[1], "a.obj")


def size(scale):
    points = [(x, y, z) for x in (0, scale) for y in (0, scale) for z in (0, scale)]
    faces = [(1, 2, 4), (1, 4, 3), (5, 7, 8), (5, 8, 6), (1, 5, 6), (1, 6, 2), (3, 4, 8), (3, 8, 7)]
    path.write_text("".join("v %g %g %g\n" % point for point in points) + "".join("f %d %d %d\n" % face for face in faces))
    shape = pybullet.createCollisionShape(pybullet.GEOM_MESH, fileName=str(path))
    low, high = pybullet.getAABB(pybullet.createMultiBody(0, shape))
    return high[0] - low[0]


pybullet.connect(pybullet.DIRECT)
first, second = size(1), size(2)
pybullet.disconnect()
pybullet.connect(pybullet.DIRECT)
third = size(2)
print(f"size 1: {first:.2f}, rewritten with size 2: {second:.2f}, in a new client: {third:.2f}")
assert abs(first - second) < 0.01 and third > 1.9, (first, second, third)
PYTHON
