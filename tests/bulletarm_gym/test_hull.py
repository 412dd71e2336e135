"""Convex hulls of real meshes: volume, centre and inertia against formulas."""

import itertools

import numpy as np
import pytest

from bulletarm_gym.geometry import FloatArray, Mesh, euler_pose, matrix
from bulletarm_gym.geometry.meshes import mass_properties
from bulletarm_gym.objects.files import convex_hull

SIZE = np.array((0.05, 0.08, 0.04))
CENTRE = np.array((0.1, -0.2, 0.3))
MASS = 0.5
NOISE = (0.0, 1e-9, 1e-8, 1e-7, 1e-6)
ROTATIONS = [
    euler_pose((0.0, 0.0, 0.0), tuple(angles)) for angles in np.random.default_rng(0).uniform(-3, 3, (8, 3))
]


def grid_box(size: FloatArray, squares: int) -> FloatArray:
    """Vertices of a box whose faces are divided into squares."""
    steps = np.linspace(-0.5, 0.5, squares + 1)
    points = np.array(list(itertools.product(steps, steps, steps)))
    return points[(np.abs(points) == 0.5).any(axis=1)] * size


def grid_prism(sides: int, radius: float, height: float) -> FloatArray:
    """Vertices of a regular prism with rings along its height and points on its caps."""
    angles = 2.0 * np.pi * np.arange(sides) / sides
    ring = np.stack([np.cos(angles), np.sin(angles), np.zeros(sides)], axis=1) * radius
    rings = [ring + np.array((0.0, 0.0, z)) for z in np.linspace(-height / 2.0, height / 2.0, 9)]
    caps = [
        share * ring + np.array((0.0, 0.0, z))
        for share in (0.0, 0.3, 0.6)
        for z in (-height / 2.0, height / 2.0)
    ]
    return np.concatenate(rings + caps)


def placed(points: FloatArray, rotation: int, noise: float) -> FloatArray:
    rng = np.random.default_rng(rotation)
    turned = points @ matrix(ROTATIONS[rotation]).T + CENTRE
    return rng.permutation(np.repeat(turned, 2, axis=0)) + rng.uniform(-noise, noise, (2 * len(points), 3))


def check(hull: Mesh, volume: float, moments: list[float], noise: float) -> None:
    tolerance = max(1e-9, 500.0 * noise)
    corners = hull.vertices[hull.faces] - CENTRE
    assert np.linalg.det(corners).sum() / 6.0 == pytest.approx(volume, rel=tolerance)
    frame, found = mass_properties([hull], MASS)
    assert frame.position == pytest.approx(tuple(CENTRE), abs=max(1e-10, 2.0 * noise))
    assert sorted(found) == pytest.approx(sorted(moments), rel=tolerance)
    assert (np.linalg.det(corners) > -1e-15).all()


@pytest.mark.parametrize("noise", NOISE)
@pytest.mark.parametrize("rotation", range(8))
def test_hull_of_a_box_with_divided_faces_has_the_box_inertia(rotation: int, noise: float) -> None:
    x, y, z = SIZE**2
    moments = [MASS / 12.0 * value for value in (y + z, x + z, x + y)]
    hull = convex_hull(placed(grid_box(SIZE, 8), rotation, noise))
    check(hull, float(SIZE.prod()), moments, noise)


@pytest.mark.parametrize("noise", NOISE)
@pytest.mark.parametrize("sides", [3, 6, 16, 64])
def test_hull_of_a_prism_has_the_prism_inertia(sides: int, noise: float) -> None:
    radius, height = 0.03, 0.1
    sine, cosine = np.sin(2.0 * np.pi / sides), np.cos(2.0 * np.pi / sides)
    volume = height * sides / 2.0 * radius**2 * sine
    axial = MASS * radius**2 * (2.0 + cosine) / 6.0
    across = axial / 2.0 + MASS * height**2 / 12.0
    hull = convex_hull(placed(grid_prism(sides, radius, height), sides % 8, noise))
    check(hull, volume, [axial, across, across], noise)


@pytest.mark.parametrize("rotation", range(8))
def test_hull_of_a_thin_plate_has_the_plate_volume(rotation: int) -> None:
    size = np.array((0.1, 0.1, 1e-4))
    hull = convex_hull(placed(grid_box(size, 20), rotation, 0.0))
    corners = hull.vertices[hull.faces] - CENTRE
    assert np.linalg.det(corners).sum() / 6.0 == pytest.approx(float(size.prod()), rel=1e-6)


def test_hull_does_not_depend_on_the_unit() -> None:
    points = placed(grid_box(SIZE, 8), 3, 1e-8)
    metres, millimetres = convex_hull(points), convex_hull(1000.0 * points)
    assert mass_properties([millimetres], MASS)[1] == pytest.approx(
        [1e6 * moment for moment in mass_properties([metres], MASS)[1]], rel=1e-6
    )


def test_hull_is_that_of_trimesh() -> None:
    trimesh = pytest.importorskip("trimesh")
    for seed in range(20):
        points = np.random.default_rng(seed).normal(scale=0.03, size=(60, 3))
        other = trimesh.convex.convex_hull(points)
        other.density = MASS / other.volume
        frame, moments = mass_properties([convex_hull(points)], MASS)
        assert frame.position == pytest.approx(other.center_mass, abs=1e-9)
        assert sorted(moments) == pytest.approx(sorted(np.linalg.eigvalsh(other.moment_inertia)), rel=1e-6)
