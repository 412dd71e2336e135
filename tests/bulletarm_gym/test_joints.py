"""Parts that slide and turn, in fixed and in free bodies: their geometry, their physics, their state."""

import math
import pickle
import re
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from rollouts import step_on, transcript

from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.geometry import Pose, euler_angles, euler_pose
from bulletarm_gym.objects.solids import block
from bulletarm_gym.observations import HeightRenderer, Window
from bulletarm_gym.scene.stability import settle
from bulletarm_gym.simulation import Body, BodySpec, Box, Hinge, Piece, Slide, World
from bulletarm_gym.simulation.state import PHYSICS_MODES, REST_SPEED
from bulletarm_gym.surfaces.flat import FLOOR

ROOT = Path(__file__).resolve().parents[2]
LID = Hinge(
    "lid",
    (block((0.1, 0.1, 0.01), (0.0, 0.0, 0.045)), block((0.02, 0.04, 0.02), (0.03, 0.0, 0.06))),
    mass=0.05,
    pivot=(-0.05, 0.0, 0.04),
    axis=(0.0, -1.0, 0.0),
    limits=(0.0, 2.0),
    resistance=0.005,
)
BOLT = Slide(
    "bolt",
    (block((0.06, 0.01, 0.01), (0.08, 0.0, 0.02)),),
    0.02,
    (1.0, 0.0, 0.0),
    (0.0, 0.04),
    resistance=0.1,
)
WALLS = (
    block((0.1, 0.01, 0.04), (0.0, 0.045, 0.02)),
    block((0.1, 0.01, 0.04), (0.0, -0.045, 0.02)),
    block((0.01, 0.08, 0.04), (0.06, 0.0, 0.02)),
    Piece(Box((0.05, 0.05, 0.02)), euler_pose((-0.02, 0.0, 0.02), (0.0, 0.0, 0.6))),
)
ANGLES = [0.0, 0.4, 1.1, 1.9]


def _box(mass: float) -> BodySpec:
    return BodySpec("box", WALLS, mass, slides=(BOLT,), hinges=(LID,))


def _world(mass: float) -> tuple[World, Body]:
    world = World(PHYSICS_MODES["fast"])
    world.add_plane(FLOOR)
    world.add(BodySpec("cube", (Piece(Box((0.04, 0.04, 0.04))),), 0.1), Pose((0.3, 0.0, 0.02)))
    body = world.add(_box(mass), Pose((0.0, 0.0, 0.0)))
    world.add(BodySpec("parked", (Piece(Box((0.04, 0.04, 0.04))),), 0.1))
    world.seal()
    return world, body


@pytest.fixture(params=[0.0, 0.3], ids=["fixed", "free"])
def mass(request: pytest.FixtureRequest) -> float:
    return float(request.param)


@pytest.fixture
def boxed(mass: float) -> Iterator[tuple[World, Body]]:
    world, body = _world(mass)
    yield world, body
    world.close()


@pytest.mark.parametrize("angle", ANGLES)
def test_parts_are_simulated_where_they_are_said_to_be(boxed: tuple[World, Body], angle: float) -> None:
    """The corners of each part's true shape are at the surface of its shape in Bullet."""
    world, body = boxed
    world.place(body, euler_pose((0.1, -0.2, 0.3), (0.3, -0.5, 1.0)))
    world.set_joints(body, (0.03, angle))
    assert [world.client.getJointInfo(body.id, j)[1].decode() for j in body.joints] == ["bolt", "lid"]
    probe = world.client.createCollisionShape(world.client.GEOM_SPHERE, radius=1e-4)
    ball = world.client.createMultiBody(0.0, probe)
    for link, (part, pose) in enumerate(zip(body.spec.parts, world.part_poses(body)[1:], strict=True)):
        for piece in part.pieces:
            for corner in piece.mesh.vertices[:4].tolist():
                world.client.resetBasePositionAndOrientation(
                    ball, pose.transform(tuple(corner)), (0, 0, 0, 1)
                )
                points = world.client.getClosestPoints(ball, body.id, 0.01, -1, link)
                assert min(abs(point[8]) for point in points) < 1.5e-3


def test_a_lid_falls_shut_and_a_brake_holds_it(boxed: tuple[World, Body]) -> None:
    world, body = boxed
    world.set_joints(body, (0.02, 0.6))
    world.begin()
    world.step(240)
    world.end()
    bolt, lid = world.joints[body.index]
    assert lid == pytest.approx(0.0, abs=0.02), "0.05 kg on 5 cm turn against 5 mN m"
    assert bolt == pytest.approx(0.02, abs=1e-3)
    assert world.poses[body.index].tilt < 0.02
    world.set_joints(body, (0.02, 1.5))
    world.begin()
    world.step(240)
    world.end()
    assert world.joints[body.index][1] == pytest.approx(1.5, abs=0.03), "nearly upright the brake is stronger"


def test_a_free_body_weighs_what_it_says_with_its_parts() -> None:
    world, body = _world(0.3)
    client = world.client
    masses = [client.getDynamicsInfo(body.id, link)[0] for link in (-1, *body.joints)]
    assert masses == pytest.approx([0.3, 0.02, 0.05])
    assert client.getDynamicsInfo(body.id, -1)[2] == pytest.approx(body.spec.mass_properties[1])
    lid = BodySpec("lid", LID.pieces, LID.mass)
    assert client.getDynamicsInfo(body.id, 1)[2] == pytest.approx(lid.mass_properties[1])
    world.close()


@pytest.mark.parametrize("mass", [0.0, 0.3], ids=["fixed", "free"])
def test_parts_have_the_inertia_of_their_pieces(mass: float) -> None:
    """Two cubes of 2 cm that are 20 cm apart, in a plane that is oblique to the axes of the body."""
    frame = euler_pose((0.0, 0.0, 0.0), (0.3, 0.5, 0.7))
    ends = tuple(Piece(Box((0.02, 0.02, 0.02)), frame.compose(Pose((x, 0.0, 0.0)))) for x in (-0.1, 0.1))
    weights = Hinge("weights", ends, 0.2, pivot=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0), limits=(-3.0, 3.0))
    spec = BodySpec("body", (Piece(Box((0.05, 0.05, 0.05))),), mass, hinges=(weights,))
    world = World(PHYSICS_MODES["fast"])
    body = world.add(spec, Pose((0.0, 0.0, 0.5)))
    own = 0.2 * 0.02**2 / 6.0
    info = world.client.getDynamicsInfo(body.id, 0)
    assert sorted(info[2]) == pytest.approx([own, own + 0.2 * 0.01, own + 0.2 * 0.01], rel=1e-4)
    axis = frame.transform((1.0, 0.0, 0.0))
    least = np.eye(3)[int(np.argmin(info[2]))].tolist()
    found = Pose((0.0, 0.0, 0.0), info[4]).transform((least[0], least[1], least[2]))
    assert abs(np.dot(axis, found)) == pytest.approx(1.0, abs=1e-4)
    world.close()


def test_it_is_loose_and_moves_until_it_rests(boxed: tuple[World, Body]) -> None:
    world, body = boxed
    assert body in world.loose_bodies
    world.set_joints(body, (0.0, 0.9))
    world.begin()
    world.step(3)
    assert world.speed(body) > REST_SPEED
    settle(world, [body], 480)
    assert world.speed(body) < REST_SPEED
    assert not world.has_motion


def _fling(world: World, body: Body, steps: int) -> None:
    world.place(body, Pose.planar(0.1, 0.0, 0.05, 0.3), ((0.3, 0.0, 0.0), (0.0, 1.0, 2.0)))
    world.set_joints(body, (0.01, 1.0))
    for _ in range(steps):
        world.begin()
        world.step(20)
        world.end()


def test_a_state_is_exact_in_another_world(mass: float) -> None:
    """In mid flight, after another history, with the next moves begun from the canonical world."""
    first, body = _world(mass)
    second, other = _world(mass)
    _fling(first, body, 1)
    state = first.get_state()
    assert first.has_motion
    _fling(second, other, 7)
    second.park(other)
    second.set_state(state)
    for world in (first, second):
        for _ in range(6):
            world.begin()
            world.step(20)
            world.end()
    assert first.get_state() == second.get_state()
    assert first.get_state() != state
    for world in (first, second):
        world.close()


def test_parked_parts_take_no_part(mass: float) -> None:
    world, body = _world(mass)
    world.park(body)
    world.begin()
    world.step(10)
    world.end()
    assert body not in world.loose_bodies
    world.place(body, Pose((0.0, 0.0, 0.0)))
    world.begin()
    world.step(60)
    world.end()
    assert world.poses[body.index].z == pytest.approx(0.0, abs=2e-3)
    world.close()


@pytest.mark.parametrize("angles", [(0.3, -0.2, 2.0), (0.4, math.pi / 2, 0.3), (1.0, -math.pi / 2, 0.0)])
def test_angles_of_a_urdf_give_the_rotation_back(angles: tuple[float, float, float]) -> None:
    orientation = euler_pose((0.0, 0.0, 0.0), angles).orientation
    again = euler_pose((0.0, 0.0, 0.0), euler_angles(orientation)).orientation
    assert abs(np.dot(orientation, again)) == pytest.approx(1.0, abs=1e-9)


DOOR = ROOT / "docs" / "guides" / "joints.md"


@pytest.fixture
def door(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., ManipulationEnv]]:
    """The task of the guide, from its own file."""
    source = re.findall(r"```python\n(# my_doors\.py\n.*?)```", DOOR.read_text(encoding="utf-8"), re.DOTALL)
    (tmp_path / "my_doors.py").write_text(source[0], encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    yield partial(ManipulationEnv, task="my_doors:DoorOpening", control="close_loop", obs_size=16)
    sys.modules.pop("my_doors", None)


@pytest.mark.usefixtures("own_registrations")
def test_a_door_half_open_is_set_exactly_in_another_environment(
    door: Callable[..., ManipulationEnv],
) -> None:
    first, second = door(observation="state"), door(observation="state")
    for seed in range(3):
        first.reset(seed=seed)
        while first.scene["door"].joints[0] < 0.3:
            first.step(first.expert_action())
        state = pickle.loads(pickle.dumps(first.get_state()))
        second.reset(seed=seed + 7)
        second.set_state(state)
        for action in np.random.default_rng(seed).uniform(-1.0, 1.0, (5, 5)):
            one, other = step_on(first, action), step_on(second, action)
            assert np.array_equal(one[0]["state"], other[0]["state"]) and one[1:] == other[1:]
        assert first.scene["door"].joints == second.scene["door"].joints
    assert first.observation_space["state"].shape == (6 + 8 + 1,)
    first.close()
    second.close()


@pytest.mark.usefixtures("own_registrations")
def test_the_same_seed_opens_the_same_door(door: Callable[..., ManipulationEnv]) -> None:
    first, second = door(), door()
    transcript(second, 6, seed=5)
    assert transcript(first, 8, seed=3) == transcript(second, 8, seed=3)
    first.close()
    second.close()


@pytest.mark.usefixtures("own_registrations")
def test_the_heightmap_shows_the_door_where_it_is(door: Callable[..., ManipulationEnv]) -> None:
    env = door()
    env.reset(seed=0)
    item, scene = env.scene["door"], env.scene
    for angle in (0.0, 0.8, 1.6):
        item.set_joints((angle,))
        x, y, _ = item.pose.compose(Pose.planar(0.0, 0.0, 0.0, angle)).transform((0.09, 0.0, 0.0))
        heights = HeightRenderer.of(scene).heights(Window((x, y), 0.02, 5))
        assert heights[2, 2] == pytest.approx(0.065, abs=1e-3)
    env.close()
