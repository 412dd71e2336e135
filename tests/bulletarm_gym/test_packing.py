"""Bin Packing and Bottle Arrangement: what counts as in, and where things are put."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.geometry import Footprint, Pose
from bulletarm_gym.objects.containers import BIN, BIN_WALL, TRAY
from bulletarm_gym.scene.sampling import footprint
from bulletarm_gym.tasks.packing import FreeSpace, tray_positions

Make = Callable[..., ManipulationEnv]

PACKING, BOTTLES = "BulletArm/OpenLoopBinPacking-v0", "BulletArm/OpenLoopBottleArrangement-v0"
FIXED = {"action_sequence": "pxy", "random_orientation": False}


@pytest.mark.parametrize("env_id", [PACKING, BOTTLES])
@pytest.mark.parametrize("parameters", [{}, FIXED], ids=str)
def test_arrangements_keep_apart_and_inside(make: Make, env_id: str, parameters: dict[str, Any]) -> None:
    env = make(env_id, **parameters)
    for seed in range(40):
        _, info = env.reset(seed=seed)
        bases = [footprint(item) for item in env.scene]
        assert info["is_valid"] and not info["is_success"]
        assert all(base.is_inside(env.config.workspace) for base in bases)
        assert min(one.gap(other) for number, one in enumerate(bases) for other in bases[:number]) > 0.02


@pytest.mark.parametrize(("env_id", "steps"), [(PACKING, 16), (BOTTLES, 12)])
@pytest.mark.parametrize("parameters", [{}, FIXED], ids=str)
def test_expert_solves_in_the_papers_steps(
    make: Make, env_id: str, steps: int, parameters: dict[str, Any]
) -> None:
    env = make(env_id, **parameters)
    env.reset(seed=1)
    for step in range(1, steps + 1):
        *_, terminated, truncated, info = env.step(env.expert_action())
        assert info["is_success"] == (step == steps) == terminated and not truncated


@pytest.mark.parametrize(
    ("local", "packed"),
    [
        ((0.0, 0.0, 0.03), True),
        ((0.08, 0.06, 0.079), True),
        ((0.0, 0.0, 0.081), False),
        ((0.09, 0.0, 0.03), False),
        ((0.0, 0.074, 0.03), False),
    ],
)
def test_blocks_are_packed_below_the_rim(make: Make, local: Any, packed: bool) -> None:
    env = make(PACKING, num_objects=1)
    for seed in range(3):
        env.reset(seed=seed)
        env.scene["block 0"].place(env.scene["bin"].pose.compose(Pose(local)))
        assert env.task.evaluate(env.scene)["is_packed"] == packed


def test_eight_of_the_largest_blocks_go_in(make: Make) -> None:
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


def test_block_is_released_above_a_gap_without_room_for_the_fingers(make: Make) -> None:
    env = make("BulletArm/CloseLoopBinPacking-v0", robot="panda")
    env.reset(seed=0)
    block, hand = env.scene["block 0"], env.scene.robot.pose
    block.variant = 6
    block.place(hand)
    room, around = FreeSpace(env.scene, block), 0.07
    in_gap = np.maximum(np.abs(room._xs)[:, None], np.abs(room._ys)) < 0.024
    room._heights = np.where(in_gap, BIN_WALL, around)
    goal = env.scene["bin"].pose.inverse().compose(room.best())
    assert goal.position[:2] == pytest.approx((0.0, 0.0), abs=0.003)
    assert around < goal.z < around + 0.005


def test_bottles_have_places_in_the_tray() -> None:
    half = [[-side / 2.0, side / 2.0] for side in TRAY[:2]]
    bases = [Footprint.rectangle((0.055, 0.055), place) for place in tray_positions()]
    assert all(base.is_inside(half, 0.01) for base in bases)
    assert min(one.gap(other) for number, one in enumerate(bases) for other in bases[:number]) > 0.02


def test_fallen_bottles_end_the_episode(make: Make) -> None:
    env = make(BOTTLES)
    env.reset(seed=0)
    item = env.scene["bottle 2"]
    item.place(Pose((item.pose.x, item.pose.y, 0.1), (0.7071, 0.0, 0.0, 0.7071)))
    assert not env.task.is_valid(env.scene)
    assert not env.task.evaluate(env.scene)["success"]


def test_bottles_beside_the_tray_are_not_in_it(make: Make) -> None:
    env = make(BOTTLES, num_objects=1)
    env.reset(seed=0)
    tray, item = env.scene["tray"].pose, env.scene["bottle 0"]
    half = item.spec.extents[2] / 2.0
    for local, inside in (((0.05, 0.03, 0.005 + half), True), ((0.15, 0.0, half), False)):
        item.place(tray.compose(Pose(local)))
        assert env.task.evaluate(env.scene)["is_arranged"] == inside
