#!/usr/bin/env bash
# PyBullet 3.2.7: changeDynamics(jointLowerLimit=, jointUpperLimit=) is enforced, but getJointInfo() never shows it.
# Continuous and revolute joints stop at their new limits, yet getJointInfo() keeps reporting those of the file.
# Code that reads the limits of a joint from the simulation reads the wrong ones. Seen: both stop at 0.5, reported 2.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check pybullet==3.2.7 numpy==2.2.6
cat > "$folder/arm.urdf" <<'URDF'
<robot name="arm">
  <link name="base">
    <inertial><mass value="1"/><inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
  <link name="tip">
    <inertial><mass value="1"/><inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
  <joint name="turn" type="KIND">
    <parent link="base"/><child link="tip"/><axis xyz="0 0 1"/>
    <limit lower="-2" upper="2" effort="10" velocity="10"/>
  </joint>
</robot>
URDF
"$folder/venv/bin/python" - "$folder" <<'PYTHON'
import pathlib
import sys

import pybullet

folder = pathlib.Path(sys.argv[1])
pybullet.connect(pybullet.DIRECT)
for kind in ("continuous", "revolute"):
    path = folder / f"{kind}.urdf"
    path.write_text((folder / "arm.urdf").read_text().replace("KIND", kind))
    body = pybullet.loadURDF(str(path), useFixedBase=True)
    pybullet.changeDynamics(body, 0, jointLowerLimit=-0.5, jointUpperLimit=0.5)
    pybullet.setJointMotorControl2(body, 0, pybullet.POSITION_CONTROL, targetPosition=1.5, force=10)
    for _ in range(1000):
        pybullet.stepSimulation()
    position, limits = pybullet.getJointState(body, 0)[0], pybullet.getJointInfo(body, 0)[8:10]
    print(f"{kind}: driven to 1.5 it stops at {position:.3f}, getJointInfo() reports {limits}")
    assert abs(position - 0.5) < 0.02, position
    assert limits == (-2.0, 2.0), limits
PYTHON
