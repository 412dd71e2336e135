"""The 86 objects, the tray, objects from files."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from bulletarm_gym.geometry import Mesh
from bulletarm_gym.objects.files import load_folder
from bulletarm_gym.objects.graspables import FAMILIES, graspables
from bulletarm_gym.objects.hull import convex_hull
from bulletarm_gym.objects.sets import object_set
from bulletarm_gym.objects.tray import FLOOR_HEIGHT, WALL_HEIGHT, tray_floor, tray_walls
from bulletarm_gym.simulation.shapes import wavefront


def _planes(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return normals, np.einsum("fi,fi->f", normals, corners[:, 0])


def test_there_are_86_with_names_of_their_own() -> None:
    specs = graspables()
    assert len(specs) == sum(count for _, count, _ in FAMILIES) == 86
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
        ("a.txt", "", "no .obj and no .urdf"),
    ],
)
def test_bad_files_are_named(tmp_path: Path, name: str, text: str, reason: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=reason):
        load_folder(str(tmp_path))
