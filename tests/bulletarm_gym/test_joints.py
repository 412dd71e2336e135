"""Sliding and rotating parts of fixed and of free bodies: geometry, physics and state."""

import pickle

import numpy as np
import pytest
from rollouts import step_on, transcript

from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.geometry import Pose, euler_pose
from bulletarm_gym.objects.solids import block
from bulletarm_gym.observations import HeightRenderer, Window
from bulletarm_gym.scene.stability import settle
from bulletarm_gym.simulation import BodySpec, Box, Hinge, Piece, Slide, World
from bulletarm_gym.simulation.state import PHYSICS_MODES, REST_SPEED
from bulletarm_gym.surfaces.surface import FLOOR

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
def test_door_of_the_example_repeats_exactly_and_is_rendered():
    parameters = {"control": "close_loop", "obs_size": 16, "observation": ["heightmap", "state"]}
    first, second = (ManipulationEnv("door:DoorOpening", **parameters) for _ in range(2))
    first.reset(seed=0)
    while first.scene["door"].joints[0] < 0.3:
        first.step(first.expert_action())
    state = pickle.loads(pickle.dumps(first.get_state()))
    second.reset(seed=7)
    second.set_state(state)
    for action in np.random.default_rng(0).uniform(-1.0, 1.0, (5, 5)):
        one, other = step_on(first, action), step_on(second, action)
        assert np.array_equal(one[0]["state"], other[0]["state"]) and one[1:] == other[1:]
    assert first.scene["door"].joints == second.scene["door"].joints
    assert transcript(first, 8, seed=3) == transcript(second, 8, seed=3)
    first.reset(seed=0)
    item = first.scene["door"]
    for angle in (0.0, 0.8, 1.6):
        item.set_joints((angle,))
        x, y, _ = item.pose.compose(Pose.planar(0.0, 0.0, 0.0, angle)).transform((0.09, 0.0, 0.0))
        heights = HeightRenderer.of(first.scene).heights(Window((x, y), 0.02, 5))
        assert heights[2, 2] == pytest.approx(0.065, abs=1e-3)
