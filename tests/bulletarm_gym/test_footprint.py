"""What things cover of the ground: compiled, and rounded as NumPy does it."""

import math

import numpy as np
import pytest

from bulletarm_gym.geometry import Footprint, Pose, euler_pose, matrix
from bulletarm_gym.geometry.footprint import DIRECTIONS


@pytest.fixture(params=range(5))
def rng(request: pytest.FixtureRequest) -> np.random.Generator:
    return np.random.default_rng(request.param)


def any_pose(rng: np.random.Generator) -> Pose:
    x, y, z, *angles = rng.uniform(-0.5, 0.5, 6).tolist()
    return euler_pose((x, y, z), tuple(4.0 * angle for angle in angles))


@pytest.mark.parametrize("count", [4, 8, 50])
def test_a_shadow_is_where_the_vertices_are(rng: np.random.Generator, count: int) -> None:
    vertices, pose = rng.uniform(-0.1, 0.1, (count, 3)), any_pose(rng)
    expected = vertices @ matrix(pose)[:2].T + pose.position[:2]
    assert Footprint.of(vertices, pose).points == pytest.approx(expected, abs=1e-15)


def test_a_rectangle_has_its_sides(rng: np.random.Generator) -> None:
    pose = Pose.planar(*rng.uniform(-0.5, 0.5, 4).tolist())
    corners = Footprint.rectangle((0.06, 0.02), pose).points
    sides = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    assert sides == pytest.approx([0.06, 0.02, 0.06, 0.02])
    assert corners.mean(axis=0) == pytest.approx(pose.position[:2])


def test_reach_centre_and_border_are_those_of_the_points(rng: np.random.Generator) -> None:
    shadow = Footprint.of(rng.uniform(-0.1, 0.1, (12, 3)), any_pose(rng))
    turns = 2.0 * math.pi * np.arange(DIRECTIONS) / DIRECTIONS
    along = shadow.points @ np.stack([np.cos(turns), np.sin(turns)])
    assert shadow.reach == pytest.approx(along.max(axis=0), abs=1e-15)
    low, high = shadow.points.min(axis=0), shadow.points.max(axis=0)
    assert shadow.centre == pytest.approx((low + high) / 2.0)
    assert shadow.mean == pytest.approx(shadow.points.mean(axis=0))
    border = np.stack([low, high], axis=1)
    assert shadow.is_inside(border)
    assert not shadow.is_inside(border, 1e-6)
    assert shadow.is_inside(border + np.array([-0.01, 0.01]), 0.009)


def test_a_grown_footprint_has_its_corners_farther_out(rng: np.random.Generator) -> None:
    shadow = Footprint.rectangle((0.06, 0.02), any_pose(rng))
    for margin in (0.01, -0.002):
        moved = shadow.grown(margin).points - shadow.points
        outwards = shadow.points - shadow.points.mean(axis=0)
        assert np.linalg.norm(moved, axis=1) == pytest.approx([abs(margin)] * 4)
        assert (np.sign((moved * outwards).sum(axis=1)) == math.copysign(1.0, margin)).all()
    assert Footprint(np.zeros((1, 2))).grown(0.01).points.tolist() == [[0.0, 0.0]]


def test_gaps_are_between_the_nearest_sides() -> None:
    left = Footprint.rectangle((0.02, 0.02), Pose((0.0, 0.0, 0.0)))
    right = Footprint.rectangle((0.02, 0.02), Pose((0.05, 0.005, 0.0)))
    assert left.gap(right) == right.gap(left) == pytest.approx(0.03)
    assert left.gap(left) < 0.0
