"""The rasterizer of heightmaps against exact geometry and against a ray caster."""

import math

import numpy as np
import pytest

from bulletarm_gym.geometry import Mesh, join
from bulletarm_gym.observations.rasterizer import Window, ZBuffer

EXTENT, SIZE = 0.45, 128
RESOLUTION = EXTENT / SIZE
CENTRE = (0.45, 0.0)
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
QUARTER_TURN = (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))

Poses = tuple[np.ndarray, np.ndarray]


def draw(meshes, positions, quaternions=None, centre=CENTRE, extent=EXTENT, size=SIZE, visible=None):
    count = len(meshes)
    quaternions = np.tile(UPRIGHT, (count, 1)) if quaternions is None else np.asarray(quaternions, float)
    visible = np.ones(count, bool) if visible is None else np.asarray(visible)
    positions = np.asarray(positions, float).reshape(count, 3)
    sensor = ZBuffer(meshes)
    return sensor.draw(positions, quaternions.reshape(count, 4), visible, Window(centre, extent, size))


def pixel_centres(centre=CENTRE, extent=EXTENT, size=SIZE):
    steps = (np.arange(size) + 0.5) * (extent / size) - extent / 2
    return np.meshgrid(centre[0] + steps, centre[1] + steps, indexing="ij")


def rotation_matrix(quaternion):
    x, y, z, w = quaternion
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * skew + 2 * skew @ skew


def random_quaternions(rng, count):
    quaternions = rng.standard_normal((count, 4))
    return quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)


def random_poses(rng: np.random.Generator, count: int) -> Poses:
    positions = np.column_stack([rng.uniform(-0.15, 0.15, (count, 2)), rng.uniform(0.02, 0.06, count)])
    return positions + np.array([*CENTRE, 0.0]), random_quaternions(rng, count)


def bowl(sides: int = 24) -> Mesh:
    """Not convex: a flat-bottomed ring with a sloping inside, closed around its hole."""
    profile = [(0.02, -0.02), (0.05, -0.02), (0.06, 0.03), (0.052, 0.03), (0.03, -0.01)]
    angles = 2 * np.pi * np.arange(sides) / sides
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    vertices = [(r * c, r * s, z) for c, s in ring for r, z in profile]
    count, faces = len(profile), []
    for side in range(sides):
        for k in range(count):
            a, b = side * count + k, side * count + (k + 1) % count
            c, d = (side + 1) % sides * count + k, (side + 1) % sides * count + (k + 1) % count
            faces += [(a, c, b), (b, c, d)]
    return Mesh.of(vertices, faces)


def pyramid(half: float, apex: float) -> Mesh:
    base = [(-half, -half, 0), (half, -half, 0), (half, half, 0), (-half, half, 0), (0, 0, apex)]
    return Mesh.of(base, [(0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4), (0, 2, 1), (0, 3, 2)])


def wedge(length: float, width: float, height: float) -> Mesh:
    """A triangular prism: the roof of the house-building tasks, its ridge along y."""
    x, y = length / 2, width / 2
    points = [(-x, -y, 0), (x, -y, 0), (0, -y, height), (-x, y, 0), (x, y, 0), (0, y, height)]
    return Mesh.of(
        points, [(0, 1, 2), (3, 5, 4), (0, 3, 4), (0, 4, 1), (1, 4, 5), (1, 5, 2), (0, 2, 5), (0, 5, 3)]
    )


@pytest.mark.parametrize("size", [1, 2, 15, 64, 128])
def test_box(size: int) -> None:
    image = draw([Mesh.box((0.06, 0.1, 0.04))], (0.47, 0.03, 0.02), size=size)
    x, y = pixel_centres(size=size)
    inside = (np.abs(x - 0.47) < 0.03) & (np.abs(y - 0.03) < 0.05)
    assert image.shape == (size, size) and image.dtype == np.float32
    np.testing.assert_array_equal(image, np.where(inside, np.float32(0.04), 0))


def test_highest_part_is_seen_in_any_order() -> None:
    rng = np.random.default_rng(1)
    meshes = [Mesh.box(rng.uniform(0.03, 0.1, 3)) for _ in range(6)]
    positions, quaternions = random_poses(rng, 6)
    alone = [draw([m], p, q) for m, p, q in zip(meshes, positions, quaternions, strict=True)]
    np.testing.assert_array_equal(draw(meshes, positions, quaternions), np.max(alone, axis=0))
    np.testing.assert_array_equal(
        draw(meshes[::-1], positions[::-1], quaternions[::-1]), np.max(alone, axis=0)
    )


def test_quarter_turn_of_the_world_is_rot90() -> None:
    """(x, y) -> (-y, x) turns the image by np.rot90 with k = 1, bit for bit."""
    rng = np.random.default_rng(2)
    meshes = [
        Mesh.box((0.05, 0.05, 0.05)),
        Mesh.box((0.03, 0.09, 0.03)),
        wedge(0.06, 0.12, 0.03),
        bowl(),
        bowl(7),
    ]
    for size in (64, 75, 128):
        for upright in (True, False):
            positions, quaternions = random_poses(rng, len(meshes))
            if upright:
                quaternions[:, :2] = 0.0
            image = draw(meshes, positions, quaternions, size=size)
            for k in (1, 2, 3):
                turn = rotation_matrix(QUARTER_TURN).round()
                positions = positions @ turn.T
                quaternions = np.array([turned(q) for q in quaternions])
                x, y, _ = np.linalg.matrix_power(turn, k) @ (*CENTRE, 0)
                again = draw(meshes, positions, quaternions, centre=(x, y), size=size)
                np.testing.assert_array_equal(again, np.rot90(image, k=k))


def turned(quaternion):
    """Quaternion of the rotation followed by a quarter turn about z."""
    x, y, z, w = quaternion
    s = math.sqrt(0.5)
    return (s * (x - y), s * (x + y), s * (z + w), s * (w - z))


def test_edges_through_pixel_centres_are_seen_from_both_sides() -> None:
    """A box whose faces pass exactly through pixel centres covers them, whichever way it is turned."""
    half = 10.5 * RESOLUTION
    image = draw([Mesh.box((2 * half, 2 * half, 0.1))], (*CENTRE, 0.05))
    assert np.count_nonzero(image) == 22 * 22
    np.testing.assert_array_equal(
        image, draw([Mesh.box((2 * half, 2 * half, 0.1))], (*CENTRE, 0.05), QUARTER_TURN)
    )


@pytest.mark.parametrize("tilt", [0.0, 0.3])
def test_no_holes_between_triangles(tilt: float) -> None:
    """A plate of triangles with corners on, next to and between pixel centres shows nothing of the floor."""
    rng = np.random.default_rng(3)
    cells = 60
    steps = (np.arange(cells + 1) - cells / 2) * 2 * RESOLUTION
    x, y = np.meshgrid(steps + RESOLUTION / 2, steps + RESOLUTION / 2, indexing="ij")
    jitter = rng.choice([0.0, 0.0, 1e-9, 0.3, 0.9], (2, *x.shape)) * RESOLUTION
    points = np.stack([x + jitter[0], y + jitter[1], np.zeros_like(x)], axis=-1).reshape(-1, 3)
    corner = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    across = np.stack([corner, corner + cells + 1, corner + cells + 2], axis=1)
    along = np.stack([corner, corner + cells + 2, corner + 1], axis=1)
    plate = Mesh.of(points, np.concatenate([across, along]))
    image = draw([plate], (*CENTRE, 0.2), (0.0, math.sin(tilt / 2), 0.0, math.cos(tilt / 2)))
    seen = image[8:-8, 5:-5]
    x, _ = pixel_centres()
    np.testing.assert_allclose(seen, 0.2 - math.tan(tilt) * (x - CENTRE[0])[8:-8, 5:-5], atol=1e-6)


def test_faces_that_look_down_or_have_no_area_are_not_drawn() -> None:
    line = Mesh.of([(0, 0, 0.1), (0.1, 0.1, 0.1), (0.2, 0.2, 0.1)], [(0, 1, 2), (0, 0, 1), (2, 2, 2)])
    box = Mesh.box((0.1, 0.1, 0.1))
    lid_off = Mesh.of(box.vertices, [f for f in box.faces if box.vertices[f, 2].min() < 0])
    assert not draw([line, lid_off], [(*CENTRE, 0), (*CENTRE, 0.2)]).any()


@pytest.mark.parametrize("shift", [(0, 0), (20, -7), (32, -32)])
def test_window_cuts_what_leaves_it(shift: tuple[int, int]) -> None:
    """A small window shows the part of the large image that lies in it."""
    rng = np.random.default_rng(4)
    meshes = [bowl(), Mesh.box((0.2, 0.1, 0.05)), Mesh.box((2.0, 0.02, 0.02)), wedge(0.06, 0.12, 0.03)]
    positions, quaternions = random_poses(rng, len(meshes))
    large = draw(meshes, positions, quaternions)
    centre = (CENTRE[0] + shift[0] * RESOLUTION, CENTRE[1] + shift[1] * RESOLUTION)
    small = draw(meshes, positions, quaternions, centre=centre, extent=EXTENT / 2, size=SIZE // 2)
    cut = large[32 + shift[0] : 96 + shift[0], 32 + shift[1] : 96 + shift[1]]
    assert np.count_nonzero(cut) > 300
    np.testing.assert_allclose(small, cut, atol=1e-5)


def test_parts_outside_the_window_or_not_finite_leave_no_trace() -> None:
    box = Mesh.box((0.1, 0.1, 0.1), centre=(0.3, 0.0, 0.0))
    poses = [
        (10, 0, 0),
        (0.45, -0.4, 0),
        (-1e30, 1e30, 0),
        (math.nan, 0, 0),
        (0.1, math.inf, 0),
        (0.15, 0, math.nan),
    ]
    assert not draw([box] * len(poses), poses).any()
    assert not draw([box], (0.15, 0, 0), (0.0, 0.0, 0.0, 0.0)).any()
    assert draw([box], (0.15, 0, 0)).any()  # what the last two would show with a pose that is one


def test_invisible_parts_are_not_drawn() -> None:
    boxes = [Mesh.box((0.05, 0.05, 0.04)), Mesh.box((0.1, 0.1, 0.02))]
    positions = [(*CENTRE, 0.02), (*CENTRE, 0.01)]
    second = draw(boxes, positions, visible=[False, True])
    np.testing.assert_array_equal(second, draw(boxes[1:], positions[1:]))
    assert not draw(boxes, positions, visible=[False, False]).any()
    assert not draw([], np.empty((0, 3)), np.empty((0, 4))).any()


def test_equal_input_gives_an_equal_new_image() -> None:
    meshes, positions, quaternions = clutter(5)
    first = draw(meshes, positions, quaternions)
    kept = first.copy()
    draw(meshes, positions + 0.01, quaternions)
    np.testing.assert_array_equal(first, kept)
    np.testing.assert_array_equal(draw(meshes, positions, quaternions), kept)


@pytest.mark.parametrize(("extent", "size"), [(0.0, SIZE), (math.nan, SIZE), (EXTENT, 0)])
def test_window_must_not_be_empty(extent: float, size: int) -> None:
    with pytest.raises(ValueError, match="extent and size must be positive"):
        draw([Mesh.box((0.1, 0.1, 0.1))], (0, 0, 0), extent=extent, size=size)


def clutter(seed: int) -> tuple[list[Mesh], np.ndarray, np.ndarray]:
    """Convex and hollow bodies, lying in each other at random."""
    handle = join([Mesh.box((0.08, 0.03, 0.03)), Mesh.box((0.03, 0.03, 0.1), centre=(0.03, 0, 0.02))])
    meshes = [
        bowl(),
        bowl(9),
        wedge(0.06, 0.12, 0.03),
        pyramid(0.05, 0.06),
        Mesh.box((0.05, 0.05, 0.05)),
        handle,
    ]
    return (meshes, *random_poses(np.random.default_rng(seed), len(meshes)))


def ray_cast(meshes, positions, quaternions) -> np.ndarray:
    """Heights by Embree, one ray down through every pixel centre."""
    scenes = pytest.importorskip("embreex.rtcore_scene")
    construction = pytest.importorskip("embreex.mesh_construction")
    posed = [
        m.vertices @ rotation_matrix(q).T + p for m, p, q in zip(meshes, positions, quaternions, strict=True)
    ]
    triangles = np.concatenate([points[m.faces] for m, points in zip(meshes, posed, strict=True)])
    scene = scenes.EmbreeScene(robust=True)
    construction.TriangleMesh(scene, triangles.astype(np.float32))
    x, y = pixel_centres()
    origins = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3).astype(np.float32)
    down = np.tile(np.float32([0, 0, -1]), (len(origins), 1))
    distance = scene.run(origins, down, query="DISTANCE").reshape(x.shape)
    return np.maximum(1 - distance.astype(np.float64), 0)


@pytest.mark.parametrize("seed", range(2))
def test_agrees_with_a_ray_caster(seed: int) -> None:
    meshes, positions, quaternions = clutter(seed)
    wanted = ray_cast(meshes, positions, quaternions)
    error = np.abs(draw(meshes, positions, quaternions) - wanted)
    # The caster works in single precision: where a ray grazes an edge it may pass on the other side.
    assert np.count_nonzero(wanted) > 2000
    assert np.mean(error > 1e-5) < 1e-3
    assert np.median(error[wanted > 0]) < 2e-7
