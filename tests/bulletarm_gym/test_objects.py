"""Built-in objects: sizes of the paper, pieces, inertia, rest on the ground; sliding and rotating parts."""

import itertools
import math

import numpy as np
import pytest

from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.geometry import Pose, euler_pose, mass_properties, matrix
from bulletarm_gym.objects import create
from bulletarm_gym.objects.blocks import DRAWINGS, improvise_blocks, improvise_bricks
from bulletarm_gym.objects.catalogue import KINDS, object_set
from bulletarm_gym.objects.files import convex_hull
from bulletarm_gym.objects.graspables import graspables
from bulletarm_gym.objects.solids import block
from bulletarm_gym.observations import HeightRenderer, Window
from bulletarm_gym.scene.stability import settle
from bulletarm_gym.simulation import BodySpec, Box, Hinge, Piece, Slide, World
from bulletarm_gym.simulation.state import PHYSICS_MODES, REST_SPEED
from bulletarm_gym.surfaces.surface import FLOOR

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
SCALES = {kind: scale for kind, (scale, *_) in SIZES.items()}
CATALOGUE = [create(kind, kind, SCALES.get(kind, 0.7)) for kind in KINDS]
SPECS = [*CATALOGUE, *improvise_bricks("improvise brick", 0.6, 8), *improvise_blocks("random", 0.6, series=1)]


def test_default_scales_give_the_papers_sizes():
    for kind, (scale, extents, mass) in SIZES.items():
        spec = create(kind, "it", scale)
        assert spec.extents == pytest.approx(extents, abs=1e-9), kind
        assert spec.mass == mass
        assert create(kind, "it", 0.5 * scale).extents == pytest.approx(np.array(extents) / 2.0)


def test_eight_bottles_of_about_5_by_5_by_14_cm():
    sizes = np.array([create(f"bottle_{number}", str(number), 0.8).extents for number in range(8)])
    assert np.abs(sizes - (0.05, 0.05, 0.14)).max() < 0.008
    assert np.abs(sizes.mean(axis=0) - (0.05, 0.05, 0.14)).max() < 0.001
    assert len({tuple(row) for row in sizes.round(6).tolist()}) == 8


def test_nineteen_random_blocks_of_one_layer():
    assert len(set(DRAWINGS)) == 19
    for drawing, spec in zip(DRAWINGS, improvise_blocks("it", 0.6, series=0), strict=True):
        rows = drawing.split()
        volume = sum(math.prod(piece.shape.extents) for piece in spec.pieces)
        cell = spec.extents[0] / len(rows[0])
        assert volume == pytest.approx(drawing.count("#") * cell**2 * spec.extents[2])
        assert np.allclose(spec.mass_properties[0].position, 0.0, atol=1e-12)


def test_random_sizes_stay_in_their_ranges_and_repeat():
    blocks = [spec.extents for series in range(4) for spec in improvise_blocks("it", 0.6, series)]
    assert blocks == [spec.extents for series in range(4) for spec in improvise_blocks("it", 0.6, series)]
    sizes, bricks = np.array(blocks), np.array([spec.extents for spec in improvise_bricks("it", 0.6, 50)])
    assert (sizes >= (0.036, 0.036, 0.0264)).all() and (sizes <= (0.063, 0.091, 0.02904 + 1e-9)).all()
    assert (bricks >= (0.025, 0.1, 0.02)).all() and (bricks <= (0.035, 0.14, 0.035)).all()
    assert bricks.min(axis=0) == pytest.approx((0.025, 0.1, 0.02), rel=0.1)
    assert bricks.max(axis=0) == pytest.approx((0.035, 0.14, 0.035), rel=0.1)


def test_86_objects_to_grasp_fit_gripper_and_tray():
    specs = graspables()
    assert len({spec.name for spec in specs}) == len(specs) == 86 and object_set(None) is specs
    sides = np.array([sorted(spec.extents) for spec in specs])
    assert 0.014 <= sides[:, 0].min() and sides[:, 0].max() <= 0.065 and sides[:, 2].max() <= 0.16
    assert np.abs(np.median(sides, axis=0) - (0.042, 0.055, 0.095)).max() < 0.01


@pytest.mark.parametrize("specs", [SPECS, graspables()], ids=["catalogue", "to grasp"])
def test_pieces_are_convex_closed_and_few(specs):
    for spec in specs:
        assert len(spec.pieces) <= (25 if spec.name == "bowl" else 9)
        for mesh in (piece.mesh for piece in spec.pieces):
            corners = mesh.vertices[mesh.faces]
            normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            normals /= np.linalg.norm(normals, axis=1, keepdims=True)
            offsets = np.einsum("fi,fi->f", normals, corners[:, 0])
            assert (mesh.vertices @ normals.T - offsets).max() < 1e-3, spec.name
            edges = {(int(a), int(b)) for f in mesh.faces for a, b in zip(f, np.roll(f, -1), strict=True)}
            assert {(b, a) for a, b in edges} == edges, spec.name
            assert np.linalg.det(corners).sum() > 0.0


def test_objects_rest_where_they_are_placed():
    world = World(PHYSICS_MODES["fast"])
    world.add_plane(FLOOR)
    for index, spec in enumerate(SPECS):
        x, y = divmod(index, 9)
        world.add(spec, Pose((0.4 * x, 0.4 * y, -float(spec.mesh.bounds[0, 2]))))
    before = world.get_state().poses
    world.seal()
    world.begin()
    world.step(240)
    world.end()
    for body, then, now in zip(world.bodies[1:], before[1:], world.poses[1:], strict=True):
        leans = body.spec.name in ("swab", "tube", "used_tube")  # thick at one end, until the other rests
        assert math.dist(then.position, now.position) < 0.003, body.spec.name
        assert now.tilt - then.tilt < math.radians(7.0 if leans else 1.0), body.spec.name


def grid_box(size, squares):
    """Return the vertices of a box whose faces are divided into squares."""
    steps = np.linspace(-0.5, 0.5, squares + 1)
    points = np.array(list(itertools.product(steps, steps, steps)))
    return points[(np.abs(points) == 0.5).any(axis=1)] * size


@pytest.mark.parametrize("noise", [0.0, 1e-9, 1e-7, 1e-6])
@pytest.mark.parametrize("size", [(0.04, 0.05, 0.06), (0.1, 0.1, 1e-3)], ids=["box", "plate"])
def test_hull_of_a_box_with_divided_faces_has_the_box_inertia(size, noise):
    rng, centre, tolerance = np.random.default_rng(0), np.array((0.1, -0.2, 0.3)), max(1e-9, 5000.0 * noise)
    for angles in rng.uniform(-3, 3, (4, 3)):
        points = grid_box(np.array(size), 8) @ matrix(euler_pose((0.0, 0.0, 0.0), tuple(angles))).T + centre
        points = rng.permutation(np.repeat(points, 2, axis=0))
        hull = convex_hull(points + rng.uniform(-noise, noise, points.shape))
        volumes = np.linalg.det(hull.vertices[hull.faces] - centre) / 6.0
        assert volumes.sum() == pytest.approx(np.prod(size), rel=tolerance) and (volumes > -1e-15).all()
        frame, moments = mass_properties([hull], 0.1)
        x, y, z = np.square(size)
        assert frame.position == pytest.approx(tuple(centre), abs=max(1e-10, 10.0 * noise))
        assert sorted(moments) == pytest.approx(
            sorted(0.1 / 12.0 * pair for pair in (y + z, x + z, x + y)), rel=tolerance
        )


CUBE = BodySpec("cube", (Piece(Box((0.04, 0.04, 0.04))),), 0.1)
LID = Hinge(
    "lid",
    (block((0.1, 0.1, 0.01), (0.0, 0.0, 0.045)), block((0.02, 0.04, 0.02), (0.03, 0.0, 0.06))),
    mass=0.05,
    pivot=(-0.05, 0.0, 0.04),
    axis=(0.0, -1.0, 0.0),
    limits=(0.0, 2.0),
    resistance=0.005,
)
BOLT_PIECES = (block((0.06, 0.01, 0.01), (0.08, 0.0, 0.02)),)
BOLT = Slide("bolt", BOLT_PIECES, 0.02, (1.0, 0.0, 0.0), (0.0, 0.04), resistance=0.1)
WALLS = (
    block((0.1, 0.01, 0.04), (0.0, 0.045, 0.02)),
    block((0.1, 0.01, 0.04), (0.0, -0.045, 0.02)),
    block((0.01, 0.08, 0.04), (0.06, 0.0, 0.02)),
    Piece(Box((0.05, 0.05, 0.02)), euler_pose((-0.02, 0.0, 0.02), (0.0, 0.0, 0.6))),
)


@pytest.fixture
def boxed(mass):
    world = World(PHYSICS_MODES["fast"])
    world.add_plane(FLOOR)
    world.add(CUBE, Pose((0.3, 0.0, 0.02)))
    body = world.add(BodySpec("box", WALLS, mass, parts=(BOLT, LID)), Pose((0.0, 0.0, 0.0)))
    world.add(CUBE)
    world.seal()
    yield world, body
    world.close()


@pytest.fixture(params=[0.0, 0.3], ids=["fixed", "free"])
def mass(request):
    return float(request.param)


def simulate(world, steps):
    world.begin()
    world.step(steps)
    world.end()


def test_bodies_at_the_old_and_new_positions_of_parts_are_unsettled(boxed):
    world, body = boxed
    cube = world.bodies[1]
    world.place(cube, Pose((0.16, 0.0, 0.02)))
    for bolt in (0.04, 0.0):  # in the cube, and back
        world.unsettled.clear()
        world.set_joints(body, (bolt, 0.0))
        assert world.unsettled == {body.index, cube.index}
    world.unsettled.clear()
    world.set_joints(body, (0.01, 0.0))
    assert world.unsettled == {body.index}


@pytest.mark.parametrize("angle", [0.0, 0.4, 1.1, 1.9])
def test_poses_of_parts_are_those_of_the_simulation(boxed, angle):
    """The corners of each part are at the surface of its shape in Bullet."""
    world, body = boxed
    world.place(body, euler_pose((0.1, -0.2, 0.3), (0.3, -0.5, 1.0)))
    world.set_joints(body, (0.03, angle))
    probe = world.client.createCollisionShape(world.client.GEOM_SPHERE, radius=1e-4)
    ball = world.client.createMultiBody(0.0, probe)
    for link, (part, pose) in enumerate(zip(body.spec.parts, world.part_poses(body)[1:], strict=True)):
        for corner in (corner for piece in part.pieces for corner in piece.mesh.vertices[:4].tolist()):
            at = pose.transform(tuple(corner))
            world.client.resetBasePositionAndOrientation(ball, at, (0, 0, 0, 1))
            points = world.client.getClosestPoints(ball, body.id, 0.01, -1, link)
            assert min(abs(point[8]) for point in points) < 1.5e-3


def test_lid_falls_shut_and_a_brake_holds_it(boxed):
    world, body = boxed
    world.set_joints(body, (0.02, 0.6))
    assert body in world.loose_bodies
    simulate(world, 3)
    assert world.speed(body) > REST_SPEED
    settle(world, [body], 480)
    bolt, lid = world.joints[body.index]
    assert lid == pytest.approx(0.0, abs=0.02), "the torque of 0.05 kg at 5 cm exceeds 5 mN m"
    assert bolt == pytest.approx(0.02, abs=1e-3)
    assert world.poses[body.index].tilt < 0.02
    assert world.speed(body) < REST_SPEED and not world.has_motion
    assert not world.contacts(body, body), "parts do not collide with their body"
    world.set_joints(body, (0.02, 1.5))
    simulate(world, 240)
    assert world.joints[body.index][1] == pytest.approx(1.5, abs=0.03), "nearly upright the brake is stronger"
    world.park(body)
    simulate(world, 10)
    assert body not in world.loose_bodies


def test_inertia_has_the_axes_of_the_pieces(mass):
    """Two cubes of 2 cm that are 20 cm apart, in a plane that is oblique to the axes of the body."""
    frame = euler_pose((0.0, 0.0, 0.0), (0.3, 0.5, 0.7))
    ends = tuple(Piece(Box((0.02, 0.02, 0.02)), frame.compose(Pose((x, 0.0, 0.0)))) for x in (-0.1, 0.1))
    weights = Hinge("weights", ends, 0.2, pivot=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0), limits=(-3.0, 3.0))
    world = World(PHYSICS_MODES["fast"])
    body = world.add(BodySpec("body", CUBE.pieces, mass, parts=(weights,)), Pose((0.0, 0.0, 0.5)))
    own = 0.2 * 0.02**2 / 6.0
    info = world.client.getDynamicsInfo(body.id, 0)
    assert sorted(info[2]) == pytest.approx([own, own + 0.2 * 0.01, own + 0.2 * 0.01], rel=1e-4)
    assert [world.client.getDynamicsInfo(body.id, link)[0] for link in (-1, 0)] == [mass, 0.2]
    axis = frame.transform((1.0, 0.0, 0.0))
    found = Pose((0.0, 0.0, 0.0), info[4]).transform(tuple(np.eye(3)[int(np.argmin(info[2]))].tolist()))
    assert abs(np.dot(axis, found)) == pytest.approx(1.0, abs=1e-4)


@pytest.mark.usefixtures("own_registrations")
def test_door_of_the_example_is_rendered_where_it_turns():
    env = ManipulationEnv("door:DoorOpening", control="close_loop", obs_size=16)
    env.reset(seed=0)
    item = env.scene["door"]
    for angle in (0.0, 0.8, 1.6):
        item.set_joints((angle,))
        x, y, _ = item.pose.compose(Pose.planar(0.0, 0.0, 0.0, angle)).transform((0.09, 0.0, 0.0))
        heights = HeightRenderer.of(env.scene).heights(Window((x, y), 0.02, 5))
        assert heights[2, 2] == pytest.approx(0.065, abs=1e-3)
