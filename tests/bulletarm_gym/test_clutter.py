"""Object Grasping: the clutter that stays, what is taken from it, the tray."""

import pickle
from collections.abc import Callable
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from bulletarm_gym.config import LIFT_HEIGHT
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.experts.singulation import _end_to_push
from bulletarm_gym.geometry import Pose
from bulletarm_gym.objects.graspables import graspables
from bulletarm_gym.simulation.shapes import wavefront
from bulletarm_gym.tasks.clutter import ObjectGrasping

ENV_ID = "BulletArm/CloseLoopObjectGrasping-v0"
Make = Callable[..., ManipulationEnv]


@pytest.fixture
def env(make: Make) -> ManipulationEnv:
    return make(ENV_ID)


def _names(env: ManipulationEnv) -> list[str]:
    return [item.slot.name for item in env.scene]


def _solve(env: ManipulationEnv) -> bool:
    for _ in range(env.config.max_steps):
        *_, terminated, truncated, info = env.step(env.expert_action())
        if terminated or truncated:
            return bool(info["is_success"])
    raise AssertionError("no episode lasts longer than max_steps")


def test_a_seed_gives_five_objects_at_rest_in_the_tray(env: ManipulationEnv) -> None:
    for seed in range(3):
        _, info = env.reset(seed=seed)
        assert len(_names(env)) == 5
        assert info["is_valid"] and not info["is_held"]


def test_the_grasped_object_is_gone_and_the_others_stay(env: ManipulationEnv) -> None:
    env.reset(seed=1)
    before = set(_names(env))
    assert _solve(env)
    held = env.scene.held
    assert held is not None and env.scene.robot.pose.z > LIFT_HEIGHT  # still there to be seen
    env.reset()
    assert set(_names(env)) == before - {held.slot.name}
    assert env.scene.robot.held is None and env.scene.robot.opening_ratio == 1.0


def test_an_episode_without_a_grasp_leaves_everything(env: ManipulationEnv) -> None:
    env.reset(seed=2)
    before = {item.slot.name: item.pose for item in env.scene}
    env.reset()
    assert {item.slot.name: item.pose for item in env.scene} == before


def test_all_grasped_makes_a_new_scene(make: Make) -> None:
    env = make(ENV_ID, num_objects=1)
    env.reset(seed=0)
    names = set(_names(env))
    for _ in range(4):
        assert _solve(env)
        env.reset()
        assert len(_names(env)) == 1
        names |= set(_names(env))
    assert len(names) > 2


def test_an_invalid_scene_makes_a_new_one(env: ManipulationEnv) -> None:
    env.reset(seed=3)
    before = _names(env)
    item = next(iter(env.scene))
    item.place(item.pose._replace(position=(0.45, 0.3, 0.02)))
    env.reset()
    assert _names(env) != before and len(_names(env)) == 5


def test_the_environment_says_that_it_keeps_its_scene(env: ManipulationEnv, make: Make) -> None:
    assert env.keeps_scene
    assert not make("BulletArm/CloseLoopBlockPicking-v0").keeps_scene


def test_options_force_a_new_scene(env: ManipulationEnv) -> None:
    env.reset(seed=4)
    before = _names(env)
    env.reset(options={"new_scene": False})
    assert _names(env) == before
    env.reset(options={"new_scene": True})
    assert _names(env) != before
    for options in ({"old_scene": True}, {"new_scene": 1}):
        with pytest.raises(ValueError, match="options"):
            env.reset(options=options)


def test_what_is_left_is_part_of_the_state(make: Make) -> None:
    first, second = make(ENV_ID), make(ENV_ID, 1)
    first.reset(seed=5)
    assert _solve(first)
    first.reset()
    second.reset(seed=6)
    second.set_state(pickle.loads(pickle.dumps(first.get_state())))
    assert _names(second) == _names(first)
    for _ in range(8):
        action = first.expert_action()
        assert np.array_equal(action, second.expert_action())
        one, other = first.step(action), second.step(action)
        assert np.array_equal(one[0]["heightmap"], other[0]["heightmap"])
        assert one[1:] == other[1:]
        if one[2]:
            assert np.array_equal(first.reset()[0]["heightmap"], second.reset()[0]["heightmap"])


@pytest.mark.parametrize("sequence", ["pxyzr", "pxyz"])
def test_the_expert_clears_the_tray(make: Make, sequence: str) -> None:
    env = make(ENV_ID, action_sequence=sequence, random_orientation=False)
    env.reset(seed=0)
    outcomes = []
    for _ in range(10):
        outcomes.append(_solve(env))
        env.reset()
    assert np.mean(outcomes) >= 0.9


def test_the_expert_makes_good_what_is_inexact(env: ManipulationEnv) -> None:
    rng = np.random.default_rng(0)
    outcomes = []
    env.reset(seed=0)
    for _ in range(10):
        ended = False
        while not ended:
            action = np.clip(env.expert_action() + rng.normal(0.0, 0.1, 5), -1.0, 1.0)
            *_, terminated, truncated, info = env.step(action)
            ended = terminated or truncated
        outcomes.append(info["is_success"])
        env.reset()
    assert np.mean(outcomes) >= 0.9


def test_fingers_that_were_pushed_shut_open_again(env: ManipulationEnv) -> None:
    env.reset(seed=0)
    robot = env.scene.robot
    robot._place(robot._fingers, [0.004, 0.004])
    assert robot.opening_ratio < 0.2
    env.step(np.array([1.0, 0.0, 0.0, 0.0, 0.0]))
    assert robot.opening_ratio > 0.9


@pytest.mark.parametrize("yaw", [0.0, 0.4, 2.0, -1.1])
def test_round_things_are_pushed_towards_the_middle(env: ManipulationEnv, yaw: float) -> None:
    env.reset(seed=0)
    bowl = next(item for item in env.scene.objects if item.slot.name == "bowl_3")
    bowl.place(Pose.planar(0.40, -0.06, 0.03, 0.0))
    end, _ = _end_to_push(env.scene, bowl)
    bowl.place(Pose.planar(0.40 + 1e-6, -0.06, 0.03, yaw))
    turned_end, push = _end_to_push(env.scene, bowl)
    np.testing.assert_allclose(push, np.array((0.05, 0.06)) / np.hypot(0.05, 0.06), atol=0.02)
    np.testing.assert_allclose(turned_end, end, atol=0.005)


def test_the_tray_belongs_to_the_task() -> None:
    with pytest.raises(ValueError, match=r"close_loop_tray.*roll out"):
        gymnasium.make(ENV_ID, close_loop_tray=False)


def test_tray_under_another_task(make: Make) -> None:
    env = make("BulletArm/CloseLoopBlockPicking-v0", close_loop_tray=True)
    for seed in range(3):
        observation, _ = env.reset(seed=seed)
        assert env.scene["cube"].pose.z == pytest.approx(0.027, abs=1e-3)
        assert observation["heightmap"][0, 0, 0] < observation["heightmap"].max() - 0.05  # the wall
        assert _solve(env)


def test_a_users_objects(tmp_path: Path) -> None:
    for spec in graspables()[:3]:
        (tmp_path / f"{spec.name}.obj").write_text(wavefront(spec.pieces))
    env = gymnasium.make(ENV_ID, object_set=str(tmp_path), num_objects=2).unwrapped
    assert isinstance(env, ManipulationEnv)
    env.reset(seed=0)
    assert set(_names(env)) < {"box_0.obj", "box_1.obj", "box_2.obj"}
    assert _solve(env)
    env.close()
    with pytest.raises(ValueError, match="at most 3"):
        gymnasium.make(ENV_ID, object_set=str(tmp_path))
    with pytest.raises(ValueError, match="object_set"):
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
