"""Users' meshes and models: loaded as objects or robots, or refused with the file and the reason."""

import shutil
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pybullet_data
import pytest
from rollouts import GRASPING

from bulletarm_gym.geometry import Mesh, Pose
from bulletarm_gym.objects.files import GREY, load_folder, load_object
from bulletarm_gym.objects.graspables import FRICTION, MASS, graspables
from bulletarm_gym.robots import read_urdf
from bulletarm_gym.simulation import Box, Convex, Piece
from bulletarm_gym.simulation.client import Client
from bulletarm_gym.simulation.loading import load_urdf
from bulletarm_gym.simulation.shapes import wavefront

SIZE = (0.04, 0.05, 0.06)
BOX = f'<geometry><box size="{" ".join(map(str, SIZE))}"/></geometry>'
NAN_COLLADA = b'<COLLADA><float_array>nan</float_array><triangles count="1"/></COLLADA>'
OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
INERTIAL = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'


def ascii_stl():
    mesh = Mesh.box(SIZE)
    facets = [
        "".join(f"vertex {x:e} {y:e} {z:e}\n" for x, y, z in f) for f in mesh.vertices[mesh.faces].tolist()
    ]
    body = "".join(f"facet normal 0 0 0\nouter loop\n{text}endloop\nendfacet\n" for text in facets)
    return f"solid box\n{body}endsolid box\n".encode()


def binary_stl(header=b"solid"):
    mesh = Mesh.box(SIZE)
    records = np.zeros(12, dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")])
    records["corners"] = mesh.vertices[mesh.faces]
    return header.ljust(80) + (12).to_bytes(4, "little") + records.tobytes()


def write_link(path, inside="", outside="", shape=BOX):
    """Write a URDF of one link with a collision geometry."""
    link = f'<link name="a"><collision>{shape}</collision>{inside}</link>'
    path.write_text(f'<robot name="a">{outside}{link}</robot>')
    return path


def write_model(folder, mesh, content):
    """Write a URDF whose link has a mesh with this content."""
    (folder / mesh).write_bytes(content)
    return write_link(folder / "arm.urdf", INERTIAL, shape=f'<geometry><mesh filename="{mesh}"/></geometry>')


def test_random_urdfs_of_pybullet(tmp_path):
    for name in ("000", "001", "168"):
        shutil.copytree(Path(pybullet_data.getDataPath()) / "random_urdfs" / name, tmp_path / name)
    with pytest.warns(UserWarning, match=r"1 of 3 .*168\.urdf cannot be loaded: a vertex is not finite"):
        assert [spec.name for spec in load_folder(str(tmp_path))] == ["000/000.urdf", "001/001.urdf"]
    with pytest.raises(ValueError, match=r"168\.urdf cannot be loaded: a vertex is not finite"):
        load_folder(str(tmp_path / "168"))


@pytest.mark.parametrize("name", ["a.obj", "A.STL", "ascii.stl", "A.URDF"])
def test_formats_are_read_in_any_case(tmp_path, name):
    contents = {
        "a.obj": wavefront([Piece(Box(SIZE))]).encode(),
        "A.STL": binary_stl(),
        "ascii.stl": ascii_stl(),
        "A.URDF": f'<robot name="a"><link name="a"><collision>{BOX}</collision></link></robot>'.encode(),
    }
    (tmp_path / name).write_bytes(contents[name])
    (spec,) = load_folder(str(tmp_path))
    assert spec.name == name and spec.extents == pytest.approx((0.05, 0.06, 0.04))
    assert (spec.mass, spec.friction, spec.colour) == (MASS, FRICTION, GREY)
    alone = load_object(tmp_path / name, "box", 0.5)  # not laid flat
    assert alone.name == "box" and alone.extents == pytest.approx([side / 2 for side in SIZE])
    assert alone.mass == MASS


@pytest.mark.parametrize("kind", ["inside out", "open", "polygons", "millimetres in a URDF"])
def test_meshes_of_any_faces_have_the_mass_properties_of_the_box(tmp_path, kind):
    mesh = Mesh.box(SIZE)
    faces = (mesh.faces + 1).tolist()
    polygons = [[1, 2, 4, 3], [5, 7, 8, 6], [-8, -4, -3, -7], [3, 4, 8, 7], [1, 3, 7, 5], [2, 6, 8, 4]]
    changed = {"inside out": [face[::-1] for face in faces], "open": faces[:-2], "polygons": polygons}
    faces = changed.get(kind, faces)
    scale = 1000.0 if kind == "millimetres in a URDF" else 1.0
    lines = [f"v {x!r} {y!r} \\\n{z!r}" for x, y, z in (scale * mesh.vertices).tolist()]
    lines += [" ".join(["f", *map(str, face)]) for face in faces]
    (tmp_path / "a.obj").write_text("\ufeff" + "\n".join(lines), encoding="utf-8")
    if scale > 1.0:
        shape = '<geometry><mesh filename="a.obj" scale="0.001 0.001 0.001"/></geometry>'
        write_link(tmp_path / "a.urdf", shape=shape)
    (spec,) = load_folder(str(tmp_path))
    frame, moments = spec.mass_properties
    x, y, z = np.square(SIZE)
    assert sorted(moments) == pytest.approx([MASS / 12.0 * pair for pair in (x + y, x + z, y + z)], rel=1e-6)
    assert frame.position == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)


def test_each_part_of_an_obj_file_is_convex_and_concave_parts_are_announced(tmp_path):
    cup = next(spec for spec in graspables() if spec.name == "cup_0")
    (tmp_path / "whole.obj").write_text(wavefront([Piece(Convex(cup.mesh))]))
    (tmp_path / "parts.obj").write_text(wavefront(cup.pieces))
    with pytest.warns(UserWarning, match="concave") as caught:
        parts, whole = load_folder(str(tmp_path))
    (warning,) = caught
    assert "whole.obj" in str(warning.message) and "parts.obj" not in str(warning.message)
    assert (len(parts.pieces), len(whole.pieces)) == (len(cup.pieces), 1)
    for spec in (parts, whole):
        assert spec.extents == pytest.approx(cup.extents)


def test_values_of_a_urdf_are_used(tmp_path):
    contact = '<contact><lateral_friction value="0.8"/><rolling_friction value="0.002"/></contact>'
    visual = f'<visual>{BOX}<material name="painter\'s"/></visual>'
    colours = [
        (name, f'<color rgba="{rgba}"/>') for name, rgba in (("other", "1 0 0 1"), ("painter's", "0 1 0 1"))
    ]
    outside = "".join(f'<material name="{name}">{colour}</material>' for name, colour in colours)
    write_link(tmp_path / "a.urdf", f'<inertial><mass value="1.2"/></inertial>{contact}{visual}', outside)
    (spec,) = load_folder(str(tmp_path))
    assert (spec.mass, spec.friction, spec.rolling_friction, spec.spinning_friction) == (1.2, 0.8, 0.002, 0.0)
    assert spec.colour == (0.0, 1.0, 0.0, 1.0)
    assert sum(spec.mass_properties[1]) == pytest.approx(1.2 / 6.0 * sum(side**2 for side in SIZE))


COLOURED = f'<visual>{BOX}<material name="paint"><color rgba="255 0 0 255"/></material></visual>'
CYLINDER = '<collision><geometry><cylinder radius="-0.01" length="0.1"/></geometry></collision>'


@pytest.mark.parametrize(
    ("name", "text", "reason"),
    [
        ("a.obj", "v 0 0 0\n", "no faces"),
        ("a.obj", "v 0 0 0\nf 1 2 3\n", "names vertex 2 of 1.*'f 1 2 3'"),
        ("a.obj", "v 0 zero 0\n", "'v 0 zero 0'"),
        ("a.obj", "o label\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 3\nf 2 3 4\n", "plane.*part 'label'"),
        ("a.obj", f"{OBJ}f 1 2 3\nf 2 3 4\n", "sides must be .* got 1 x 1 x 1"),
        ("a.urdf", "<robot", "not XML"),
        ("a.urdf", "<robot><link/><link/></robot>", "2 links"),
        ("a.urdf", "<robot><link/></robot>", "no collision"),
        ("a.urdf", '<inertial><mass value="0"/></inertial>', "mass must be .* got 0"),
        ("a.urdf", '<contact><lateral_friction value="-1"/></contact>', "friction of .* got -1"),
        ("a.urdf", "<inertial><mass/></inertial>", "value of <mass> .* got ''"),
        ("a.urdf", COLOURED, r"colour of .* got \(255\.0, 0\.0, 0\.0, 255\.0\)"),
        ("a.urdf", "<collision><geometry><capsule/></geometry></collision>", "got capsule"),
        ("a.urdf", CYLINDER, "radius must be a positive number, got -0.01"),
        ("a.txt", "", "no .obj, no .stl and no .urdf"),
    ],
)
def test_file_that_cannot_be_loaded_is_named(tmp_path, name, text, reason):
    (tmp_path / name).write_text(text)
    if name == "a.urdf" and "robot" not in text:
        write_link(tmp_path / name, text)
    where = r"a\.(obj|urdf) cannot be loaded: .*" if name != "a.txt" else ""
    with pytest.raises(ValueError, match=where + reason):
        load_folder(str(tmp_path))


def test_files_and_elements_without_effect_are_named_in_one_warning(tmp_path):
    contact = '<contact><stiffness value="3"/><contact_erp value="1"/></contact>'
    visual = f'<visual>{BOX}<material name="m"><texture/></material></visual>'
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "used.obj").write_text(wavefront([Piece(Box(SIZE))]))
    shape = '<geometry><mesh filename="meshes/used.obj"/></geometry>'
    write_link(tmp_path / "a.urdf", contact + visual, shape=shape)
    for name in ("loose.obj", "b.dae", "C.PLY", "readme.md"):
        (tmp_path / name).touch()
    (tmp_path / "a.mtl").write_text("map_Kd image.png")
    with pytest.warns(UserWarning) as caught:
        assert [spec.name for spec in load_folder(str(tmp_path))] == ["a.urdf"]
    (warning,) = caught
    assert ": map_Kd, stiffness, texture" in str(warning.message)
    assert ": C.PLY, b.dae, loose.obj" in str(warning.message)


def test_objects_wider_than_the_stroke_are_refused_by_name(make, tmp_path):
    parameters = {"object_set": str(tmp_path), "num_objects": 1}
    (tmp_path / "long.obj").write_text(wavefront([Piece(Box((0.12, 0.05, 0.03)))]))
    make(GRASPING, **parameters)
    (tmp_path / "wide.obj").write_text(wavefront([Piece(Box((0.12, 0.12, 0.01)))]))
    with pytest.raises(ValueError, match=r"^object_set must be .*wide\.obj is 0\.12 m wide"):
        make(GRASPING, 1, **parameters)
    make(GRASPING, object_scale_range=0.5, **parameters)


def simulated_size(path):
    """Return the side lengths (m) of a model's collision shape in Bullet."""
    client = Client()
    xml = ElementTree.tostring(read_urdf(path), encoding="unicode")
    body, _ = load_urdf(client, "arm", xml, Pose((0.0, 0.0, 0.0)))
    assert len(client.getCollisionShapeData(body, -1)) == 1
    low, high = client.getAABB(body)
    return np.subtract(high, low).tolist()


def test_meshes_of_robots_keep_their_collision_shape(tmp_path):
    for mesh, content in (("A.STL", ascii_stl()), ("a.stl", binary_stl())):
        path = write_model(tmp_path, mesh, content)
        text = path.read_text().replace("<collision>", '<drake:proximity/><collision drake:acceleration="3">')
        path.write_text("\n" + '<?xml version="1.0"?>' + text)  # extensions without a declaration are ignored
        assert simulated_size(path) == pytest.approx(SIZE, abs=0.01)
    cone = Path(pybullet_data.getDataPath()) / "racecar" / "meshes" / "cone.dae"
    assert min(simulated_size(write_model(tmp_path, "a.dae", cone.read_bytes()))) > 0.1


@pytest.mark.parametrize(
    ("mesh", "content", "reason"),
    [
        ("a.obj", b"", "no faces"),
        ("a.obj", f"{OBJ}f 1 2 300000000\n".encode(), "names vertex 300000000 of 4"),
        ("a.obj", f"{OBJ.replace('1', 'nan')}f 1 2 3\n".encode(), "not finite"),
        ("a.stl", b"\0" * 10, "length"),
        ("a.stl", binary_stl()[:-7], "a.stl"),
        ("a.stl", ascii_stl()[:-100], "not triangles"),
        ("a.dae", b"<COLLADA/>", "no <triangles>"),
        ("a.dae", NAN_COLLADA, "not finite"),
        ("a.ply", b"ply\n", "OBJ or STL, got '.ply'"),
    ],
)
def test_mesh_that_bullet_cannot_read_is_refused(tmp_path, mesh, content, reason):
    path = write_model(tmp_path, mesh, f"{OBJ}f 1 2 3\nf 2 3 4\n".encode())
    if mesh == "a.obj":
        read_urdf(path)  # a file is checked again after a change
    (tmp_path / mesh).write_bytes(content)
    with pytest.raises(ValueError) as error:
        read_urdf(path)
    assert str(tmp_path / mesh) in str(error.value) and reason in str(error.value)


def test_other_formats_than_urdf_are_named(tmp_path):
    for text, reason in (
        ("<robot", "not XML"),
        ('<mujoco model="arm"/>', "root element is <mujoco>"),
        ('<robot xmlns:xacro="http://ros.org/wiki/xacro"><xacro:arm/></robot>', "a xacro file"),
    ):
        path = tmp_path / "arm.urdf"
        path.write_text(text)
        with pytest.raises(ValueError, match=f"{path}.*{reason}|{reason}.*{path}"):
            read_urdf(path)


def test_model_that_bullet_refuses_is_named():
    with pytest.raises(ValueError, match="'lost'"):
        load_urdf(Client(), "lost", "<robot/>", Pose((0.0, 0.0, 0.0)))
