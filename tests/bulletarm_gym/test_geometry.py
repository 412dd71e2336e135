"""The rasterizer of heightmaps and rotations, compared with formulas, SciPy and a ray caster."""

import itertools
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bulletarm_gym.geometry import Mesh, Pose, join, matrix, multiply, quaternion, rotate, wrap_angle
from bulletarm_gym.geometry.poses import euler_angles
from bulletarm_gym.observations.rasterizer import Window, ZBuffer

EXTENT, SIZE = 0.45, 128
RESOLUTION = EXTENT / SIZE
CENTRE = (0.45, 0.0)
QUARTER_TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def draw(meshes, positions, rotations=None, visible=None, window=()):
    count, (centre, extent, size) = len(meshes), window or (CENTRE, EXTENT, SIZE)
    rotations = np.tile(np.eye(3), (count, 1, 1)) if rotations is None else np.ascontiguousarray(rotations)
    visible = np.ones(count, bool) if visible is None else np.asarray(visible)
    positions = np.asarray(positions, float).reshape(count, 3)
    return ZBuffer(meshes).draw(positions, rotations.reshape(-1, 3, 3), visible, Window(centre, extent, size))


def pixel_centres(size=SIZE):
    steps = (np.arange(size) + 0.5) * (EXTENT / size) - EXTENT / 2
    return np.meshgrid(CENTRE[0] + steps, CENTRE[1] + steps, indexing="ij")


def bowl(sides=24):
    """Return a body that is not convex: a flat-bottomed ring with a sloping inside."""
    profile = [(0.02, -0.02), (0.05, -0.02), (0.06, 0.03), (0.052, 0.03), (0.03, -0.01)]
    angles = 2 * np.pi * np.arange(sides) / sides
    vertices = [(r * math.cos(angle), r * math.sin(angle), z) for angle in angles for r, z in profile]
    count, faces = len(profile), []
    for side in range(sides):
        for k in range(count):
            a, b = (side * count + step % count for step in (k, k + 1))
            c, d = ((side + 1) % sides * count + step % count for step in (k, k + 1))
            faces += [(a, c, b), (b, c, d)]
    return Mesh.of(vertices, faces)


def pyramid(half, apex):
    base = [(-half, -half, 0), (half, -half, 0), (half, half, 0), (-half, half, 0), (0, 0, apex)]
    return Mesh.of(base, [(0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4), (0, 2, 1), (0, 3, 2)])


def clutter(seed):
    """Return convex and hollow bodies at random poses in each other."""
    rng = np.random.default_rng(seed)
    handle = join([Mesh.box((0.08, 0.03, 0.03)), Mesh.box((0.03, 0.03, 0.1), centre=(0.03, 0, 0.02))])
    meshes = [bowl(), bowl(7), handle, pyramid(0.05, 0.06), Mesh.box((0.03, 0.09, 0.03))]
    count = len(meshes)
    positions = np.column_stack([rng.uniform(-0.15, 0.15, (count, 2)), rng.uniform(0.02, 0.06, count)])
    return meshes, positions + np.array([*CENTRE, 0.0]), Rotation.random(count, rng).as_matrix()


@pytest.mark.parametrize("size", [1, 15, 128])
def test_box(size):
    """Rows grow with x, columns with y."""
    image = draw([Mesh.box((0.06, 0.1, 0.04))], (0.47, 0.03, 0.02), window=(CENTRE, EXTENT, size))
    x, y = pixel_centres(size)
    inside = (np.abs(x - 0.47) < 0.03) & (np.abs(y - 0.03) < 0.05)
    assert image.shape == (size, size) and image.dtype == np.float32
    np.testing.assert_array_equal(image, np.where(inside, np.float32(0.04), 0))


@pytest.mark.parametrize("size", [64, 75])
@pytest.mark.parametrize("upright", [True, False])
def test_quarter_turn_of_the_world_is_rot90(size, upright):
    """(x, y) -> (-y, x) rotates the image by np.rot90 with k = 1, bit for bit."""
    meshes, positions, rotations = clutter(2)
    if upright:
        rotations = Rotation.from_rotvec([(0.0, 0.0, 0.3 * k) for k in range(5)]).as_matrix()
    image = draw(meshes, positions, rotations, window=(CENTRE, EXTENT, size))
    centre = np.array([*CENTRE, 0.0])
    for k in (1, 2, 3):
        positions, centre = positions @ QUARTER_TURN.T, QUARTER_TURN @ centre
        rotations = QUARTER_TURN @ rotations
        again = draw(meshes, positions, rotations, window=(centre[:2], EXTENT, size))
        np.testing.assert_array_equal(again, np.rot90(image, k=k))


def test_edges_through_pixel_centres_belong_to_the_face():
    box = Mesh.box((21 * RESOLUTION, 21 * RESOLUTION, 0.1))
    image = draw([box], (*CENTRE, 0.05))
    assert np.count_nonzero(image) == 22 * 22
    np.testing.assert_array_equal(image, draw([box], (*CENTRE, 0.05), QUARTER_TURN))


@pytest.mark.parametrize("tilt", [0.0, 0.3])
def test_no_holes_between_triangles(tilt):
    """A plate of triangles with corners on, next to and between pixel centres hides the floor."""
    rng, cells = np.random.default_rng(3), 60
    steps = (np.arange(cells + 1) - cells / 2) * 2 * RESOLUTION
    x, y = np.meshgrid(steps + RESOLUTION / 2, steps + RESOLUTION / 2, indexing="ij")
    jitter = rng.choice([0.0, 0.0, 1e-9, 0.3, 0.9], (2, *x.shape)) * RESOLUTION
    points = np.stack([x + jitter[0], y + jitter[1], np.zeros_like(x)], axis=-1).reshape(-1, 3)
    corner = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    across = np.stack([corner, corner + cells + 1, corner + cells + 2], axis=1)
    along = np.stack([corner, corner + cells + 2, corner + 1], axis=1)
    plate = Mesh.of(points, np.concatenate([across, along]))
    image = draw([plate], (*CENTRE, 0.2), Rotation.from_rotvec((0.0, tilt, 0.0)).as_matrix())
    expected = 0.2 - math.tan(tilt) * (pixel_centres()[0] - CENTRE[0])
    np.testing.assert_allclose(image[8:-8, 5:-5], expected[8:-8, 5:-5], atol=1e-6)


def test_meshes_outside_the_window_or_not_finite_are_not_drawn():
    box = Mesh.box((0.1, 0.1, 0.1), centre=(0.3, 0.0, 0.0))
    assert draw([box], (0.15, 0, 0)).any()
    outside = ((10, 0, 0), (0.45, -0.4, 0), (-1e30, 1e30, 0))
    for position in (*outside, (math.nan, 0, 0), (0.1, math.inf, 0), (0.15, 0, math.nan)):
        assert not draw([box], position).any(), position
    assert not draw([box], (0.15, 0, 0), np.full((3, 3), math.nan)).any()


@pytest.mark.parametrize("seed", range(2))
def test_agrees_with_a_ray_caster(seed):
    """Embree casts one ray down through every pixel centre, in single precision."""
    scenes = pytest.importorskip("embreex.rtcore_scene")
    construction = pytest.importorskip("embreex.mesh_construction")
    meshes, positions, rotations = clutter(seed)
    posed = [(m.vertices @ r.T + p)[m.faces] for m, p, r in zip(meshes, positions, rotations, strict=True)]
    scene = scenes.EmbreeScene(robust=True)
    construction.TriangleMesh(scene, np.concatenate(posed).astype(np.float32))
    x, y = pixel_centres()
    origins = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3).astype(np.float32)
    down = np.tile(np.float32([0, 0, -1]), (len(origins), 1))
    expected = np.maximum(
        1 - scene.run(origins, down, query="DISTANCE").reshape(x.shape).astype(np.float64), 0
    )
    error = np.abs(draw(meshes, positions, rotations) - expected)
    assert np.count_nonzero(expected) > 1000
    assert np.mean(error > 1e-5) < 1e-3, "where a ray grazes an edge it may pass on the other side"
    assert np.median(error[expected > 0]) < 2e-7


def test_rotations_agree_with_scipy():
    rng = np.random.default_rng(0)
    rotations = [Rotation.random(random_state=rng).as_quat().tolist() for _ in range(20)]
    poses = [Pose(tuple(rng.uniform(-1, 1, 3).tolist()), tuple(rotation)) for rotation in rotations]
    for one, other in itertools.pairwise(poses):
        theirs = Rotation.from_quat(one.orientation)
        both = theirs * Rotation.from_quat(other.orientation)
        assert abs(np.dot(multiply(one.orientation, other.orientation), both.as_quat())) == pytest.approx(1.0)
        assert np.allclose(matrix(one.compose(other)), both.as_matrix())
        assert one.compose(one.inverse()).position == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)
        point = one.compose(other).transform((0.3, -0.2, 0.5))
        assert point == pytest.approx(one.transform(other.transform((0.3, -0.2, 0.5))))
        assert rotate(one.orientation, other.position) == pytest.approx(theirs.apply(other.position))
        assert one.yaw == pytest.approx(theirs.as_euler("xyz")[2])
        assert euler_angles(one.orientation) == pytest.approx(theirs.as_euler("xyz"))
        assert one.tilt == pytest.approx(math.acos(theirs.apply([0, 0, 1])[2]), abs=1e-6)
        assert abs(np.dot(quaternion(theirs.as_matrix()), one.orientation)) == pytest.approx(1.0)


@pytest.mark.parametrize("period", [2 * math.pi, math.pi, math.pi / 2])
def test_wrap_angle(period):
    edges = [np.nextafter(sign * period / 2.0, toward) for sign in (-1.0, 1.0) for toward in (-9.0, 9.0)]
    for angle in [*np.linspace(-20.0, 20.0, 101).tolist(), *edges]:
        wrapped = wrap_angle(angle, period)
        assert -period / 2 <= wrapped < period / 2
        assert math.remainder(wrapped - angle, period) == pytest.approx(0.0, abs=1e-9)
