"""Box Palletizing: which places are right, and when the next box appears."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.experts import CLOSED, OPEN, Waypoint
from bulletarm_gym.geometry import Footprint, PlacementError, Pose
from bulletarm_gym.objects.containers import PALLET
from bulletarm_gym.scene.sampling import footprint
from bulletarm_gym.tasks.palletizing import BoxPalletizing, layer_yaw, places

Make = Callable[..., ManipulationEnv]

FLAT, BUMP = "BulletArm/OpenLoopBoxPalletizing-v0", "BulletArm/OpenLoopBumpBoxPalletizing-v0"
WIDTH, LENGTH, HEIGHT = 0.045, 0.072, 0.045
FIXED = {"action_sequence": "pxy", "random_orientation": False}


@pytest.fixture
def env(make: Make) -> ManipulationEnv:
    env = make(FLAT, max_steps=100)
    env.reset(seed=0)
    return env


def stack(env: ManipulationEnv, count: int, turn: float = 0.0, sink: float = 0.0) -> None:
    """Put boxes in the first places, all turned by an angle (rad), and lower (m) than they should be."""
    scene = env.scene
    for number, box in enumerate(scene.objects[1 : 1 + count]):
        layer, place = divmod(number, 6)
        height = PALLET[2] + (layer + 0.5) * HEIGHT - sink
        frame = places(layer, WIDTH, LENGTH)[place].compose(Pose.planar(0.0, 0.0, height, turn))
        box.place(scene["pallet"].pose.compose(frame))


def right(env: ManipulationEnv) -> int:
    assert isinstance(env.task, BoxPalletizing)
    return len(env.task._correct(env.scene))


def present(env: ManipulationEnv) -> int:
    return sum(1 for _ in env.scene) - 1


def idle(env: ManipulationEnv) -> None:
    """Act without effect: a place while empty."""
    env.step(np.ones(env.action_space.shape, np.float32))


def test_places_fit_on_the_pallet_with_room_for_a_finger() -> None:
    for layer in range(3):
        boxes = [Footprint.rectangle((WIDTH, LENGTH), frame) for frame in places(layer, WIDTH, LENGTH)]
        half = [[-side / 2.0, side / 2.0] for side in PALLET[:2]]
        assert len(boxes) == 6 and all(box.is_inside(half) for box in boxes)
        gaps = [one.gap(other) for number, one in enumerate(boxes) for other in boxes[:number]]
        assert min(gaps) > 0.019


@pytest.mark.parametrize("count", [1, 5, 6, 7, 12, 17, 18])
@pytest.mark.parametrize("turn", [0.0, math.pi, 0.35, -0.35])
def test_boxes_in_their_places_are_right(env: ManipulationEnv, count: int, turn: float) -> None:
    stack(env, count, turn)
    assert right(env) == count
    assert env.task.evaluate(env.scene)["success"] == (count == 18)


@pytest.mark.parametrize("turn", [0.45, -0.45, math.pi / 2])
def test_turned_boxes_are_wrong(env: ManipulationEnv, turn: float) -> None:
    stack(env, 3, turn)
    assert right(env) == 0


def test_boxes_at_wrong_heights_or_beside_the_pallet_are_wrong(env: ManipulationEnv) -> None:
    stack(env, 3, sink=0.4 * HEIGHT)
    assert right(env) == 0
    stack(env, 1)
    box = env.scene["box 0"]
    box.place(env.scene["pallet"].pose.compose(Pose.planar(0.13, 0.0, box.pose.z, layer_yaw(0))))
    assert right(env) == 0


def test_a_layer_counts_when_those_below_are_full(env: ManipulationEnv) -> None:
    stack(env, 8)
    env.scene["box 2"].park()
    assert right(env) == 5


def test_the_next_box_appears_when_all_are_right(env: ManipulationEnv) -> None:
    idle(env)
    assert present(env) == 1
    for count in (1, 6, 17):
        stack(env, count)
        idle(env)
        assert present(env) == count + 1
        idle(env)
        assert present(env) == count + 1
    stack(env, 18)
    idle(env)
    assert present(env) == 18


def test_none_appears_while_the_gripper_holds(make: Make) -> None:
    env = make(FLAT, max_steps=100)
    env.reset(seed=1)
    env.step(env.expert_action())
    assert env.scene.held is not None and present(env) == 1
    env.step(env.expert_action())
    assert env.scene.held is None and present(env) == 2


@pytest.mark.parametrize("env_id", [FLAT, BUMP])
@pytest.mark.parametrize("layer", [0, 1, 2])
def test_boxes_appear_inside_and_apart(make: Make, env_id: str, layer: int) -> None:
    for parameters in ({}, {"random_orientation": False}):
        env = make(env_id, max_steps=100, **parameters)
        for seed in range(30):
            env.reset(seed=seed)
            stack(env, 6 * layer)
            _, *_, info = env.step(np.ones(env.action_space.shape, np.float32))
            box = env.scene[f"box {6 * layer}"]
            base = footprint(box)
            assert info["is_valid"] and info["is_at_rest"]
            assert base.is_inside(env.config.workspace)
            assert base.gap(footprint(env.scene["pallet"])) > 0.0
            if parameters and env_id == FLAT:
                turn = box.pose.yaw - env.scene["pallet"].pose.yaw - layer_yaw(layer)
                assert math.sin(turn) == pytest.approx(0.0, abs=1e-3)


def test_the_episode_ends_where_the_next_box_finds_no_room(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    env = make(FLAT)
    env.reset(seed=0)
    stack(env, 1)

    def full(*_: Any) -> None:
        raise PlacementError("workspace: found no room")

    monkeypatch.setattr("bulletarm_gym.tasks.palletizing.sample_until", full)
    _, reward, terminated, truncated, info = env.step(np.ones(env.action_space.shape, np.float32))
    assert (reward, terminated, truncated, info["is_valid"]) == (0.0, True, False, False)
    monkeypatch.undo()
    state = env.get_state()
    assert env.reset(seed=0)[1]["is_valid"]
    env.set_state(state)
    assert not env.task.is_valid(env.scene)


@pytest.mark.parametrize("env_id", [FLAT, BUMP])
def test_boxes_lie_on_the_ground_at_the_start(make: Make, env_id: str) -> None:
    env = make(env_id)
    for seed in range(10):
        env.reset(seed=seed)
        box = env.scene["box 0"]
        before = box.pose
        env.scene.begin()
        env.scene.world.step(60)
        env.scene.world.end()
        assert math.dist(before.position, box.pose.position) < 1e-3


@pytest.mark.parametrize(
    ("env_id", "parameters"), [(FLAT, {}), (FLAT, FIXED), (BUMP, {})], ids=["random", "fixed", "bump"]
)
@pytest.mark.parametrize("count", [6, 18])
def test_expert_solves_in_the_papers_steps(
    make: Make, env_id: str, parameters: dict[str, Any], count: int
) -> None:
    env = make(env_id, num_objects=count, **parameters)
    env.reset(seed=0)
    for step in range(1, 2 * count + 1):
        *_, terminated, truncated, info = env.step(env.expert_action())
        assert info["is_success"] == (step == 2 * count) == terminated and not truncated


def test_expert_mends_what_lies_wrong(make: Make) -> None:
    env = make(FLAT, max_steps=100, num_objects=6)
    env.reset(seed=2)
    for _ in range(5):
        env.step(env.expert_action())
    hand = env.scene.robot.pose
    askew = env.scene["pallet"].pose.compose(Pose.planar(0.0, 0.0, 0.0, 0.8))
    waypoint = Waypoint(Pose.planar(askew.x, askew.y, hand.z, askew.yaw), CLOSED, OPEN)
    env.step(env.encode_action(env.tracker.towards(waypoint)))
    assert right(env) == 2 and present(env) == 3
    for _ in range(10):
        *_, terminated, _, info = env.step(env.expert_action())
        assert terminated == info["is_success"]
        if terminated:
            return
    raise AssertionError(right(env))
