"""Predicates on objects, structures of blocks, and how the expert builds and corrects them."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest

from bulletarm_gym.config import CLOSE_LOOP
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.experts.blueprint import Blueprint
from bulletarm_gym.experts.pick_place import fingers_fit, palm_fits, pick, resting_frame
from bulletarm_gym.geometry import Pose, euler_pose
from bulletarm_gym.scene import Scene, SceneObject
from bulletarm_gym.scene import predicates as are
from bulletarm_gym.scene.sampling import footprint
from bulletarm_gym.tasks.stacking import BLOCK_SPACING, Structure

Make = Callable[..., ManipulationEnv]

CUBE = 0.03
CENTRE = 0.45
HOUSE_1 = "BulletArm/OpenLoopHouseBuilding1-v0"
HOUSE_2 = "BulletArm/OpenLoopHouseBuilding2-v0"
HOUSE_3 = "BulletArm/OpenLoopHouseBuilding3-v0"
HOUSE_4 = "BulletArm/OpenLoopHouseBuilding4-v0"
IMPROVISE_2 = "BulletArm/OpenLoopImproviseHouseBuilding2-v0"
IMPROVISE_3 = "BulletArm/OpenLoopImproviseHouseBuilding3-v0"
RAMP = "BulletArm/OpenLoopRampHouseBuilding2-v0"
BUMP = "BulletArm/OpenLoopBumpHouseBuilding4-v0"
STACKING = "BulletArm/CloseLoopBlockStacking-v0"
PAIR = {"cube_0": (-0.025, 0.0), "cube_1": (0.025, 0.0)}


def lay(env: ManipulationEnv, **places: Sequence[float]) -> ManipulationEnv:
    """Place blocks at y, height of their lowest points and, if given, x and yaw; all others aside."""
    env.reset(seed=0)
    aside = np.linspace(-0.16, 0.16, len(env.scene.objects)).tolist()
    for y, obj in zip(aside, env.scene.objects, strict=True):
        obj.place(Pose.planar(0.32, y, CUBE / 2.0, math.pi / 2.0))
    for name, (y, low, *rest) in places.items():
        x, yaw = (*rest, CENTRE, 0.0)[:2] if len(rest) != 1 else (rest[0], 0.0)
        env.scene[name.replace("_", " ")].place(Pose.planar(x, y, low + CUBE / 2.0, yaw))
    return env


def is_built(env: ManipulationEnv) -> bool:
    return env.task.evaluate(env.scene)["success"]


def finish(env: ManipulationEnv) -> int:
    """Act by the expert; return its number of steps to success."""
    for count in range(1, env.config.max_steps + 1):
        *_, terminated, _, info = env.step(env.expert_action())
        if terminated:
            assert info["is_success"], info
            return count
    raise AssertionError("the structure is not built")


# Predicates


@pytest.fixture
def cubes(make: Make) -> Scene:
    env = make(STACKING, num_objects=3)
    env.reset(seed=0)
    return env.scene


def place(scene: Scene, *positions: tuple[float, float, float]) -> list[SceneObject]:
    """Place the cubes of 5 cm relative to x = 0.45, y = 0 m."""
    for obj, (x, y, z) in zip(scene.objects, positions, strict=True):
        obj.place(Pose.planar(0.45 + x, y, z))
    return scene.objects


@pytest.mark.parametrize(
    ("positions", "expected"),
    [
        (((0.0, 0.0, 0.125), (0.01, 0.0, 0.025), (0.0, 0.01, 0.075)), True),
        (((0.0, 0.0, 0.125), (0.1, 0.0, 0.025), (0.0, 0.01, 0.075)), False),
        (((0.0, 0.0, 0.135), (0.0, 0.0, 0.035), (0.0, 0.0, 0.085)), False),  # not on the surface
        (((0.0, 0.0, 0.025), (0.0, 0.05, 0.025), (0.0, 0.025, 0.075)), False),  # two at one level
    ],
)
def test_stacked(cubes: Scene, positions: tuple[tuple[float, float, float], ...], expected: bool) -> None:
    assert are.stacked(cubes, place(cubes, *positions)) is expected


def test_grasped_object_is_not_stacked(make: Make) -> None:
    env = make(STACKING)
    env.reset(seed=0)
    while env.scene.held is None:
        env.step(env.expert_action())
    held = env.scene.held
    (other,) = (obj for obj in env.scene if obj is not held)
    other.place(Pose.planar(held.pose.x, held.pose.y, held.pose.z + 0.0505))
    assert are.on_top(env.scene, held, other) and not are.stacked(env.scene, env.scene)


def test_relations_of_two_cubes(cubes: Scene) -> None:
    for aside, expected in ((0.024, True), (0.026, False)):
        first, second, _ = place(cubes, (0.0, 0.0, 0.025), (0.0, aside, 0.075), (0.1, 0.1, 0.075))
        assert are.on_top(cubes, first, second) is expected
        assert not are.on_top(cubes, second, first)
    assert [are.is_top(obj, cubes.objects) for obj in cubes.objects] == [False, True, True]
    for gap, expected in ((0.001, True), (0.003, False)):
        first, second, _ = place(cubes, (0.0, 0.0, 0.025), (0.0, 0.05 + gap, 0.025), (0.1, -0.1, 0.025))
        assert are.touching(cubes, first, second) is expected


def test_poses_of_one_cube(cubes: Scene) -> None:
    cube = cubes.objects[0]
    for degrees, is_upright in ((19.0, True), (21.0, False), (90.0, False)):
        cube.place(euler_pose((0.45, 0.0, 0.1), (0.0, math.radians(degrees), 0.0)))
        assert are.upright(cube) is is_upright
    edge = euler_pose((0.45, 0.0, 0.025 * math.sqrt(2.0)), (math.pi / 4.0, 0.0, 0.0))
    for pose, touches in (
        (Pose.planar(0.45, 0.0, 0.025, 0.3), True),
        (edge, True),
        (Pose((0.45, 0, 0.03)), False),
    ):
        cube.place(pose)
        assert are.on_surface(cubes, cube) is touches
    cubes.begin()
    cubes.world.step(3)
    cubes.world.end()
    assert not are.at_rest(cubes)


def test_inside_ignores_the_height(make: Make) -> None:
    env = make("BulletArm/OpenLoopBinPacking-v0")
    env.reset(seed=0)
    container, block = env.scene["bin"], env.scene["block 0"]
    for x, y, expected in ((0.087, 0.071, True), (0.089, 0.0, False), (0.0, -0.073, False)):
        block.place(container.pose.compose(Pose((x, y, 0.3))))
        assert are.inside(block, container) is expected


def test_relations_of_a_long_block(make: Make) -> None:
    scene = lay(make(HOUSE_3), **PAIR, brick=(0.0, CUBE)).scene
    cube, brick = scene["cube 0"], scene["brick"]
    pair = [cube, scene["cube 1"]]
    for y, degrees, expected in ((0.0, 0.0, True), (0.029, 25.0, True), (0.031, 26.0, False)):
        brick.place(Pose.planar(CENTRE, y, 1.5 * CUBE, math.radians(degrees)))
        assert are.between(brick, pair, CUBE) is are.lies_along(brick, pair[::-1]) is expected
    for quarter in range(4):
        brick.place(euler_pose(brick.pose.position, (0.0, quarter * math.pi / 2.0, 0.3)))
        assert are.lies_along(brick, pair) and are.lies_flat(brick)
        assert abs(math.sin(resting_frame(brick).yaw - 0.3)) < 1e-6
    brick.place(euler_pose(brick.pose.position, (math.pi / 2.0, 0.0, 0.0)))
    assert not are.lies_along(brick, pair)
    for height, expected in ((1.5, True), (1.7, False)):  # only its end is on the cube
        brick.place(Pose.planar(CENTRE, cube.pose.y + 0.065, height * CUBE))
        assert are.carries(scene, cube, brick) is are.rests_on(scene, cube, brick) is expected
        assert not are.on_top(scene, cube, brick)


# Success


@pytest.mark.parametrize(
    ("blocks", "expected"),
    [
        ({"roof": (0.0, CUBE)}, True),
        ({"roof": (0.0, CUBE, CENTRE + 0.012, math.pi)}, True),
        ({"roof": (0.028, CUBE)}, True),
        ({"roof": (0.032, CUBE)}, False),
        ({"roof": (0.0, CUBE, CENTRE, math.radians(24.0))}, True),
        ({"roof": (0.0, CUBE, CENTRE, math.radians(27.0))}, False),
        ({"roof": (0.0, CUBE + 0.004)}, False),
        ({"roof": (0.1, 0.0)}, False),
        (
            {"cube_1": (-0.025, 0.0, CENTRE, 0.5), "cube_0": (0.025, 0.0, CENTRE, 2.0), "roof": (0.0, CUBE)},
            True,
        ),
        ({"cube_0": (0.0, 0.0), "cube_1": (0.1, 0.0), "roof": (0.0, CUBE)}, False),
    ],
    ids=str,
)
def test_success_of_a_roof_on_two_cubes(
    make: Make, blocks: dict[str, tuple[float, ...]], expected: bool
) -> None:
    assert is_built(lay(make(HOUSE_2), **{**PAIR, **blocks})) is expected


@pytest.mark.parametrize(
    ("change", "expected"),
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
def test_success_of_a_house_of_four_layers(
    make: Make, change: dict[str, tuple[float, ...]], expected: bool
) -> None:
    upper = {"cube_2": (-0.03, 2 * CUBE), "cube_3": (0.03, 2 * CUBE), "roof": (0.0, 3 * CUBE)}
    assert is_built(lay(make(HOUSE_4), **{**PAIR, "brick": (0.0, CUBE), **upper, **change})) is expected


def test_a_grasped_roof_is_not_built(make: Make) -> None:
    env = make(HOUSE_2)
    env.reset(seed=3)
    for _ in range(3):
        *_, info = env.step(env.expert_action())
    assert env.scene.held is env.scene["roof"] and not info["is_built"]


def test_blueprint_rejects_layers_without_support() -> None:
    with pytest.raises(ValueError, match=r"layers must .* got 3 on 2"):
        Blueprint([["cube"] * 2, ["cube"] * 3], (), CUBE)


# Starts and the expert


@pytest.mark.parametrize("env_id", [HOUSE_4, IMPROVISE_3, RAMP, BUMP, STACKING])
def test_episodes_start_with_separate_blocks(make: Make, env_id: str) -> None:
    env = make(env_id)
    # On bumps blocks tilt until they rest; in closed loop the centres have a minimum distance.
    gap = BLOCK_SPACING * (1.0 if env.scene.surface.keeps_poses else 0.25)
    gap *= 0.6 if env.config.control == CLOSE_LOOP else 1.0
    for seed in range(3):
        env.reset(seed=seed)
        bases = [footprint(obj) for obj in env.scene]
        assert all(a.gap(b) > gap - 2e-3 for n, a in enumerate(bases) for b in bases[:n])
        assert isinstance(env.task, Structure)
        assert len(env.task.builder(env.scene, np.random.default_rng(0)).placed) <= 1


@pytest.mark.parametrize("env_id", [HOUSE_2, RAMP])
def test_a_fallen_roof_ends_the_episode(make: Make, env_id: str) -> None:
    env = make(env_id)
    env.reset(seed=0)
    roof = env.scene["roof"]
    assert env.task.is_valid(env.scene)
    roof.place(roof.pose.compose(euler_pose((0.0, 0.0, 0.0), (math.pi, 0.0, 0.0))))
    _, reward, terminated, _, info = env.step(env.expert_action())
    assert (reward, terminated, info["is_valid"]) == (0.0, True, False)


@pytest.mark.parametrize(
    ("env_id", "parameters", "picks"),
    [
        (HOUSE_4, {}, 5),
        (IMPROVISE_3, {}, 3),
        (BUMP, {}, 6),
        (HOUSE_1, {"action_sequence": "xyzrrr"}, 3),
        (HOUSE_1, {"half_rotation": False, "workspace": [[0.3, 0.6], [-0.1, 0.2], [0.0, 0.5]]}, 3),
        (HOUSE_1, {"object_scale_range": [0.5, 0.8], "num_objects": 3}, 2),
    ],
    ids=str,
)
def test_expert_needs_two_steps_a_block(
    make: Make, env_id: str, parameters: dict[str, Any], picks: int
) -> None:
    """The first block stays where it is, except on bumps."""
    env = make(env_id, **parameters)
    env.reset(seed=1)
    assert finish(env) == 2 * picks


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
def test_expert_takes_wrong_structures_apart(
    make: Make, wrong: dict[str, tuple[float, ...]], steps: int
) -> None:
    assert finish(lay(make(HOUSE_3), **wrong)) <= steps


def test_fingers_close_along_a_row_of_blocks(make: Make) -> None:
    env = lay(
        make(HOUSE_3),
        cube_0=(0.0, 0.0),
        brick=(0.0, 0.0, CENTRE + 0.045),
        roof=(0.0, 0.0, CENTRE - 0.045),
    )
    cube = env.scene["cube 0"]
    pose = pick(env.scene, cube, np.random.default_rng(0)).pose
    assert abs(math.cos(pose.yaw)) < 0.01 and fingers_fit(env.scene, pose, cube)
    assert not fingers_fit(env.scene, cube.pose, cube)


@pytest.mark.parametrize(("robot", "fits"), [("panda", False), ("kuka", True)])
def test_a_wide_palm_needs_space_above_neighbours(make: Make, robot: str, fits: bool) -> None:
    env = lay(make(HOUSE_3, robot=robot), cube_0=(0.0, 0.0), brick=(0.0, 0.045, CENTRE + 0.09))
    cube, above = env.scene["cube 0"], Pose.planar(CENTRE, 0.0, CUBE / 2.0)
    assert fingers_fit(env.scene, above, cube)
    assert palm_fits(env.scene, above, cube) == fits
    assert palm_fits(env.scene, above.compose(Pose.planar(0.0, 0.0, 0.0, math.pi / 2.0)), cube)


@pytest.mark.parametrize("seed", [25, 78, 111])
def test_random_blocks_are_placed_without_a_rotation(make: Make, seed: int) -> None:
    """The blocks of these seeds are grasped off their middles, and their line points backwards."""
    env = make(IMPROVISE_2, action_sequence="pxy", random_orientation=False)
    env.reset(seed=seed)
    assert finish(env) == 4
