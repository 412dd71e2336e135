"""Poses and meshes compared with SciPy and formulas, and footprints with NumPy."""

import itertools
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bulletarm_gym.geometry import (
    Footprint,
    Mesh,
    Pose,
    as_rotvec,
    euler_angles,
    euler_pose,
    from_rotvec,
    join,
    matrix,
    multiply,
    quaternion,
    rotate,
    wrap_angle,
)
from bulletarm_gym.geometry.footprint import DIRECTIONS


def random_poses(count: int) -> list[Pose]:
    rng = np.random.default_rng(0)
    return [
        Pose(
            tuple(rng.uniform(-1, 1, 3).tolist()), tuple(Rotation.random(random_state=rng).as_quat().tolist())
        )
        for _ in range(count)
    ]


def test_rotations_agree_with_scipy() -> None:
    for one, other in itertools.pairwise(random_poses(20)):
        theirs = Rotation.from_quat(one.orientation)
        both = theirs * Rotation.from_quat(other.orientation)
        assert abs(np.dot(multiply(one.orientation, other.orientation), both.as_quat())) == pytest.approx(1.0)
        assert np.allclose(matrix(one.compose(other)), both.as_matrix())
        assert rotate(one.orientation, other.position) == pytest.approx(theirs.apply(other.position))
        assert one.yaw == pytest.approx(theirs.as_euler("xyz")[2])
        assert euler_angles(one.orientation) == pytest.approx(theirs.as_euler("xyz"))
        assert one.tilt == pytest.approx(math.acos(theirs.apply([0, 0, 1])[2]), abs=1e-6)
        assert abs(np.dot(quaternion(theirs.as_matrix()), one.orientation)) == pytest.approx(1.0)


def test_rotation_vectors_agree_with_scipy() -> None:
    vectors = np.random.default_rng(0).uniform(-1.5, 1.5, (50, 3))
    for vector in (*vectors, np.zeros(3), np.array([1e-9, 0, 0])):
        q = from_rotvec(vector.tolist())
        np.testing.assert_allclose(q, Rotation.from_rotvec(vector).as_quat(), atol=1e-12)
        np.testing.assert_allclose(as_rotvec(q), vector, atol=1e-12)
        np.testing.assert_allclose(as_rotvec(tuple(-part for part in q)), vector, atol=1e-12)


def test_poses_are_composed_and_inverted() -> None:
    for one, other in itertools.pairwise(random_poses(5)):
        point = (0.3, -0.2, 0.5)
        assert one.compose(other).transform(point) == pytest.approx(one.transform(other.transform(point)))
        for both in (one.compose(one.inverse()), one.inverse().compose(one)):
            assert both.position == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)
            assert abs(both.orientation[3]) == pytest.approx(1.0)


@pytest.mark.parametrize("period", [2 * math.pi, math.pi, math.pi / 2])
def test_wrap_angle(period: float) -> None:
    edges = [np.nextafter(sign * period / 2.0, toward) for sign in (-1.0, 1.0) for toward in (-9.0, 9.0)]
    for angle in [*np.linspace(-20.0, 20.0, 101).tolist(), *edges]:
        wrapped = wrap_angle(angle, period)
        assert -period / 2 <= wrapped < period / 2
        assert math.remainder(wrapped - angle, period) == pytest.approx(0.0, abs=1e-9)


def volume(mesh: Mesh) -> float:
    """Return the volume of a closed mesh, positive if all faces look outward."""
    return float(np.linalg.det(mesh.vertices[mesh.faces]).sum() / 6.0)


def test_meshes_are_moved_and_joined() -> None:
    box, (pose,) = Mesh.box((0.1, 0.2, 0.3), (1.0, 2.0, 3.0)), random_poses(1)
    np.testing.assert_allclose(box.bounds, [[0.95, 1.9, 2.85], [1.05, 2.1, 3.15]])
    assert len(box.vertices) == 8 and volume(box) == pytest.approx(0.1 * 0.2 * 0.3)
    moved = box.moved(pose)
    assert moved.vertices[3] == pytest.approx(pose.transform(tuple(box.vertices[3])))
    joined = join([box, moved])
    assert volume(joined) == pytest.approx(2.0 * volume(box)) and len(joined.faces) == 24
    lists = Mesh.of([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [0, 1, 2])
    assert (
        lists.vertices.dtype == np.float64 and lists.faces.dtype == np.int32 and lists.faces.shape == (1, 3)
    )


@pytest.mark.parametrize("count", [4, 12, 50])
def test_footprints_agree_with_numpy(count: int) -> None:
    rng = np.random.default_rng(count)
    x, y, z, *angles = rng.uniform(-0.5, 0.5, 6).tolist()
    pose, vertices = euler_pose((x, y, z), tuple(angles)), rng.uniform(-0.1, 0.1, (count, 3))
    footprint = Footprint.of(vertices, pose)
    expected = vertices @ matrix(pose)[:2].T + pose.position[:2]
    assert footprint.points == pytest.approx(expected, abs=1e-15)
    turns = 2.0 * math.pi * np.arange(DIRECTIONS) / DIRECTIONS
    along = expected @ np.stack([np.cos(turns), np.sin(turns)])
    assert footprint.reach == pytest.approx(along.max(axis=0), abs=1e-15)
    low, high = expected.min(axis=0), expected.max(axis=0)
    assert footprint.centre == pytest.approx((low + high) / 2.0)
    assert footprint.mean == pytest.approx(expected.mean(axis=0))
    border = np.stack([low, high], axis=1)
    assert footprint.is_inside(border) and not footprint.is_inside(border, 1e-6)
    assert footprint.is_inside(border + np.array([-0.01, 0.01]), 0.009)


@pytest.mark.parametrize("margin", [0.01, -0.002])
def test_grown_footprint_has_its_corners_farther_out(margin: float) -> None:
    rectangle = Footprint.rectangle((0.06, 0.02), Pose.planar(0.4, 0.1, 0.0, 0.7))
    sides = np.linalg.norm(np.roll(rectangle.points, -1, axis=0) - rectangle.points, axis=1)
    assert sides == pytest.approx([0.06, 0.02, 0.06, 0.02]) and rectangle.centre == pytest.approx((0.4, 0.1))
    outwards = rectangle.points - rectangle.points.mean(axis=0)
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    assert rectangle.grown(margin).points == pytest.approx(rectangle.points + margin * outwards)
    assert Footprint(np.zeros((1, 2))).grown(margin).points.tolist() == [[0.0, 0.0]]


def test_gap_of_footprints() -> None:
    square = Footprint.rectangle((0.1, 0.1), Pose((0.0, 0.0, 0.0)))
    for degrees in range(0, 360, 7):
        other = Footprint.rectangle((0.1, 0.1), Pose.planar(0.3, 0.0, 0.0, math.radians(degrees)))
        clear = other.points[:, 0].min() - 0.05
        assert clear - 0.002 < square.gap(other) == other.gap(square) <= math.hypot(clear, 0.1)
    assert square.gap(Footprint.rectangle((0.1, 0.1), Pose.planar(0.09, 0.0, 0.0))) < 0.0
