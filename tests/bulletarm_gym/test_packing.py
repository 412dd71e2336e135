"""Tasks that pack, palletise, present and sort: success, validity, and special cases of the plan."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.experts import CLOSED, OPEN, Waypoint
from bulletarm_gym.experts.approach import PRECISE
from bulletarm_gym.geometry import Footprint, PlacementError, Pose
from bulletarm_gym.objects.containers import BIN, BIN_WALL, PALLET
from bulletarm_gym.scene.predicates import inside, loose_objects
from bulletarm_gym.scene.sampling import footprint
from bulletarm_gym.simulation.shapes import BLUE, RED
from bulletarm_gym.tasks.packing import FreeSpace
from bulletarm_gym.tasks.palletizing import layer_yaw, places

Make = Callable[..., ManipulationEnv]

PACKING, BOTTLES = "BulletArm/OpenLoopBinPacking-v0", "BulletArm/OpenLoopBottleArrangement-v0"
PALLETIZING, BUMP = "BulletArm/OpenLoopBoxPalletizing-v0", "BulletArm/OpenLoopBumpBoxPalletizing-v0"
COVID = "BulletArm/OpenLoopCovidTest-v0"
SORTING = ("BulletArm/CloseLoopBlockSorting-v0", "BulletArm/OpenLoopBlockSorting-v0")
WIDTH, LENGTH, HEIGHT = 0.045, 0.072, 0.045


def place_while_empty(env: ManipulationEnv) -> tuple[bool, dict[str, bool]]:
    """Act without effect on the robot; return whether that terminated the episode, and the info."""
    *_, terminated, _, info = env.step(np.ones(env.action_space.shape, np.float32))
    return terminated, info


def smallest_gap(footprints: list[Footprint]) -> float:
    return min(one.gap(other) for number, one in enumerate(footprints) for other in footprints[:number])


def place(env: ManipulationEnv, frame: str, **poses: Pose) -> None:
    """Place objects, named with underscores, at poses in the frame of another object."""
    for name, pose in poses.items():
        env.scene[name.replace("_", " ")].place(env.scene[frame].pose.compose(pose))


# Bin and bottles


@pytest.mark.parametrize(
    ("local", "packed"),
    [
        ((0.08, 0.06, 0.079), True),
        ((0.0, 0.0, 0.081), False),
        ((0.09, 0.0, 0.03), False),
        ((0.0, 0.074, 0.03), False),
    ],
)
def test_blocks_are_packed_below_the_rim(make: Make, local: Any, packed: bool) -> None:
    env = make(PACKING, num_objects=1)
    env.reset(seed=0)
    place(env, "bin", block_0=Pose(local))
    assert env.task.evaluate(env.scene)["is_packed"] == packed


def test_expert_packs_eight_of_the_largest_blocks(make: Make) -> None:
    env = make(PACKING)
    env.reset(seed=3)
    for item in env.scene.objects[1:]:
        pose = item.pose
        item.park()
        item.variant = 5
        item.place(Pose.planar(pose.x, pose.y, item.spec.extents[2] / 2.0, pose.yaw))
    for _ in range(20):
        *_, terminated, _, info = env.step(env.expert_action())
        if terminated:
            break
    assert info["is_success"]
    assert BIN[2] == 0.08


def test_block_is_released_above_a_gap_without_space_for_the_fingers(make: Make) -> None:
    env = make("BulletArm/CloseLoopBinPacking-v0", robot="panda")
    env.reset(seed=0)
    block, tool = env.scene["block 0"], env.scene.robot.pose
    block.variant = 6
    block.place(tool)
    space, around = FreeSpace(env.scene, block), 0.07
    in_gap = np.maximum(np.abs(space._xs)[:, None], np.abs(space._ys)) < 0.024
    space._heights = np.where(in_gap, BIN_WALL, around)
    goal = env.scene["bin"].pose.inverse().compose(space.best())
    assert goal.position[:2] == pytest.approx((0.0, 0.0), abs=0.003)
    assert around < goal.z < around + 0.005


def test_bottles_are_upright_in_the_tray(make: Make) -> None:
    env = make(BOTTLES, num_objects=1)
    env.reset(seed=0)
    half = env.scene["bottle 0"].spec.extents[2] / 2.0
    for local, arranged in (((0.05, 0.03, 0.005 + half), True), ((0.15, 0.0, half), False)):
        place(env, "tray", bottle_0=Pose(local))
        assert env.task.evaluate(env.scene)["is_arranged"] == arranged and env.task.is_valid(env.scene)
    place(env, "tray", bottle_0=Pose((0.05, 0.03, 0.1), (0.7071, 0.0, 0.0, 0.7071)))
    assert not env.task.is_valid(env.scene) and not env.task.evaluate(env.scene)["success"]


# Pallet


@pytest.fixture
def pallet(make: Make) -> ManipulationEnv:
    env = make(PALLETIZING, max_steps=100)
    env.reset(seed=0)
    return env


def stack(env: ManipulationEnv, count: int, yaw: float = 0.0) -> None:
    """Put boxes in the first places, all rotated by an angle (rad)."""
    for number, box in enumerate(env.scene.objects[1 : 1 + count]):
        layer, place = divmod(number, 6)
        height = PALLET[2] + (layer + 0.5) * HEIGHT
        frame = places(layer, WIDTH, LENGTH)[place].compose(Pose.planar(0.0, 0.0, height, yaw))
        box.place(env.scene["pallet"].pose.compose(frame))


@pytest.mark.parametrize(
    ("count", "yaw", "correct"),
    [
        (1, 0.35, True),
        (1, -0.35, True),
        (1, 0.45, False),
        (1, -0.45, False),
        (1, math.pi / 2.0, False),
        (6, 0.0, True),
        (7, math.pi, True),
        (17, 0.0, True),
    ],
)
def test_next_box_appears_when_all_are_correct(
    pallet: ManipulationEnv, count: int, yaw: float, correct: bool
) -> None:
    stack(pallet, count, yaw)
    for _ in range(2):
        place_while_empty(pallet)
        assert len(loose_objects(pallet.scene)) == count + correct
    assert not pallet.task.evaluate(pallet.scene)["success"]


def test_next_box_waits_for_full_layers_below(pallet: ManipulationEnv) -> None:
    stack(pallet, 8)
    pallet.scene["box 2"].park()
    place_while_empty(pallet)
    assert len(loose_objects(pallet.scene)) == 7
    stack(pallet, 18)
    assert place_while_empty(pallet)[1]["is_success"]


def test_next_box_waits_for_an_empty_gripper(make: Make) -> None:
    env = make(PALLETIZING, max_steps=100)
    env.reset(seed=1)
    for count in (1, 2):
        env.step(env.expert_action())
        assert len(loose_objects(env.scene)) == count and (env.scene.held is None) is (count == 2)


@pytest.mark.parametrize("env_id", [PALLETIZING, BUMP])
@pytest.mark.parametrize("parameters", [{}, {"random_orientation": False}], ids=str)
def test_boxes_appear_inside_and_apart(make: Make, env_id: str, parameters: dict[str, Any]) -> None:
    env = make(env_id, max_steps=100, **parameters)
    for seed in range(20):
        layer = seed % 3
        env.reset(seed=seed)
        stack(env, 6 * layer)
        _, info = place_while_empty(env)
        box, base = env.scene[f"box {6 * layer}"], env.scene["pallet"]
        assert info["is_valid"] and info["is_at_rest"]
        assert footprint(box).is_inside(env.config.workspace) and footprint(box).gap(footprint(base)) > 0.0
        if parameters and env_id == PALLETIZING:
            yaw = box.pose.yaw - base.pose.yaw - layer_yaw(layer)
            assert math.sin(yaw) == pytest.approx(0.0, abs=1e-3)


def test_episode_ends_if_the_next_box_has_no_free_pose(
    pallet: ManipulationEnv, monkeypatch: pytest.MonkeyPatch
) -> None:
    stack(pallet, 1)

    def full(*_: Any) -> None:
        raise PlacementError("workspace: found no room")

    monkeypatch.setattr("bulletarm_gym.tasks.palletizing.sample_until", full)
    _, reward, terminated, _, info = pallet.step(np.ones(pallet.action_space.shape, np.float32))
    assert (reward, terminated, info["is_valid"]) == (0.0, True, False)
    monkeypatch.undo()
    state = pallet.get_state()
    assert pallet.reset(seed=0)[1]["is_valid"]
    pallet.set_state(state)
    assert not pallet.task.is_valid(pallet.scene)


def test_expert_corrects_a_misplaced_box(make: Make) -> None:
    env = make(PALLETIZING, max_steps=100, num_objects=6)
    env.reset(seed=2)
    for _ in range(5):
        env.step(env.expert_action())
    tool = env.scene.robot.pose
    askew = env.scene["pallet"].pose.compose(Pose.planar(0.0, 0.0, 0.0, 0.8))
    waypoint = Waypoint(Pose.planar(askew.x, askew.y, tool.z, askew.yaw), CLOSED, OPEN)
    env.step(env.encode_action(env.tracker.towards(waypoint)))
    assert len(loose_objects(env.scene)) == 3
    terminated = False
    for _ in range(10):
        *_, terminated, _, info = env.step(env.expert_action())
        assert terminated == info["is_success"]
        if terminated:
            return
    raise AssertionError


# Covid tests


@pytest.fixture
def covid(make: Make) -> ManipulationEnv:
    env = make(COVID, max_steps=100)
    env.reset(seed=0)
    return env


def test_containers_touch_and_are_inside(make: Make) -> None:
    env = make(COVID)
    for seed in range(20):
        env.reset(seed=seed)
        containers = [env.scene[name] for name in ("new box", "test area", "used box")]
        assert all(footprint(place).is_inside(env.config.workspace) for place in containers)
        local = containers[1].pose.inverse()  # gaps are exact in this frame
        assert smallest_gap([footprint(place, local.compose(place.pose)) for place in containers]) > -1e-6
        loose = loose_objects(env.scene)
        assert len(loose) == 6 and all(inside(obj, containers[0]) for obj in loose)


def test_pair_becomes_a_used_tube_at_a_random_pose(make: Make) -> None:
    env, poses = make(COVID, max_steps=100), []
    for seed in range(12):
        env.reset(seed=seed)
        place(env, "test area", swab_1=Pose((0.0, 0.06, 0.012)))
        assert not place_while_empty(env)[0] and env.scene["swab 1"].is_present
        place(env, "test area", tube_2=Pose((0.0, -0.06, 0.012)))
        assert not place_while_empty(env)[0]
        names = {item.slot.name for item in loose_objects(env.scene)}
        assert names == {"swab 0", "swab 2", "tube 0", "tube 1", "used tube 0"}
        used = env.scene["used tube 0"]
        assert inside(used, env.scene["test area"])
        frame = env.scene["test area"].pose.inverse().compose(used.pose)
        poses.append((frame.y, frame.yaw))
    assert (np.ptp(poses, axis=0) > (0.08, 2.0)).all()


@pytest.mark.parametrize("names", [("swab_0", "swab_1"), ("tube_0", "tube_1"), ("tube_0", "used_tube_0")])
def test_two_of_a_kind_in_the_test_area_are_invalid(covid: ManipulationEnv, names: tuple[str, str]) -> None:
    place(covid, "test area", **{names[0]: Pose((0.0, -0.06, 0.012)), names[1]: Pose((0.0, 0.06, 0.012))})
    terminated, info = place_while_empty(covid)
    assert terminated and not info["is_valid"] and not info["is_success"]


def test_three_used_tubes_in_their_box_are_the_goal(covid: ManipulationEnv) -> None:
    for number in range(3):
        assert not covid.task.evaluate(covid.scene)["success"]
        place(covid, "used box", **{f"used_tube_{number}": Pose((0.0, 0.025 * (number - 1), 0.012))})
    assert covid.task.evaluate(covid.scene)["success"]


def test_fingers_around_a_swab_keep_clear_of_the_tubes(make: Make) -> None:
    env = make("BulletArm/CloseLoopCovidTest-v0", robot="ur5_robotiq")
    gripper = env.scene.robot.model.gripper
    thickness, width, _ = gripper.finger
    for seed in range(10):
        env.reset(seed=seed)
        tubes = [footprint(env.scene[f"tube {number}"]) for number in range(3)]
        pick = next(iter(env.task.plan(env.scene, np.random.default_rng(0))))
        offset = (pick.gripper * gripper.stroke + thickness) / 2.0
        fingers = [pick.pose.compose(Pose((side * offset, 0.0, 0.0))) for side in (1.0, -1.0)]
        bases = [Footprint.rectangle((thickness, width), finger) for finger in fingers]
        assert min(base.gap(tube) for base in bases for tube in tubes) > 2.0 * PRECISE


# Sorting


def fill_bowls(env: ManipulationEnv, swapped: bool) -> None:
    """Place two cubes in each bowl, of its colour or of the other."""
    env.reset(seed=0)
    x, y = env.config.centre
    sites = {"red": (x, y - 0.08), "blue": (x, y + 0.08)}
    for name, site in sites.items():
        env.scene[f"{name} bowl"].place(Pose.planar(*site, 0.028))
    for name, other in (("red", "blue"), ("blue", "red")):
        site = sites[other if swapped else name]
        for number, aside in enumerate((-0.0157, 0.0157)):
            env.scene[f"{name} cube {number}"].place(Pose.planar(site[0] + aside, site[1], 0.021))


@pytest.mark.parametrize("env_id", SORTING)
def test_only_colours_show_which_cubes_are_sorted(make: Make, env_id: str) -> None:
    env, observed = make(env_id), []
    for swapped in (False, True):
        fill_bowls(env, swapped)
        observed.append(env.observe())
        assert env.task.is_valid(env.scene)
        assert env.task.evaluate(env.scene)["success"] is not swapped
        for colour in (RED, BLUE):
            code = np.array([round(255 * part) for part in colour[:3]])[:, None, None]
            assert (observed[-1]["color"] == code).all(axis=0).sum() > 100
    assert np.array_equal(observed[0]["heightmap"], observed[1]["heightmap"])
    assert not np.array_equal(observed[0]["color"], observed[1]["color"])


def test_cube_next_to_its_bowl_is_not_sorted_and_a_fallen_bowl_is_invalid(make: Make) -> None:
    env = make(SORTING[0])
    fill_bowls(env, swapped=False)
    env.scene["red cube 0"].place(Pose.planar(env.config.centre[0] + 0.1, 0.0, 0.015))
    assert not env.task.evaluate(env.scene)["is_sorted"]
    env.scene["red bowl"].place(Pose(env.scene["red bowl"].pose.position, (1.0, 0.0, 0.0, 0.0)))
    assert not env.task.is_valid(env.scene)
