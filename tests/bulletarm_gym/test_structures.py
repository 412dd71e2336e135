"""Structures of blocks: when they stand, how episodes start, how the expert builds and mends them."""

import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest

from bulletarm_gym.config import CLOSE_LOOP
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.experts.blueprint import Blueprint
from bulletarm_gym.experts.pick_place import fingers_fit, palm_fits, pick, resting_frame
from bulletarm_gym.geometry import Pose, euler_pose
from bulletarm_gym.scene import Scene, SceneObject
from bulletarm_gym.scene.predicates import (
    between,
    carries,
    heading,
    in_line,
    is_level,
    lies_flat,
    on_top,
    rests_on,
)
from bulletarm_gym.scene.sampling import footprint
from bulletarm_gym.tasks.structure import BLOCK_SPACING, Structure

Make = Callable[..., ManipulationEnv]

CUBE = 0.03
CENTRE = 0.45
HOUSE_2 = "BulletArm/OpenLoopHouseBuilding2-v0"
HOUSE_3 = "BulletArm/OpenLoopHouseBuilding3-v0"
HOUSE_4 = "BulletArm/OpenLoopHouseBuilding4-v0"
IMPROVISE_2 = "BulletArm/OpenLoopImproviseHouseBuilding2-v0"
IMPROVISE_3 = "BulletArm/OpenLoopImproviseHouseBuilding3-v0"
RAMP = "BulletArm/OpenLoopRampHouseBuilding2-v0"
BUMP = "BulletArm/OpenLoopBumpHouseBuilding4-v0"


def lay(env: ManipulationEnv, **places: Sequence[float]) -> None:
    """Put blocks at y, height of their lowest points and, if given, x and yaw; all others out of the way."""
    aside = np.linspace(-0.16, 0.16, len(env.scene.objects)).tolist()
    for y, item in zip(aside, env.scene.objects, strict=True):
        item.place(Pose.planar(0.32, y, CUBE / 2.0, math.pi / 2.0))
    for name, (y, low, *rest) in places.items():
        x, yaw = (*rest, CENTRE, 0.0)[:2] if len(rest) != 1 else (rest[0], 0.0)
        env.scene[name.replace("_", " ")].place(Pose.planar(x, y, low + CUBE / 2.0, yaw))


def is_built(env: ManipulationEnv) -> bool:
    assert isinstance(env.task, Structure)
    return env.task.evaluate(env.scene)["success"]


def finish(env: ManipulationEnv) -> int:
    """Let the expert act; return its number of steps to success."""
    for count in range(1, env.config.max_steps + 1):
        *_, terminated, _, info = env.step(env.expert_action())
        if terminated:
            assert info["is_success"], info
            return count
    raise AssertionError("the structure is not built")


# When a structure stands


@pytest.fixture
def house(make: Make) -> ManipulationEnv:
    """House Building 2, its two cubes side by side."""
    env = make(HOUSE_2)
    env.reset(seed=0)
    return env


PAIR = {"cube_0": (-0.025, 0.0), "cube_1": (0.025, 0.0)}


@pytest.mark.parametrize(
    ("roof", "stands"),
    [
        ((0.0, CUBE), True),
        ((0.0, CUBE, CENTRE, math.pi), True),
        ((0.0, CUBE, CENTRE + 0.012), True),
        ((0.028, CUBE), True),
        ((0.032, CUBE), False),
        ((0.0, CUBE, CENTRE, math.radians(24.0)), True),
        ((0.0, CUBE, CENTRE, math.radians(27.0)), False),
        ((0.0, CUBE + 0.004), False),
        ((0.1, 0.0), False),
    ],
)
def test_where_the_roof_must_be(house: ManipulationEnv, roof: tuple[float, ...], stands: bool) -> None:
    lay(house, **PAIR, roof=roof)
    assert is_built(house) is stands


def test_cubes_may_be_exchanged_and_turned(house: ManipulationEnv) -> None:
    lay(house, cube_1=(-0.025, 0.0, CENTRE, 0.5), cube_0=(0.025, 0.0, CENTRE, 2.0), roof=(0.0, CUBE))
    assert is_built(house)


def test_one_cube_is_not_enough(house: ManipulationEnv) -> None:
    lay(house, cube_0=(0.0, 0.0), roof=(0.0, CUBE))
    assert not is_built(house)


def test_a_tilted_roof_does_not_count(house: ManipulationEnv) -> None:
    lay(house, **PAIR)
    for degrees, stands in ((0.0, True), (25.0, False)):
        tilt = math.radians(degrees)
        low = CUBE / 2.0 * math.cos(tilt)
        house.scene["roof"].place(euler_pose((CENTRE, 0.0, CUBE + low), (0.0, tilt, 0.0)))
        assert is_built(house) is stands


LAYERS_4 = {
    **PAIR,
    "brick": (0.0, CUBE),
    "cube_2": (-0.03, 2 * CUBE),
    "cube_3": (0.03, 2 * CUBE),
    "roof": (0.0, 3 * CUBE),
}


@pytest.mark.parametrize(
    ("change", "stands"),
    [
        ({}, True),
        ({"cube_0": (-0.03, 2 * CUBE), "cube_2": (-0.025, 0.0)}, True),
        ({"cube_2": (-0.01, 2 * CUBE), "cube_3": (0.05, 2 * CUBE), "roof": (0.02, 3 * CUBE)}, True),
        ({"cube_3": (0.1, 0.0)}, False),
        ({"brick": (0.0, 3 * CUBE), "roof": (0.0, CUBE)}, False),
        ({"brick": (0.0, CUBE, CENTRE, 0.5)}, False),
    ],
    ids=str,
)
def test_the_layers_of_a_house(make: Make, change: dict[str, tuple[float, ...]], stands: bool) -> None:
    env = make(HOUSE_4)
    env.reset(seed=0)
    lay(env, **{**LAYERS_4, **change})
    assert is_built(env) is stands


def test_what_hangs_in_the_gripper_is_not_built(make: Make) -> None:
    env = make(HOUSE_2)
    env.reset(seed=3)
    for _ in range(3):
        *_, info = env.step(env.expert_action())
    held = env.scene.held
    assert held is not None and held.slot.name == "roof" and not info["is_built"]


def test_structures_stand_on_level_ground(make: Make) -> None:
    env = make(RAMP)
    env.reset(seed=0, options={"start": "goal"})
    site = env.scene.surface
    assert is_built(env) and site.level == 0.0
    low = [item.lowest for item in env.scene if item.slot.name != "roof"]
    assert low == pytest.approx([0.0, 0.0], abs=2e-3)


# Relations


@pytest.fixture
def scene(make: Make) -> Scene:
    env = make(HOUSE_3)
    env.reset(seed=0)
    lay(env, **PAIR, brick=(0.0, CUBE))
    return env.scene


def test_between_and_in_line(scene: Scene) -> None:
    pair, brick = [scene["cube 0"], scene["cube 1"]], scene["brick"]
    assert between(brick, pair, 1e-6) and in_line(brick, pair) and in_line(brick, pair[::-1])
    brick.place(Pose.planar(CENTRE, 0.029, 1.5 * CUBE, math.radians(25.0)))
    assert between(brick, pair, CUBE) and in_line(brick, pair)
    brick.place(Pose.planar(CENTRE, 0.031, 1.5 * CUBE, math.radians(26.0)))
    assert not between(brick, pair, CUBE) and not in_line(brick, pair)


def test_a_brick_that_has_rolled_over_is_as_good(scene: Scene) -> None:
    brick = scene["brick"]
    for quarter in range(4):
        brick.place(euler_pose(brick.pose.position, (0.0, quarter * math.pi / 2.0, 0.3)))
        assert is_level(brick) and lies_flat(brick)
        assert heading(brick) == pytest.approx(math.pi / 2.0 + 0.3)
        assert abs(math.sin(resting_frame(brick).yaw - 0.3)) < 1e-6
    brick.place(euler_pose(brick.pose.position, (math.pi / 2.0, 0.0, 0.0)))
    assert not is_level(brick)


def test_an_end_that_touches_carries_nothing_central(scene: Scene) -> None:
    cube, brick = scene["cube 0"], scene["brick"]
    brick.place(Pose.planar(CENTRE, cube.pose.y + 0.065, 1.5 * CUBE))
    assert carries(scene, cube, brick) and not on_top(scene, cube, brick) and rests_on(scene, cube, brick)
    brick.place(Pose.planar(CENTRE, cube.pose.y + 0.065, 1.7 * CUBE))
    assert not carries(scene, cube, brick) and not rests_on(scene, cube, brick)


def test_layers_that_cannot_lie_on_each_other_are_refused() -> None:
    with pytest.raises(ValueError, match="layers: got 3 blocks on 2"):
        Blueprint([["cube"] * 2, ["cube"] * 3], (), CUBE)


# Starts


def test_starts_leave_all_to_do(env: ManipulationEnv) -> None:
    if not isinstance(env.task, Structure):
        pytest.skip("builds nothing of blocks")
    gap = (
        BLOCK_SPACING if env.scene.surface.keeps_poses else BLOCK_SPACING / 4.0
    )  # on bumps blocks tilt until they rest
    if env.config.control == CLOSE_LOOP:
        gap *= 0.6  # of small blocks, whose middles are scattered 2.4 sides apart
    for seed in range(5):
        env.reset(seed=seed)
        bases = [footprint(item) for item in env.scene]
        assert all(a.gap(b) > gap - 2e-3 for n, a in enumerate(bases) for b in bases[:n])
        standing = env.task._builder(env.scene, np.random.default_rng(0))._standing
        assert len(standing) <= 1


@pytest.mark.parametrize("env_id", [HOUSE_2, RAMP])
def test_only_a_fallen_roof_ends_the_episode(make: Make, env_id: str) -> None:
    env = make(env_id)
    for seed in range(4):
        env.reset(seed=seed)
        assert env.task.is_valid(env.scene)
        roof = env.scene["roof"]
        roof.place(roof.pose.compose(euler_pose((0.0, 0.0, 0.0), (math.pi, 0.0, 0.0))))
        assert not env.task.is_valid(env.scene)


# The expert


def optimal(env: ManipulationEnv, base_on_site: bool) -> int:
    return 2 * (len(env.scene.objects) - base_on_site)


def test_expert_wastes_nothing(make: Make) -> None:
    for env_id, on_site in ((HOUSE_4, True), (IMPROVISE_3, True), (BUMP, False)):
        env = make(env_id)
        env.reset(seed=1)
        assert finish(env) == optimal(env, on_site)


@pytest.mark.parametrize(
    ("wrong", "steps"),
    [
        ({"cube_0": (0.0, 0.0), "brick": (0.0, CUBE)}, 8),
        ({**PAIR, "roof": (0.0, CUBE)}, 6),
        ({**PAIR, "brick": (0.0, CUBE, CENTRE, 1.0)}, 4),
        ({"cube_0": (0.0, 0.0), "cube_1": (0.0, CUBE)}, 6),
        ({"brick": (0.0, 0.0), "cube_0": (-0.03, CUBE), "cube_1": (0.03, CUBE)}, 8),
    ],
    ids=str,
)
def test_expert_takes_apart_what_is_wrong(
    make: Make, wrong: dict[str, tuple[float, ...]], steps: int
) -> None:
    env = make(HOUSE_3)
    env.reset(seed=0)
    lay(env, **wrong)
    assert finish(env) <= steps


def test_fingers_find_room(make: Make) -> None:
    """Between two blocks the fingers close along the row, not across it into the neighbours."""
    env = make(HOUSE_3)
    env.reset(seed=0)
    lay(env, cube_0=(0.0, 0.0), brick=(0.0, 0.0, CENTRE + 0.045), roof=(0.0, 0.0, CENTRE - 0.045))
    cube = env.scene["cube 0"]
    hand = pick(env.scene, cube, np.random.default_rng(0)).pose
    assert abs(math.cos(hand.yaw)) < 0.01 and fingers_fit(env.scene, hand, cube)
    assert not fingers_fit(env.scene, cube.pose, cube)


@pytest.mark.parametrize(("robot", "fits"), [("panda", False), ("kuka", True)])
def test_a_wide_palm_needs_room_over_what_is_beside(make: Make, robot: str, fits: bool) -> None:
    """The fingers come down beside a cube, but the Panda's palm would strike what stands 9 cm away."""
    env = make(HOUSE_3, robot=robot)
    env.reset(seed=0)
    cube, brick = env.scene["cube 0"], env.scene["brick"]
    cube.place(Pose((0.45, 0.0, 0.015)))
    for other in env.scene:
        if other is not cube:
            other.place(Pose((0.6, 0.15, 0.015)))
    brick.place(Pose((0.54, 0.0, 0.06)))
    straight = Pose.planar(0.45, 0.0, 0.015)
    assert fingers_fit(env.scene, straight, cube)
    assert palm_fits(env.scene, straight, cube) == fits
    assert palm_fits(env.scene, Pose.planar(0.45, 0.0, 0.015, math.pi / 2.0), cube)


def blocks_of(scene: Scene) -> list[SceneObject]:
    return [item for item in scene if item.slot.name.startswith("block")]


def test_random_blocks_are_grasped_square_on(make: Make) -> None:
    """The fingers come down on both sides of what they close on, in the middle of it."""
    env = make(IMPROVISE_3)
    for seed in range(10):
        env.reset(seed=seed)
        for item in blocks_of(env.scene):
            inside = item.pose.inverse().transform(resting_frame(item).position)
            low, high = item.spec.mesh.bounds[:, :2]
            assert (low < inside[:2]).all() and (inside[:2] < high).all()
            pieces = item.spec.piece_bounds
            across = pieces[(pieces[:, 0, 1] < inside[1] + 0.01) & (pieces[:, 1, 1] > inside[1] - 0.01)]
            middle = (across[:, 0, 0].min() + across[:, 1, 0].max()) / 2.0
            assert inside[0] == pytest.approx(middle, abs=1e-6)


@pytest.mark.parametrize("seed", [25, 78, 111])
def test_random_blocks_come_to_their_places_without_being_turned(make: Make, seed: int) -> None:
    """The fingers hold these off their middles, and the line they are to stand along points backwards."""
    env = make(IMPROVISE_2, action_sequence="pxy", random_orientation=False)
    env.reset(seed=seed)
    assert finish(env) == 4
