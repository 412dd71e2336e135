#!/usr/bin/env bash
# PyBullet 3.2.7: a URDF link without <inertial>, which has no mass by the URDF specification, weighs 1 kg.
# Frames that ROS models put between the arm and the gripper make it heavier. Also, without URDF_USE_INERTIA_FROM_FILE the
# inertia in the file is replaced by that of the box around the collision shape. Seen: 1 kg; 0.167 instead of 5 kg m^2.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check pybullet==3.2.7 numpy==2.2.6
"$folder/venv/bin/python" - "$folder" <<'PYTHON'
import pathlib
import sys

import pybullet

INERTIAL = '<inertial><mass value="1"/><inertia ixx="5" iyy="5" izz="5" ixy="0" ixz="0" iyz="0"/></inertial>'
BOX = '<collision><geometry><box size="1 1 1"/></geometry></collision>'
path = pathlib.Path(sys.argv[1], "a.urdf")
path.write_text(
    f'<robot name="a"><link name="base">{INERTIAL}</link><link name="frame"/><link name="box">{INERTIAL}{BOX}</link>'
    '<joint name="f" type="fixed"><parent link="base"/><child link="frame"/></joint>'
    '<joint name="b" type="continuous"><parent link="frame"/><child link="box"/><axis xyz="0 0 1"/></joint></robot>'
)
pybullet.connect(pybullet.DIRECT)
body = pybullet.loadURDF(str(path), useFixedBase=True)
frame, box = (pybullet.getDynamicsInfo(body, link) for link in (0, 1))
honoured = pybullet.loadURDF(str(path), useFixedBase=True, flags=pybullet.URDF_USE_INERTIA_FROM_FILE)
print("mass of the frame:", frame[0], "inertia of the box:", box[2], "with the flag:", pybullet.getDynamicsInfo(honoured, 1)[2])
assert frame[0] == 1.0, frame
assert abs(box[2][0] - 1 / 6) < 0.02, box
assert pybullet.getDynamicsInfo(honoured, 1)[2] == (5.0, 5.0, 5.0)
PYTHON
