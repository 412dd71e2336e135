#!/usr/bin/env bash
# PyBullet 3.2.7: <mimic> of a URDF joint is ignored, without a warning. A joint that mimics another one is a free joint.
# A motor moves the first joint to 0.5 rad. Seen: the second joint, which mimics it, stays at 0 rad.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check pybullet==3.2.7 numpy==2.2.6
"$folder/venv/bin/python" - "$folder" <<'PYTHON'
import pathlib
import sys

import pybullet

path = pathlib.Path(sys.argv[1]) / "mimic.urdf"
INERTIAL = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
LINKS = "".join(f'<link name="{name}">{INERTIAL}</link>' for name in ("base", "first", "second"))
JOINT = (
    '<joint name="{name}" type="revolute"><parent link="base"/><child link="{name}"/><axis xyz="0 0 1"/>'
    '<limit lower="-1" upper="1" effort="100" velocity="10"/>{mimic}</joint>'
)
joints = JOINT.format(name="first", mimic="") + JOINT.format(name="second", mimic='<mimic joint="first"/>')
path.write_text(f'<robot name="mimic">{LINKS}{joints}</robot>')
pybullet.connect(pybullet.DIRECT)
body = pybullet.loadURDF(str(path), useFixedBase=True)
pybullet.setJointMotorControl2(body, 0, pybullet.POSITION_CONTROL, targetPosition=0.5, force=100)
for _ in range(240):
    pybullet.stepSimulation()
first, second = (pybullet.getJointState(body, joint)[0] for joint in (0, 1))
print(f"first joint at {first:.3f} rad, second joint at {second:.3f} rad")
assert abs(first - 0.5) < 0.01 and abs(second) < 0.01, (first, second)
PYTHON
