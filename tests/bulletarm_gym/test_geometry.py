"""Poses and meshes against simple facts and against SciPy."""

import itertools
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bulletarm_gym.geometry import (
    IDENTITY,
    Mesh,
    Pose,
    as_rotvec,
    conjugate,
    from_rotvec,
    join,
    multiply,
    planar_distance,
    rotate,
    wrap_angle,
    yaw_quaternion,
)

ORIGIN = (0.0, 0.0, 0.0)


def random_quaternion(rng: np.random.Generator) -> tuple[float, float, float, float]:
    x, y, z, w = (lambda q: q / np.linalg.norm(q))(rng.standard_normal(4)).tolist()
    return (x, y, z, w)


def random_pose(rng: np.random.Generator) -> Pose:
    x, y, z = rng.uniform(-1, 1, 3).tolist()
    return Pose((x, y, z), random_quaternion(rng))


def random_poses(count: int) -> list[Pose]:
    rng = np.random.default_rng(0)
    return [random_pose(rng) for _ in range(count)]


def test_quarter_turn() -> None:
    turn = yaw_quaternion(math.pi / 2)
    assert rotate(turn, (1.0, 0.0, 0.0)) == pytest.approx((0.0, 1.0, 0.0))
    assert rotate(turn, (0.0, 1.0, 0.0)) == pytest.approx((-1.0, 0.0, 0.0))
    assert rotate(turn, (0.0, 0.0, 1.0)) == pytest.approx((0.0, 0.0, 1.0))


def test_rotations_agree_with_scipy() -> None:
    rotations = pytest.importorskip("scipy.spatial.transform").Rotation
    poses = random_poses(20)
    for one, other in itertools.pairwise(poses):
        mine = multiply(one.orientation, other.orientation)
        theirs = rotations.from_quat(one.orientation) * rotations.from_quat(other.orientation)
        assert np.abs(np.dot(mine, theirs.as_quat())) == pytest.approx(1.0)
        np.testing.assert_allclose(
            rotate(one.orientation, other.position),
            rotations.from_quat(one.orientation).apply(other.position),
            atol=1e-12,
        )
        assert one.yaw == pytest.approx(rotations.from_quat(one.orientation).as_euler("xyz")[2])
        axis = rotations.from_quat(one.orientation).apply([0, 0, 1])
        assert one.tilt == pytest.approx(math.acos(axis[2]), abs=1e-6)


def test_conjugate_undoes() -> None:
    for pose in random_poses(5):
        undone = multiply(pose.orientation, conjugate(pose.orientation))
        assert undone == pytest.approx(IDENTITY)


@pytest.mark.parametrize("yaw", [-3.1, -math.pi / 2, 0.0, 0.4, math.pi / 2, 3.1])
def test_planar_pose(yaw: float) -> None:
    pose = Pose.planar(0.1, 0.2, 0.3, yaw)
    assert pose.yaw == pytest.approx(yaw) and pose.tilt == pytest.approx(0.0, abs=1e-7)
    assert (pose.x, pose.y, pose.z) == (0.1, 0.2, 0.3)
    assert pose.transform((1.0, 0.0, 0.0)) == pytest.approx((0.1 + math.cos(yaw), 0.2 + math.sin(yaw), 0.3))


def test_tilt_of_a_pose_that_lies() -> None:
    lying = Pose(ORIGIN, (math.sin(math.pi / 4), 0.0, 0.0, math.cos(math.pi / 4)))
    assert lying.tilt == pytest.approx(math.pi / 2)
    assert Pose(ORIGIN, (1.0, 0.0, 0.0, 0.0)).tilt == pytest.approx(math.pi)


def test_compose_transforms_in_turn() -> None:
    one, other, third = random_poses(3)
    point = (0.3, -0.2, 0.5)
    assert one.compose(other).transform(point) == pytest.approx(one.transform(other.transform(point)))
    left = one.compose(other).compose(third)
    assert left.position == pytest.approx(one.compose(other.compose(third)).position)


def test_inverse_undoes() -> None:
    for pose in random_poses(5):
        for both in (pose.compose(pose.inverse()), pose.inverse().compose(pose)):
            assert both.position == pytest.approx(ORIGIN, abs=1e-12)
            assert both.tilt == pytest.approx(0.0, abs=1e-6) and both.yaw == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("period", [2 * math.pi, math.pi, math.pi / 2])
def test_wrap_angle(period: float) -> None:
    edges = [np.nextafter(sign * period / 2.0, toward) for sign in (-1.0, 1.0) for toward in (-9.0, 9.0)]
    for angle in [*np.linspace(-20.0, 20.0, 101).tolist(), *edges]:
        wrapped = wrap_angle(angle, period)
        assert -period / 2 <= wrapped < period / 2
        assert math.remainder(wrapped - angle, period) == pytest.approx(0.0, abs=1e-9)


def test_planar_distance_ignores_height() -> None:
    assert planar_distance((0.0, 0.0, 5.0), (3.0, 4.0, -5.0)) == 5.0


def volume(mesh: Mesh) -> float:
    """Signed volume: positive where all faces look out of a closed mesh."""
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    return float((a * np.cross(b, c)).sum() / 6.0)


def test_box_is_closed_and_looks_out() -> None:
    box = Mesh.box((0.1, 0.2, 0.3), (1.0, 2.0, 3.0))
    np.testing.assert_allclose(box.bounds, [[0.95, 1.9, 2.85], [1.05, 2.1, 3.15]])
    assert volume(box) == pytest.approx(0.1 * 0.2 * 0.3)
    assert len(box.vertices) == 8 and len(box.faces) == 12
    edges = {(int(f[i]), int(f[(i + 1) % 3])) for f in box.faces for i in range(3)}
    assert len(edges) == 36 and {(b, a) for a, b in edges} == edges


def test_moved_mesh() -> None:
    pose = random_poses(1)[0]
    box = Mesh.box((0.1, 0.2, 0.3))
    moved = box.moved(pose)
    assert volume(moved) == pytest.approx(volume(box))
    assert moved.vertices[3] == pytest.approx(pose.transform(tuple(box.vertices[3])))
    np.testing.assert_array_equal(box.vertices, Mesh.box((0.1, 0.2, 0.3)).vertices)


def test_join() -> None:
    boxes = [Mesh.box((0.1, 0.1, 0.1), (x, 0.0, 0.0)) for x in (0.0, 1.0, 2.0)]
    joined = join(boxes)
    assert volume(joined) == pytest.approx(sum(map(volume, boxes)))
    np.testing.assert_allclose(joined.bounds, [[-0.05, -0.05, -0.05], [2.05, 0.05, 0.05]])
    np.testing.assert_array_equal(join(boxes[:1]).faces, boxes[0].faces)


def test_mesh_of_lists_has_fixed_types() -> None:
    mesh = Mesh.of([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [0, 1, 2])
    assert mesh.vertices.dtype == np.float64 and mesh.faces.dtype == np.int32 and mesh.faces.shape == (1, 3)


def test_turns_are_vectors() -> None:
    """Against SciPy; and what is turned by a turned vector is the turned result."""
    rng = np.random.default_rng(0)
    for vector in (*rng.uniform(-1.5, 1.5, (50, 3)), np.zeros(3), np.array([1e-9, 0, 0])):
        q = from_rotvec(vector.tolist())
        np.testing.assert_allclose(q, Rotation.from_rotvec(vector).as_quat(), atol=1e-12)
        np.testing.assert_allclose(as_rotvec(q), vector, atol=1e-12)
        np.testing.assert_allclose(as_rotvec(tuple(-part for part in q)), vector, atol=1e-12)
        about_z, hand = yaw_quaternion(rng.uniform(-3, 3)), random_quaternion(rng)
        turned = from_rotvec(rotate(about_z, tuple(vector.tolist())))
        np.testing.assert_allclose(
            multiply(turned, multiply(about_z, hand)), multiply(about_z, multiply(q, hand)), atol=1e-12
        )
