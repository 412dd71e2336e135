"""The objects of the open-loop tasks: sizes of the paper, true inertia, still where they are put."""

import math
from collections.abc import Iterator

import numpy as np
import pytest

from bulletarm_gym.geometry import Pose
from bulletarm_gym.objects import BodySpec, create
from bulletarm_gym.objects.blocks import DRAWINGS, improvise_block, improvise_blocks, improvise_bricks
from bulletarm_gym.objects.catalogue import KINDS
from bulletarm_gym.simulation import World
from bulletarm_gym.simulation.state import PHYSICS_MODES
from bulletarm_gym.surfaces.flat import FLOOR

SIZES = {
    # Kind: default scale of its task, side lengths along x, y, z (m), mass (kg).
    "cube": (0.6, (0.03, 0.03, 0.03), 0.1),
    "triangle": (0.6, (0.03, 0.03, 0.03), 0.1),
    "brick": (0.6, (0.03, 0.12, 0.03), 0.1),
    "roof": (0.6, (0.03, 0.12, 0.03), 0.1),
    "cylinder": (0.6, (0.03228, 0.03228, 0.036), 0.1),
    "packing_block_0": (0.8, (0.04, 0.08, 0.04), 0.1),
    "packing_block_1": (0.8, (0.04, 0.08, 0.04), 0.1),
    "packing_block_2": (0.8, (0.04, 0.04, 0.02), 0.1),
    "packing_block_3": (0.8, (0.04, 0.08, 0.02), 0.1),
    "packing_block_4": (0.8, (0.04, 0.04, 0.04), 0.1),
    "packing_block_5": (0.8, (0.04, 0.08, 0.04), 0.1),
    "packing_block_6": (0.8, (0.04, 0.04, 0.02), 0.1),
    "packing_bin": (1.0, (0.176, 0.144, 0.08), 0.0),
    "bottle_tray": (1.0, (0.24, 0.16, 0.05), 0.0),
    "palletizing_box": (0.8, (0.045, 0.072, 0.045), 0.1),
    "pallet": (1.0, (0.232, 0.192, 0.03), 0.0),
    "swab": (0.6, (0.07, 0.01, 0.01), 0.011),
    "tube": (0.6, (0.08, 0.017, 0.017), 0.11),
    "used_tube": (0.6, (0.08, 0.017, 0.017), 0.11),
    "new_tube_box": (1.0, (0.17, 0.2, 0.005), 0.0),
    "test_area": (1.0, (0.125, 0.3, 0.01), 0.0),
    "used_tube_box": (1.0, (0.12, 0.1, 0.04), 0.0),
}
BOTTLE, IMPROVISE = 0.8, 0.6


def _all() -> list[BodySpec]:
    scales = {kind: scale for kind, (scale, *_) in SIZES.items()}
    made = [create(kind, kind, scales.get(kind, 0.7)) for kind in KINDS]
    return [*made, *improvise_bricks("improvise brick", 0.6, 8), *improvise_blocks("random", 0.6, series=1)]


SPECS = _all()


@pytest.mark.parametrize("kind", SIZES)
def test_default_scales_give_the_papers_sizes(kind: str) -> None:
    scale, extents, mass = SIZES[kind]
    spec = create(kind, "it", scale)
    assert spec.extents == pytest.approx(extents, abs=1e-9)
    assert spec.mass == mass
    assert np.allclose(create(kind, "it", 0.5 * scale).extents, np.array(extents) / 2.0)


def test_eight_bottles_of_about_5_by_5_by_14_cm() -> None:
    bottles = [create(f"bottle_{number}", str(number), BOTTLE) for number in range(8)]
    sizes = np.array([bottle.extents for bottle in bottles])
    assert np.abs(sizes - (0.05, 0.05, 0.14)).max() < 0.008
    assert len({tuple(row) for row in sizes.round(6).tolist()}) == 8
    assert np.abs(sizes.mean(axis=0) - (0.05, 0.05, 0.14)).max() < 0.001
    assert all(bottle.mass == 0.2 for bottle in bottles)


def test_nineteen_blocks_of_one_layer() -> None:
    cells = {frozenset(_cells(drawing)) for drawing in DRAWINGS}
    assert len(cells) == 19
    assert all(_connected(set(shape)) for shape in cells)
    columns_and_rows = [(len(d.split()[0]), len(d.split())) for d in DRAWINGS]
    assert {size: columns_and_rows.count(size) for size in columns_and_rows} == {
        (3, 3): 6, (3, 4): 10, (4, 4): 2, (3, 5): 1,
    }  # fmt: skip
    for number in range(19):
        spec = improvise_block("it", IMPROVISE, number)
        volume = sum(math.prod(piece.shape.extents) for piece in spec.pieces)  # type: ignore[union-attr]
        cell = 0.02 * IMPROVISE * min(1.25, 5.2 / len(DRAWINGS[number].split()[0]))
        assert volume == pytest.approx(len(_cells(DRAWINGS[number])) * cell**2 * spec.extents[2])
        assert np.allclose(spec.mass_properties[0].position, 0.0, atol=1e-12)


def test_random_sizes_stay_in_their_ranges_and_repeat() -> None:
    blocks = [spec for series in range(4) for spec in improvise_blocks("it", IMPROVISE, series)]
    sizes = np.array([spec.extents for spec in blocks])
    assert sizes[:, 0].max() <= 0.063 and sizes[:, :2].min() >= 0.036 and sizes[:, 1].max() <= 0.091
    assert 0.0264 <= sizes[:, 2].min() and sizes[:, 2].max() <= 0.02904 + 1e-9
    again = [spec for series in range(4) for spec in improvise_blocks("it", IMPROVISE, series)]
    assert [spec.extents for spec in again] == [spec.extents for spec in blocks]
    bricks = np.array([spec.extents for spec in improvise_bricks("it", IMPROVISE, 50)])
    low, high = bricks.min(axis=0), bricks.max(axis=0)
    assert np.allclose(low, (0.025, 0.1, 0.02), rtol=0.1) and np.allclose(
        high, (0.035, 0.14, 0.035), rtol=0.1
    )
    assert (low >= (0.025, 0.1, 0.02)).all() and (high <= (0.035, 0.14, 0.035)).all()


@pytest.mark.parametrize("spec", SPECS, ids=lambda spec: spec.name)
def test_pieces_are_convex_closed_and_few(spec: BodySpec) -> None:
    assert len(spec.pieces) <= (25 if spec.name == "bowl" else 9)
    for piece in spec.pieces:
        mesh = piece.mesh
        corners = mesh.vertices[mesh.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert np.linalg.norm(normals, axis=1).min() > 0.0
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        offsets = np.einsum("fi,fi->f", normals, corners[:, 0])
        assert (mesh.vertices @ normals.T - offsets).max() < 2e-4
        edges = {(int(a), int(b)) for f in mesh.faces for a, b in zip(f, np.roll(f, -1), strict=True)}
        assert all((b, a) in edges for a, b in edges)
        assert np.linalg.det(corners).sum() > 0.0, "volume"


@pytest.mark.parametrize("spec", [spec for spec in SPECS if spec.mass > 0.0], ids=lambda spec: spec.name)
def test_inertia_is_that_of_a_body(spec: BodySpec) -> None:
    centre, moments = spec.mass_properties
    assert min(moments) > 0.0 and sum(moments) > 2.0 * max(moments)
    assert max(moments) < spec.mass * max(spec.extents) ** 2 / 4.0
    low, high = spec.mesh.bounds
    assert (low < centre.position).all() and (centre.position < high).all()


@pytest.fixture(scope="module")
def rested() -> Iterator[dict[str, tuple[Pose, Pose]]]:
    """Poses of all objects, put on the ground apart from each other, and after a second."""
    world = World(PHYSICS_MODES["fast"])
    world.add_plane(FLOOR)
    bodies, before = [], []
    for index, spec in enumerate(SPECS):
        x, y = divmod(index, 9)
        pose = Pose((0.4 * x, 0.4 * y, -float(spec.mesh.bounds[0, 2])))
        bodies.append(world.add(spec, pose))
        before.append(pose)
    world.seal()
    world.begin()
    world.step(240)
    world.end()
    yield {body.spec.name: (pose, world.poses[body.index]) for body, pose in zip(bodies, before, strict=True)}
    world.close()


@pytest.mark.parametrize("name", [spec.name for spec in SPECS])
def test_they_rest_where_they_are_put(rested: dict[str, tuple[Pose, Pose]], name: str) -> None:
    before, after = rested[name]
    lying = name in ("swab", "tube", "used_tube")  # thick at one end, so they lean until the other rests
    assert math.dist(before.position, after.position) < 0.003
    assert after.tilt - before.tilt < math.radians(7.0 if lying else 1.0)


def _cells(drawing: str) -> set[tuple[int, int]]:
    rows = drawing.split()
    return {(x, y) for y, row in enumerate(rows) for x, cell in enumerate(row) if cell == "#"}


def _connected(cells: set[tuple[int, int]]) -> bool:
    reached = {next(iter(cells))}
    for _ in cells:
        near = {(x + dx, y + dy) for x, y in reached for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1))}
        reached |= near & cells
    return reached == cells
