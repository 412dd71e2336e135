#!/usr/bin/env bash
# PyBullet 3.2.7: with ER_TINY_RENDERER and shadow=1, an empty ground lies in its own shadow, and the near plane of the
# camera decides how much of it. Nothing stands on the ground or between it and the light.
# Seen: with near=0.1 and far=100, 6,960 of 10,000 pixels of the ground are darker than without shadows, with near=0.01
# and far=100, or near=0.1 and far=3, none.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check pybullet==3.2.7 numpy==2.2.6
"$folder/venv/bin/python" - <<'PYTHON'
import numpy as np
import pybullet

SIZE = 100
pybullet.connect(pybullet.DIRECT)
ground = pybullet.createVisualShape(pybullet.GEOM_BOX, halfExtents=(2, 2, 0.01), rgbaColor=(0.7, 0.7, 0.7, 1))
pybullet.createMultiBody(0, -1, ground, (0, 0, -0.01))
view = pybullet.computeViewMatrix((0.5, 0, 2), (0.5, 0, 0), (0, 1, 0))


def image(near, far, shadow):
    projection = pybullet.computeProjectionMatrixFOV(32, 1, near, far)
    _, _, pixels, _, _ = pybullet.getCameraImage(
        SIZE,
        SIZE,
        view,
        projection,
        shadow=shadow,
        lightDirection=(0.5, 0.2, 1),
        renderer=pybullet.ER_TINY_RENDERER,
    )
    return np.reshape(pixels, (SIZE, SIZE, 4))[..., :3].astype(int)


darker = {
    (near, far): int((image(near, far, 1) < image(near, far, 0) - 5).any(axis=2).sum())
    for near, far in ((0.1, 3), (0.1, 100), (0.01, 100))
}
print("darker pixels by near and far plane:", darker)
assert darker[0.1, 3] == 0 and darker[0.1, 100] > SIZE**2 / 2 and darker[0.01, 100] < SIZE**2 / 20, darker
PYTHON
