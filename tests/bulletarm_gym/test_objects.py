"""The 86 objects, the tray, objects from files."""

import shutil
from collections.abc import Callable
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.geometry import Mesh
from bulletarm_gym.objects.catalogue import object_set
from bulletarm_gym.objects.containers import FLOOR_HEIGHT, WALL_HEIGHT, tray_floor, tray_walls
from bulletarm_gym.objects.files import GREY, convex_hull, load_folder
from bulletarm_gym.objects.graspables import FAMILIES, FRICTION, MASS, graspables
from bulletarm_gym.simulation.shapes import Box, Piece, wavefront


def _planes(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return normals, np.einsum("fi,fi->f", normals, corners[:, 0])


def test_there_are_86_with_names_of_their_own() -> None:
    specs = graspables()
    assert len(specs) == sum(count for _, count, *_ in FAMILIES) == 86
    assert len({spec.name for spec in specs}) == 86
    assert object_set(None) is specs


def test_pieces_are_convex_closed_and_few() -> None:
    for spec in graspables():
        assert len(spec.pieces) <= 9
        for piece in spec.pieces:
            normals, offsets = _planes(piece.mesh)
            assert (piece.mesh.vertices @ normals.T - offsets).max() < 1e-3, spec.name
            edges = {
                (int(a), int(b)) for f in piece.mesh.faces for a, b in zip(f, np.roll(f, -1), strict=True)
            }
            assert all((b, a) in edges for a, b in edges), spec.name


def test_sizes_fit_gripper_and_tray() -> None:
    sides = np.array([sorted(spec.extents) for spec in graspables()])
    assert 0.014 <= sides[:, 0].min() and sides[:, 0].max() <= 0.065
    assert sides[:, 2].max() <= 0.16
    assert np.abs(np.median(sides, axis=0) - (0.042, 0.055, 0.095)).max() < 0.01


def test_inertia_is_that_of_the_shape() -> None:
    for spec in graspables():
        _, moments = spec.mass_properties
        assert min(moments) > 0.0 and sum(moments) > 2.0 * max(moments)
    box = next(spec for spec in graspables() if spec.name == "box_0")
    x, y, z = (side * side for side in box.extents)
    expected = sorted(box.mass / 12.0 * pair for pair in (y + z, x + z, x + y))
    assert sorted(box.mass_properties[1]) == pytest.approx(expected)


def test_tray_floor_meets_its_walls() -> None:
    floor, walls = tray_floor(0.25), tray_walls(0.25)
    assert floor.extents == pytest.approx((0.22, 0.22, FLOOR_HEIGHT))
    assert walls.friction == 0.0
    vertices = walls.mesh.vertices
    assert vertices[:, 2].max() == pytest.approx(WALL_HEIGHT)
    assert np.abs(vertices[:, :2]).max(axis=1).min() == pytest.approx(0.11)


def test_hull_of_a_cloud() -> None:
    points = np.random.default_rng(0).normal(size=(60, 3))
    hull = convex_hull(points)
    normals, offsets = _planes(hull)
    assert (points @ normals.T - offsets).max() < 1e-6
    assert len(hull.vertices) - 3 * len(hull.faces) / 2 + len(hull.faces) == 2


@pytest.mark.parametrize(
    ("points", "reason"),
    [
        ([[0.0, 0.0, 0.0]] * 5, "enclose no volume"),
        ([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]], "plane"),
        ([[0.0, 0.0, float("nan")]] * 4, "not finite"),
    ],
)
def test_hull_refuses_what_has_no_volume(points: list[list[float]], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        convex_hull(points)


def test_folder_of_obj_files(tmp_path: Path) -> None:
    chosen = [spec for spec in graspables() if spec.name in ("cup_0", "box_1")]
    for spec in chosen:
        (tmp_path / f"{spec.name}.obj").write_text(wavefront(spec.pieces))
    loaded = object_set(str(tmp_path))
    assert [spec.name for spec in loaded] == ["box_1.obj", "cup_0.obj"]
    for before, after in zip(sorted(chosen, key=lambda spec: spec.name), loaded, strict=True):
        assert len(after.pieces) == len(before.pieces)
        assert after.extents == pytest.approx(before.extents)


def test_random_urdfs_of_pybullet(tmp_path: Path) -> None:
    pybullet_data = pytest.importorskip("pybullet_data")
    source = Path(pybullet_data.getDataPath()) / "random_urdfs"
    for name in ("000", "001"):
        shutil.copytree(source / name, tmp_path / name)
    assert [spec.name for spec in load_folder(str(tmp_path))] == ["000/000.urdf", "001/001.urdf"]
    shutil.copytree(source / "168", tmp_path / "168")
    with pytest.warns(UserWarning, match=r"^1 of 3 .*168\.urdf cannot be loaded: a vertex is not finite"):
        specs = load_folder(str(tmp_path))
    assert [spec.name for spec in specs] == ["000/000.urdf", "001/001.urdf"]
    with pytest.raises(ValueError, match=r"168\.urdf cannot be loaded: a vertex is not finite"):
        load_folder(str(tmp_path / "168"))


def test_symbolic_links_are_followed_once(tmp_path: Path) -> None:
    kept, linked = tmp_path / "kept", tmp_path / "linked"
    (kept / "cups").mkdir(parents=True)
    linked.mkdir()
    (cup,) = (spec for spec in graspables() if spec.name == "cup_0")
    (kept / "cups" / "cup.obj").write_text(wavefront(cup.pieces))
    (linked / "cups").symlink_to(kept / "cups")
    (linked / "one.obj").symlink_to(kept / "cups" / "cup.obj")
    (kept / "cups" / "again").symlink_to(kept / "cups")
    assert [spec.name for spec in load_folder(str(linked))] == ["cups/cup.obj", "one.obj"]


@pytest.mark.parametrize(
    ("name", "text", "reason"),
    [
        ("a.obj", "v 0 0 0\n", "no faces"),
        ("a.obj", "v 0 0 0\nf 1 2 3\n", "names vertex 2 of 1"),
        ("a.urdf", "<robot", "cannot be loaded"),
        ("a.urdf", "<robot><link/><link/></robot>", "2 links"),
        ("a.txt", "", "no .obj, no .stl and no .urdf"),
    ],
)
def test_bad_files_are_named(tmp_path: Path, name: str, text: str, reason: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=reason):
        load_folder(str(tmp_path))


# Files of users

BOX = '<geometry><box size="0.04 0.05 0.06"/></geometry>'


def write_link(path: Path, inside: str = "", outside: str = "") -> None:
    """Write a URDF of one box."""
    path.write_text(
        f'<robot name="a">{outside}<link name="a"><collision>{BOX}</collision>{inside}</link></robot>'
    )


def write_stl(path: Path, ascii_text: bool) -> None:
    """Write a box of 4 x 5 x 6 cm as STL."""
    mesh = Mesh.box((0.04, 0.05, 0.06))
    corners = mesh.vertices[mesh.faces]
    if ascii_text:
        facets = ["".join(f"vertex {x:e} {y:e} {z:e}\n" for x, y, z in facet.tolist()) for facet in corners]
        body = "".join(f"facet normal 0 0 0\nouter loop\n{text}endloop\nendfacet\n" for text in facets)
        path.write_text(f"solid box\n{body}endsolid box\n")
    else:
        records = np.zeros(
            len(corners), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")]
        )
        records["corners"] = corners
        path.write_bytes(b"solid".ljust(80) + len(corners).to_bytes(4, "little") + records.tobytes())


def _coloured(rgba: str) -> str:
    return f'<visual>{BOX}<material name="paint"><color rgba="{rgba}"/></material></visual>'


def test_mass_and_friction_of_a_urdf_are_used(tmp_path: Path) -> None:
    contact = '<contact><lateral_friction value="0.8"/><rolling_friction value="0.002"/></contact>'
    write_link(tmp_path / "a.urdf", f'<inertial><mass value="1.2"/></inertial>{contact}')
    write_link(tmp_path / "b.urdf")
    one, other = load_folder(str(tmp_path))
    assert (one.mass, one.friction, one.rolling_friction, one.spinning_friction) == (1.2, 0.8, 0.002, 0.0)
    assert (other.mass, other.friction) == (MASS, FRICTION)
    assert sum(one.mass_properties[1]) == pytest.approx(1.2 / 6.0 * (0.04**2 + 0.05**2 + 0.06**2))


@pytest.mark.parametrize(
    ("inside", "reason"),
    [
        ('<inertial><mass value="0"/></inertial>', "mass must be 0.001 to 5.0 kg, got 0"),
        ('<inertial><mass value="150"/></inertial>', "mass must be 0.001 to 5.0 kg, got 150"),
        ('<contact><lateral_friction value="-1"/></contact>', "friction of .* must be .* got -1"),
        ("<inertial><mass/></inertial>", "value of <mass> must be a number, got ''"),
        (_coloured("1 0 0"), "rgba of <color> must be 4 numbers, got '1 0 0'"),
        (_coloured("255 0 0 255"), "rgba of <color> must be from 0 to 1, got '255 0 0 255'"),
    ],
)
def test_impossible_value_of_a_urdf_is_refused(tmp_path: Path, inside: str, reason: str) -> None:
    write_link(tmp_path / "a.urdf", inside)
    with pytest.raises(ValueError, match=rf"a\.urdf cannot be loaded: .*{reason}"):
        load_folder(str(tmp_path))


def test_cylinder_of_a_urdf_has_its_size(tmp_path: Path) -> None:
    origin = '<origin xyz="0 0 0.1" rpy="1.5707963267948966 0 0"/>'
    shape = '<geometry><cylinder radius="0.02" length="0.1"/></geometry>'
    link = f'<link name="a"><collision>{origin}{shape}</collision></link>'
    (tmp_path / "a.urdf").write_text(f'<robot name="a">{link}</robot>')
    (spec,) = load_folder(str(tmp_path))
    assert spec.extents == pytest.approx((0.04, 0.1, 0.04))
    (tmp_path / "a.urdf").write_text(f'<robot name="a">{link.replace("cylinder", "capsule")}</robot>')
    with pytest.raises(ValueError, match="must be a mesh, a box or a cylinder, got capsule"):
        load_folder(str(tmp_path))


def test_textures_are_named(tmp_path: Path) -> None:
    (tmp_path / "b.obj").write_text(wavefront(graspables()[0].pieces))
    (tmp_path / "b.mtl").write_text("newmtl a\nmap_Kd image.png\n")
    (tmp_path / "c").mkdir()
    write_link(tmp_path / "c" / "a.urdf", f'<visual>{BOX}<material name="m"><texture/></material></visual>')
    with pytest.warns(UserWarning, match="elements that have no effect: map_Kd, texture$"):
        load_folder(str(tmp_path))


def test_unused_contact_properties_are_named(tmp_path: Path) -> None:
    write_link(tmp_path / "a.urdf", '<contact><stiffness value="3"/><contact_erp value="1"/></contact>')
    with pytest.warns(UserWarning, match="elements that have no effect: stiffness$"):
        load_folder(str(tmp_path))


def test_colour_is_that_of_the_visual(tmp_path: Path) -> None:
    materials = "".join(
        f'<material name="{name}"><color rgba="{rgba}"/></material>'
        for name, rgba in (("first", "1 0 0 1"), ("second", "0 1 0 1"))
    )
    write_link(tmp_path / "a.urdf", f'<visual>{BOX}<material name="second"/></visual>', materials)
    write_link(tmp_path / "b.urdf", "", materials)
    one, other = load_folder(str(tmp_path))
    assert one.colour == (0.0, 1.0, 0.0, 1.0) and other.colour == GREY


def test_name_of_a_material_may_have_an_apostrophe(tmp_path: Path) -> None:
    material = '<material name="painter\'s"><color rgba="0 0 1 1"/></material>'
    write_link(tmp_path / "a.urdf", f'<visual>{BOX}<material name="painter\'s"/></visual>', material)
    assert load_folder(str(tmp_path))[0].colour == (0.0, 0.0, 1.0, 1.0)


def test_a_folder_that_does_not_exist_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    env_id = "BulletArm/CloseLoopObjectGrasping-v0"
    with pytest.raises(ValueError, match=f"^object_set must be .*existing folder.*, got '{tmp_path}/none'"):
        gymnasium.make(env_id, object_set=f"{tmp_path}/none")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=f"an existing folder in the working directory {tmp_path} or a list"):
        gymnasium.make(env_id, object_set="none")


@pytest.mark.parametrize("name", ["a.obj", "A.OBJ", "a.stl", "A.STL", "a.urdf", "A.URDF", "ascii.STL"])
def test_extensions_in_capitals_and_small_letters_are_read(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    if path.suffix.lower() == ".obj":
        path.write_text(wavefront(graspables()[0].pieces))
    elif path.suffix.lower() == ".stl":
        write_stl(path, ascii_text=name.startswith("ascii"))
    else:
        write_link(path)
    (spec,) = load_folder(str(tmp_path))
    assert spec.name == name
    if path.suffix.lower() != ".obj":
        assert spec.extents == pytest.approx((0.05, 0.06, 0.04))


def test_files_that_are_not_used_are_named_in_one_warning(tmp_path: Path) -> None:
    write_link(tmp_path / "a.urdf")
    for name in ("loose.obj", "b.dae", "C.PLY", "readme.md", "a.mtl"):
        (tmp_path / name).write_text("")
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "b.urdf").write_text("<robot><link/><link/></robot>")
    (tmp_path / "broken" / "c.obj").write_text("")
    with pytest.warns(UserWarning) as caught:
        load_folder(str(tmp_path))
    (text,) = [str(warning.message) for warning in caught]
    assert (
        "1 of 2 files are left out" in text
        and "broken/b.urdf cannot be loaded: it must have one rigid link, got 2" in text
    )
    assert "4 files are not used: C.PLY, b.dae, broken/c.obj, loose.obj (" in text


def test_meshes_in_a_folder_next_to_a_urdf_are_parts_of_it(tmp_path: Path) -> None:
    meshes = tmp_path / "meshes" / "collision"
    meshes.mkdir(parents=True)
    (meshes / "a.obj").write_text(wavefront(graspables()[0].pieces))
    mesh = '<geometry><mesh filename="meshes/collision/a.obj"/></geometry>'
    (tmp_path / "a.urdf").write_text(
        f'<robot name="a"><link name="a"><collision>{mesh}</collision></link></robot>'
    )
    assert [spec.name for spec in load_folder(str(tmp_path))] == ["a.urdf"]


def test_a_flat_part_is_named(tmp_path: Path) -> None:
    flat = "o label\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 3\nf 2 3 4\n"
    (tmp_path / "a.obj").write_text(flat)
    with pytest.raises(ValueError, match=r"a\.obj cannot be loaded: .*plane.*part 'label'"):
        load_folder(str(tmp_path))


@pytest.mark.parametrize("kind", ["inside out", "open", "two components", "millimetres in a URDF"])
def test_meshes_of_any_faces_have_the_mass_properties_of_the_box(tmp_path: Path, kind: str) -> None:
    lines = wavefront([Piece(Box((0.04, 0.05, 0.06)))]).splitlines()
    faces = [line for line in lines if line.startswith("f ")]
    corners = [[float(text) for text in line.split()[1:4]] for line in lines if line.startswith("v ")]
    if kind == "inside out":
        faces = [" ".join(["f", *reversed(face.split()[1:])]) for face in faces]
    elif kind == "open":
        faces = faces[:-2]
    elif kind == "two components":  # the second one is a smaller box inside the first
        count = len(corners)
        faces += [" ".join(["f", *(str(int(n) + count) for n in face.split()[1:])]) for face in faces]
        corners += [[0.5 * value for value in corner] for corner in corners]
    scale = 1000.0 if kind == "millimetres in a URDF" else 1.0
    vertices = [" ".join(["v", *(repr(scale * value) for value in corner)]) for corner in corners]
    (tmp_path / "a.obj").write_text("\n".join([*vertices, *faces]))
    if scale > 1.0:
        mesh = '<geometry><mesh filename="a.obj" scale="0.001 0.001 0.001"/></geometry>'
        (tmp_path / "a.urdf").write_text(
            f'<robot name="a"><link name="a"><collision>{mesh}</collision></link></robot>'
        )
    (spec,) = load_folder(str(tmp_path))
    frame, moments = spec.mass_properties
    x, y, z = 0.04**2, 0.05**2, 0.06**2
    expected = [spec.mass / 12.0 * value for value in (x + y, x + z, y + z)]
    assert sorted(moments) == pytest.approx(expected, rel=1e-6)
    centre = np.mean([piece.mesh.vertices for piece in spec.pieces], axis=(0, 1))
    assert frame.position == pytest.approx(tuple(centre), abs=1e-9)


def test_a_byte_order_mark_and_continued_lines_are_read(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text(
        "\ufeffv 0 0 0\nv 0.05 0 0\nv 0 0.05 0\nv 0 0 \\\n0.05\nf 1 2 3\nf -4 \\\n-3 -1\n", encoding="utf-8"
    )
    (spec,) = load_folder(str(tmp_path))
    assert spec.extents == pytest.approx((0.05, 0.05, 0.05))


@pytest.mark.parametrize(
    ("size", "is_spanned"),
    [((0.12, 0.12, 0.12), False), ((0.12, 0.12, 0.01), False), ((0.12, 0.05, 0.03), True)],
)
def test_objects_wider_than_the_stroke_are_refused_by_name(
    make: Callable[..., ManipulationEnv], tmp_path: Path, size: tuple[float, float, float], is_spanned: bool
) -> None:
    (tmp_path / "small.obj").write_text(wavefront(graspables()[0].pieces))
    (tmp_path / "other.obj").write_text(wavefront([Piece(Box(size))]))
    parameters = {"object_set": str(tmp_path), "num_objects": 1}
    if is_spanned:
        make("BulletArm/CloseLoopObjectGrasping-v0", **parameters)
        return
    with pytest.raises(ValueError, match=r"^object_set must be .* other\.obj is 0\.12 m wide$"):
        make("BulletArm/CloseLoopObjectGrasping-v0", **parameters)
    make("BulletArm/CloseLoopObjectGrasping-v0", object_scale_range=0.5, **parameters)
