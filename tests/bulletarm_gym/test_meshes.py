"""Mesh and model files of users: read, converted, or refused with the file and the reason."""

from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from bulletarm_gym.geometry import Mesh, Pose
from bulletarm_gym.robots import KUKA, read_urdf
from bulletarm_gym.simulation import BodySpec, Box, Slide, World
from bulletarm_gym.simulation.client import Client
from bulletarm_gym.simulation.loading import load_urdf
from bulletarm_gym.simulation.meshes import mesh_parts
from bulletarm_gym.simulation.shapes import Convex, Piece, wavefront
from bulletarm_gym.simulation.state import PHYSICS_MODES
from bulletarm_gym.surfaces.flat import FLOOR

SIZE = (0.1, 0.2, 0.4)
INERTIAL = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
COLLADA = """<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit name="u" meter="{unit}"/><up_axis>{up}</up_axis></asset>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="a" count="{count}">{positions}</float_array><technique_common>
<accessor source="#a" count="{vertices}" stride="3"/></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="{faces}"><input semantic="VERTEX" source="#v" offset="0"/>
<input semantic="NORMAL" source="#p" offset="0"/><p>{indices}</p></triangles>
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node><instance_geometry url="#g"/></node></visual_scene>
</library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>"""
OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"


def corners() -> np.ndarray:
    mesh = Mesh.box(SIZE)
    return mesh.vertices[mesh.faces]


def ascii_stl() -> bytes:
    facets = ["".join(f"vertex {x:e} {y:e} {z:e}\n" for x, y, z in facet.tolist()) for facet in corners()]
    body = "".join(f"facet normal 0 0 0\nouter loop\n{text}endloop\nendfacet\n" for text in facets)
    return f"solid box\n{body}endsolid box\n".encode()


def binary_stl(header: bytes = b"solid") -> bytes:
    records = np.zeros(12, dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")])
    records["corners"] = corners()
    return header.ljust(80) + (12).to_bytes(4, "little") + records.tobytes()


def collada(unit: str = "1", up: str = "Z_UP", positions: str = "") -> bytes:
    mesh = Mesh.box(SIZE)
    text = positions or " ".join(map(str, mesh.vertices.ravel().tolist()))
    indices = " ".join(map(str, mesh.faces.ravel().tolist()))
    numbers = {"count": 24, "vertices": 8, "faces": 12}
    return COLLADA.format(unit=unit, up=up, positions=text, indices=indices, **numbers).encode()


def write_model(folder: Path, mesh: str, content: bytes) -> Path:
    (folder / mesh).write_bytes(content)
    shape = f'<geometry><mesh filename="{mesh}"/></geometry>'
    path = folder / "arm.urdf"
    path.write_text(
        f'<robot name="arm"><link name="base">{INERTIAL}<visual>{shape}</visual>'
        f"<collision>{shape}</collision></link></robot>"
    )
    return path


def simulated_size(path: Path) -> list[float]:
    """Return the side lengths (m) of a model's collision shape in Bullet."""
    client = Client()
    xml = ElementTree.tostring(read_urdf(path), encoding="unicode")
    body, _ = load_urdf(client, "arm", xml, Pose((0.0, 0.0, 0.0)))
    assert len(client.getCollisionShapeData(body, -1)) == 1
    low, high = client.getAABB(body)
    client.close()
    return np.subtract(high, low).tolist()


@pytest.mark.parametrize("mesh", ["a.stl", "A.STL"])
def test_ascii_stl_keeps_its_collision_shape(tmp_path: Path, mesh: str) -> None:
    assert simulated_size(write_model(tmp_path, mesh, ascii_stl())) == pytest.approx(SIZE, abs=0.01)


def test_binary_stl_whose_header_begins_with_solid_is_read(tmp_path: Path) -> None:
    path = write_model(tmp_path, "a.stl", binary_stl())
    assert simulated_size(path) == pytest.approx(SIZE, abs=0.01)
    ((name, points),) = mesh_parts(tmp_path / "a.stl")
    assert name == "a" and np.abs(points.reshape(-1, 3, 3) - corners()).max() < 1e-7


@pytest.mark.parametrize(("unit", "factor"), [("1", 1.0), ("0.5", 0.5)])
@pytest.mark.parametrize("up", ["Z_UP", "Y_UP"])
def test_the_unit_of_collada_counts_and_its_up_axis_does_not(
    tmp_path: Path, unit: str, factor: float, up: str
) -> None:
    path = write_model(tmp_path, "a.dae", collada(unit, up))
    assert simulated_size(path) == pytest.approx([factor * side for side in SIZE], abs=0.01)


def test_bullet_reads_a_file_of_the_same_name_from_its_cache(tmp_path: Path) -> None:
    """The reason why models and meshes are written under names that are used once."""
    client = Client()
    sizes = []
    for factor in (1.0, 2.0):
        mesh = Mesh.box([factor * side for side in SIZE])
        (tmp_path / "a.obj").write_text(wavefront([Piece(Convex(mesh))]))
        shape = client.createCollisionShape(client.GEOM_MESH, fileName=str(tmp_path / "a.obj"))
        low, high = client.getAABB(client.createMultiBody(0, shape))
        sizes.append(np.subtract(high, low).tolist())
    assert sizes[0] == pytest.approx(SIZE, abs=0.1) and sizes[1] == sizes[0]
    client.close()


@pytest.mark.parametrize(
    ("mesh", "content", "reason"),
    [
        ("a.obj", b"", "no faces"),
        ("a.obj", OBJ.encode(), "no faces"),
        ("a.obj", f"{OBJ}f 1 2 300000000\n".encode(), "names vertex 300000000 of 4"),
        ("a.obj", f"{OBJ.replace('1', 'nan')}f 1 2 3\n".encode(), "not finite"),
        ("a.obj", b"v 1 2\nf 1 1 1\n", "a.obj"),
        ("a.stl", b"", "a.stl"),
        ("a.stl", b"\0" * 10, "length"),
        ("a.stl", binary_stl()[:-7], "a.stl"),
        ("a.stl", binary_stl(b"")[:-7], "length"),
        ("a.stl", ascii_stl()[:-100], "not triangles"),
        ("a.stl", b"\0" * 84, "no faces"),
        ("a.dae", b"<COLLADA", "a.dae"),
        ("a.dae", b"<COLLADA/>", "no <triangles>"),
        ("a.dae", collada(positions="nan " * 24), "not finite"),
        ("a.ply", b"ply\n", "OBJ or STL, got '.ply'"),
        ("a.glb", b"glTF", "OBJ or STL, got '.glb'"),
    ],
)
def test_a_mesh_that_bullet_cannot_read_is_refused(
    tmp_path: Path, mesh: str, content: bytes, reason: str
) -> None:
    path = write_model(tmp_path, mesh, content)
    with pytest.raises(ValueError, match="mesh must be a readable OBJ, STL or COLLADA file") as error:
        read_urdf(path)
    assert str(tmp_path / mesh) in str(error.value) and reason in str(error.value)


def test_a_mesh_is_checked_again_after_a_change(tmp_path: Path) -> None:
    path = write_model(tmp_path, "a.obj", f"{OBJ}f 1 2 3\nf 2 3 4\n".encode())
    read_urdf(path)
    (tmp_path / "a.obj").write_text(f"{OBJ}f 1 2 9\nf 2 3 44\n")
    with pytest.raises(ValueError, match="names vertex 9 of 4"):
        read_urdf(path)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("<robot", "which is not XML"),
        ('<mujoco model="arm"/>', "an MJCF file"),
        ("<sdf/>", "an SDF file"),
        ("<html/>", "root element is <html>"),
        ('<robot xmlns:xacro="http://ros.org/wiki/xacro"><xacro:arm/></robot>', "a xacro file"),
        ('<robot><joint><origin quat_xyzw="0 0 0 1"/></joint></robot>', "quat_xyzw of URDF 1.1"),
    ],
)
def test_other_formats_than_urdf_are_named(tmp_path: Path, text: str, reason: str) -> None:
    (tmp_path / "arm.urdf").write_text(text)
    with pytest.raises(ValueError, match=reason) as error:
        read_urdf(tmp_path / "arm.urdf")
    assert str(tmp_path / "arm.urdf") in str(error.value)


def test_extensions_of_other_programs_need_no_declaration(tmp_path: Path) -> None:
    path = write_model(tmp_path, "a.stl", ascii_stl())
    text = path.read_text().replace("<visual>", '<drake:proximity/><visual drake:acceleration="3">')
    path.write_text("\n" + '<?xml version="1.0"?>' + text)
    assert simulated_size(path) == pytest.approx(SIZE, abs=0.01)


def test_a_model_that_bullet_refuses_is_named() -> None:
    def load() -> ElementTree.Element:
        root = KUKA.load()
        for mesh in root.iter("mesh"):
            mesh.set("filename", "/nowhere/a.obj")
        return root

    client = Client()
    with pytest.raises(ValueError, match="model 'lost' must be a URDF that PyBullet loads"):
        load_urdf(client, "lost", replace(KUKA, name="lost", load=load).xml, Pose((0.0, 0.0, 0.0)))
    client.close()


# What Bullet does with links


def test_inertia_of_a_robots_link_is_that_of_the_box_around_its_collision_shape() -> None:
    box = f'<collision><geometry><box size="{" ".join(map(str, SIZE))}"/></geometry></collision>'
    joint = '<joint name="j" type="continuous"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/></joint>'
    links = "".join(f'<link name="{name}">{INERTIAL}{box}</link>' for name in ("a", "b"))
    client = Client()
    body, _ = load_urdf(client, "two", f'<robot name="two">{links}{joint}</robot>', Pose((0.0, 0.0, 0.0)))
    x, y, z = (side * side for side in SIZE)
    expected = [(y + z) / 12.0, (x + z) / 12.0, (x + y) / 12.0]
    assert client.getDynamicsInfo(body, 0)[2] == pytest.approx(expected, rel=0.1)  # Bullet adds a margin
    client.close()


@pytest.mark.parametrize("mass", [0.0, 0.3], ids=["fixed", "free"])
def test_parts_of_a_body_do_not_collide_with_it_or_with_each_other(mass: float) -> None:
    def part(name: str) -> Slide:
        return Slide(name, (Piece(Box((0.04, 0.04, 0.04))),), 0.1, axis=(1.0, 0.0, 0.0), limits=(-0.1, 0.1))

    spec = BodySpec("body", (Piece(Box((0.05, 0.05, 0.05))),), mass, slides=(part("one"), part("other")))
    world = World(PHYSICS_MODES["fast"])
    world.add_plane(FLOOR)
    body = world.add(spec, Pose((0.0, 0.0, 0.5)))
    world.seal()
    world.begin()
    world.step(5)
    assert not world.client.getContactPoints(body.id, body.id)
    world.close()
