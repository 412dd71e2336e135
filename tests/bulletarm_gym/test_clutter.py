"""Object Grasping: clutter that later episodes keep, its tray, users' objects, and the expert."""

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from bulletarm_gym.config import LIFT_HEIGHT
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.experts.pushing import end_to_push
from bulletarm_gym.geometry import Pose
from bulletarm_gym.objects.graspables import graspables
from bulletarm_gym.simulation.shapes import wavefront
from bulletarm_gym.tasks.clutter import ObjectGrasping

ENV_ID = "BulletArm/CloseLoopObjectGrasping-v0"
PICKING = "BulletArm/CloseLoopBlockPicking-v0"
Make = Callable[..., ManipulationEnv]


@pytest.fixture
def env(make: Make) -> ManipulationEnv:
    return make(ENV_ID)


def _poses(env: ManipulationEnv) -> dict[str, Pose]:
    return {item.slot.name: item.pose for item in env.scene}


def _solve(env: ManipulationEnv, noise: float = 0.0) -> bool:
    rng = np.random.default_rng(0)
    for _ in range(env.config.max_steps):
        action = np.clip(env.expert_action() + rng.normal(0.0, noise, env.action_space.shape), -1.0, 1.0)
        *_, terminated, truncated, info = env.step(action)
        if terminated or truncated:
            return bool(info["is_success"])
    raise AssertionError("no episode lasts longer than max_steps")


def test_grasped_object_is_removed_at_reset_and_the_others_stay(env: ManipulationEnv, make: Make) -> None:
    _, info = env.reset(seed=1)
    before = set(_poses(env))
    assert len(before) == 5 and info["is_valid"] and not info["is_held"]
    assert _solve(env)
    held = env.scene.held
    assert held is not None and env.scene.robot.pose.z > LIFT_HEIGHT  # still observed
    env.reset()
    assert set(_poses(env)) == before - {held.slot.name}
    assert env.scene.robot.held is None and env.scene.robot.opening_ratio == 1.0
    assert env.keeps_scene and not make(PICKING).keeps_scene


def test_scene_is_new_only_with_a_seed_an_option_or_an_invalid_scene(env: ManipulationEnv) -> None:
    env.reset(seed=2)
    before = _poses(env)
    for arguments in ({}, {"options": {"new_scene": False}}):
        env.reset(**arguments)
        assert _poses(env) == before
    env.reset(options={"new_scene": True})
    assert _poses(env).keys() != before.keys()
    before = _poses(env)
    next(iter(env.scene)).place(Pose((0.45, 0.3, 0.02)))
    env.reset()
    assert _poses(env).keys() != before.keys() and len(_poses(env)) == 5


def test_new_objects_appear_when_all_are_grasped(make: Make) -> None:
    env, names = make(ENV_ID, num_objects=1), set()
    env.reset(seed=0)
    for _ in range(4):
        assert len(_poses(env)) == 1
        names |= set(_poses(env))
        assert _solve(env)
        env.reset()
    assert len(names) > 2


def test_remaining_objects_are_part_of_the_state(make: Make) -> None:
    first, second = make(ENV_ID), make(ENV_ID, 1)
    first.reset(seed=5)
    assert _solve(first)
    first.reset()
    second.reset(seed=6)
    second.set_state(pickle.loads(pickle.dumps(first.get_state())))
    assert _poses(second) == _poses(first)
    for _ in range(8):
        action = first.expert_action()
        assert np.array_equal(action, second.expert_action())
        one, other = first.step(action), second.step(action)
        assert np.array_equal(one[0]["heightmap"], other[0]["heightmap"])
        assert one[1:] == other[1:]
        if one[2]:
            assert np.array_equal(first.reset()[0]["heightmap"], second.reset()[0]["heightmap"])


@pytest.mark.parametrize(
    ("parameters", "noise"),
    [
        ({"random_orientation": False}, 0.0),
        ({"random_orientation": False, "action_sequence": "pxyz"}, 0.0),
        ({}, 0.1),
    ],
    ids=["pxyzr", "pxyz", "noise"],
)
def test_expert_clears_the_tray(make: Make, parameters: dict[str, Any], noise: float) -> None:
    env, outcomes = make(ENV_ID, **parameters), []
    env.reset(seed=0)
    for _ in range(8):
        outcomes.append(_solve(env, noise))
        env.reset()
    assert sum(outcomes) >= 7


def test_round_objects_are_pushed_towards_the_centre(env: ManipulationEnv) -> None:
    env.reset(seed=0)
    bowl = next(item for item in env.scene.objects if item.slot.name == "bowl_3")
    bowl.place(Pose.planar(0.40, -0.06, 0.03, 0.0))
    end, _ = end_to_push(env.scene, bowl)
    for yaw in (0.4, 2.0, -1.1):
        bowl.place(Pose.planar(0.40, -0.06, 0.03, yaw))
        rotated_end, push = end_to_push(env.scene, bowl)
        np.testing.assert_allclose(push, np.array((0.05, 0.06)) / np.hypot(0.05, 0.06), atol=0.02)
        np.testing.assert_allclose(rotated_end, end, atol=0.005)


def test_tray_is_required_here_and_possible_in_other_tasks(make: Make) -> None:
    with pytest.raises(ValueError, match=r"^close_loop_tray must .*False"):
        gymnasium.make(ENV_ID, close_loop_tray=False)
    env = make(PICKING, close_loop_tray=True)
    observation, _ = env.reset(seed=0)
    assert env.scene["cube"].pose.z == pytest.approx(0.027, abs=1e-3)
    assert observation["heightmap"][0, 0, 0] < observation["heightmap"].max() - 0.05  # the wall
    assert _solve(env)


def test_objects_of_users(tmp_path: Path) -> None:
    for spec in graspables()[:3]:
        (tmp_path / f"{spec.name}.obj").write_text(wavefront(spec.pieces))
    env = gymnasium.make(ENV_ID, object_set=str(tmp_path), num_objects=2).unwrapped
    assert isinstance(env, ManipulationEnv)
    env.reset(seed=0)
    assert _poses(env).keys() < {"box_0.obj", "box_1.obj", "box_2.obj"}
    assert _solve(env)
    env.close()
    with pytest.raises(ValueError, match=r"^num_objects must .*3.*got 5"):
        gymnasium.make(ENV_ID, object_set=str(tmp_path))
    with pytest.raises(ValueError, match=r"^object_set must .*nowhere"):
        gymnasium.make(ENV_ID, object_set=str(tmp_path / "nowhere"))


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["kuka", "panda", "ur5", "ur5_robotiq"])
def test_every_object_alone_is_lifted(robot: str) -> None:
    env = gymnasium.make(ENV_ID, robot=robot, num_objects=1).unwrapped
    assert isinstance(env, ManipulationEnv) and isinstance(env.task, ObjectGrasping)
    failing = {}
    for index, item in enumerate(env.scene.objects):
        lifted = 0
        for seed in range(5):
            env.reset(seed=seed)
            rng = np.random.default_rng((index, seed))
            env.scene.clear(rng)
            env.task.drop(env.scene, [item], rng)
            lifted += _solve(env)
        if lifted < 4:
            failing[item.slot.name] = lifted
    env.close()
    assert not failing
