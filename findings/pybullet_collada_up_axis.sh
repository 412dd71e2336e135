#!/usr/bin/env bash
# PyBullet 3.2.7: of the <asset> of a COLLADA collision mesh the unit counts and the up axis does not.
# A mesh exported with y up lies on its side, while one exported in centimetres has the right size.
# Seen: with <unit meter="0.5"/> half the size; Z_UP and Y_UP give the same box of 0.1 x 0.2 x 0.4.
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
POINTS = " ".join(f"{x} {y} {z}" for x in (0, 0.1) for y in (0, 0.2) for z in (0, 0.4))
FACES = "0 1 3 0 3 2 4 6 7 4 7 5 0 4 5 0 5 1 2 3 7 2 7 6 0 2 6 0 6 4 1 5 7 1 7 3"
MESH = """<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit name="u" meter="{unit}"/><up_axis>{up}</up_axis></asset><library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="a" count="24">{points}</float_array><technique_common>
<accessor source="#a" count="8" stride="3"/></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="12"><input semantic="VERTEX" source="#v" offset="0"/>
<input semantic="NORMAL" source="#p" offset="0"/><p>{faces}</p></triangles></mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node><instance_geometry url="#g"/></node></visual_scene>
</library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>"""
pybullet.connect(pybullet.DIRECT)
sizes = {}
for unit in (1.0, 0.5):
    for up in ("Z_UP", "Y_UP"):
        path = folder / f"{up}{unit}.urdf"
        path.with_suffix(".dae").write_text(MESH.format(unit=unit, up=up, points=POINTS, faces=FACES))
        shape = f'<collision><geometry><mesh filename="{up}{unit}.dae"/></geometry></collision>'
        path.write_text(f'<robot name="a"><link name="a">{shape}</link></robot>')
        low, high = pybullet.getAABB(pybullet.loadURDF(str(path)))
        sizes[unit, up] = [round(b - a, 2) for a, b in zip(low, high)]
        print(unit, up, sizes[unit, up])
for unit in (1.0, 0.5):
    assert sizes[unit, "Z_UP"] == sizes[unit, "Y_UP"], sizes
    assert all(abs(size - unit * side) < 0.02 for size, side in zip(sizes[unit, "Y_UP"], (0.1, 0.2, 0.4))), sizes
PYTHON
