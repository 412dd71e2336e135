#!/usr/bin/env bash
# PyBullet 3.2.7: the axis of a prismatic URDF joint is not normalised, that of a revolute joint is.
# A prismatic joint with the axis "0 0 2" moves its link by twice its position. Seen: 0.2 m at position 0.1.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check pybullet==3.2.7 numpy==2.2.6
"$folder/venv/bin/python" - "$folder" <<'PYTHON'
import pathlib
import sys

import pybullet

folder = pathlib.Path(sys.argv[1])
INERTIAL = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
TIP = f'<link name="tip">{INERTIAL}</link><joint name="t" type="fixed"><parent link="b"/><child link="tip"/><origin xyz="1 0 0"/></joint>'
pybullet.connect(pybullet.DIRECT)
found = {}
for kind in ("prismatic", "revolute"):
    for length in (1, 2):
        path = folder / f"{kind}{length}.urdf"
        path.write_text(
            f'<robot name="a"><link name="a">{INERTIAL}</link><link name="b">{INERTIAL}</link>{TIP}<joint name="j" type="{kind}">'
            f'<parent link="a"/><child link="b"/><axis xyz="0 0 {length}"/>'
            '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>'
        )
        body = pybullet.loadURDF(str(path), useFixedBase=True)
        pybullet.resetJointState(body, 0, 0.1)
        found[kind, length] = pybullet.getLinkState(body, 1, computeForwardKinematics=True)[4]
        print(kind, "axis of length", length, "tip at", [round(part, 4) for part in found[kind, length]])
assert abs(found["prismatic", 1][2] - 0.1) < 1e-6 and abs(found["prismatic", 2][2] - 0.2) < 1e-6, found
assert found["revolute", 1] == found["revolute", 2], found
PYTHON
