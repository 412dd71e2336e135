#!/usr/bin/env bash
# PyBullet 3.2.7: TinyRenderer samples pixel (column, row) at (column, row + 1) of the image, not at its centre.
# The first pixel spans 0 to 1, rows grow downwards. Points computed from depth images with the usual + 0.5 are half a
# pixel off in both directions. A projection matrix with 1/width and 1/height added to entries 8 and 9 moves the samples
# to the centres. Seen: an error of the depth of a tilted plane of 0.0004 mm at (0, 1) and with the changed matrix at
# (0.5, 0.5), and of 1.6 mm at (0.5, 0.5) with the usual matrix.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check pybullet==3.2.7 numpy==2.2.6
"$folder/venv/bin/python" - <<'PYTHON'
import math

import numpy as np
import pybullet

WIDTH, HEIGHT, FOV, NEAR, FAR = 64, 48, 42.0, 0.1, 3.0
EYE, TARGET, UP = np.array([0.3, -0.5, 1.0]), np.zeros(3), np.array([0.0, 0.0, 1.0])

pybullet.connect(pybullet.DIRECT)
orientation = pybullet.getQuaternionFromEuler((0.3, 0.2, 0.0))
shape = pybullet.createVisualShape(pybullet.GEOM_BOX, halfExtents=[3.0, 3.0, 0.05])
pybullet.createMultiBody(0.0, -1, shape, [0.0, 0.0, 0.0], orientation)
normal = np.array(pybullet.getMatrixFromQuaternion(orientation)).reshape(3, 3)[:, 2]
forward = (TARGET - EYE) / np.linalg.norm(TARGET - EYE)
right = np.cross(forward, UP) / np.linalg.norm(np.cross(forward, UP))
up = np.cross(right, forward)


def error(column: float, row: float, shift: bool) -> float:
    """Return the mean error (mm) of depths if a pixel is sampled at (column, row) from its upper left corner."""
    view = pybullet.computeViewMatrix(EYE, TARGET, UP)
    projection = list(pybullet.computeProjectionMatrixFOV(FOV, WIDTH / HEIGHT, NEAR, FAR))
    if shift:
        projection[8] += 1.0 / WIDTH
        projection[9] += 1.0 / HEIGHT
    image = pybullet.getCameraImage(WIDTH, HEIGHT, view, projection, renderer=pybullet.ER_TINY_RENDERER)
    depth = FAR * NEAR / (FAR - (FAR - NEAR) * np.reshape(image[3], (HEIGHT, WIDTH)))
    columns, rows = np.meshgrid(np.arange(WIDTH) + column, np.arange(HEIGHT) + row)
    tangent = math.tan(math.radians(FOV) / 2.0)
    across = (2.0 * columns / WIDTH - 1.0) * tangent * WIDTH / HEIGHT
    upward = (1.0 - 2.0 * rows / HEIGHT) * tangent
    rays = forward + across[..., None] * right + upward[..., None] * up
    return float(np.abs(((0.05 * normal - EYE) @ normal) / (rays @ normal) - depth).mean() * 1e3)


corner, centre, shifted = error(0.0, 1.0, False), error(0.5, 0.5, False), error(0.5, 0.5, True)
print(f"usual matrix: {corner:.4f} mm at (0, 1), {centre:.4f} mm at (0.5, 0.5); changed matrix: {shifted:.4f} mm there")
assert corner < 1e-3 and shifted < 1e-3 < 0.05 < centre
PYTHON
