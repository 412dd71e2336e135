"""The contract of every environment id, and the interface of environments."""

import dataclasses
import itertools
import json
import math
import pickle
import sys
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import TimeAwareObservation
from rollouts import TYPICAL, advance, digest, idle, make_env, transcript

from bulletarm_gym.control import DeltaMove
from bulletarm_gym.demonstrations import json_state
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.geometry import Pose
from bulletarm_gym.robots import KUKA, RobotModel
from bulletarm_gym.scene import Scene
from bulletarm_gym.wrappers import UNLIMITED

Make = Callable[..., ManipulationEnv]

PICKING = "BulletArm/CloseLoopBlockPicking-v0"
REACHING = "BulletArm/CloseLoopBlockReaching-v0"
SB3_IMAGE_WARNINGS = ("has to be `np.uint8`", "are not in [0, 255]", "minimal resolution for an image")
"""Warnings of Stable-Baselines3 about images that are depths in metres: their type, bounds and size."""


def place(env: ManipulationEnv, role: str, *position: float) -> None:
    """Set the pose of a body in the state."""
    state = env.get_state()
    poses = list(state.world.poses)
    poses[env.scene[role].body.index] = Pose(position)
    env.set_state(dataclasses.replace(state, world=dataclasses.replace(state.world, poses=tuple(poses))))


# Every id


@pytest.mark.filterwarnings("error")
def test_contract(env_id: str) -> None:
    """Gymnasium's checks, an episode that the expert solves, equal seeds, exact states and an image."""
    assert gymnasium.spec(env_id).max_episode_steps is None and json.dumps(gymnasium.spec(env_id).kwargs)
    few = {"num_objects": 5} if "ObjectGrasping" in env_id else {}  # 15 take long to fall
    env = gymnasium.make(env_id, render_mode="rgb_array", render_size=64, **few)
    core: Any = env.unwrapped
    check_env(core, skip_render_check=True)
    check_with_stable_baselines(core)
    assert any(solves(env, seed) for seed in range(3)), "the expert may fail once"
    image = env.render()
    assert image.shape == (64, 64, 3) and image.dtype == np.uint8 and image.std() > 10
    state = advance(core, 3, 0 if core.task.single_step else 1)
    assert json_state.loads(json_state.dumps(state)) == state == pickle.loads(pickle.dumps(state))
    expected = digest(core.observe(), core.expert_action()), transcript(core, 2)
    core.set_state(state)
    assert (digest(core.observe(), core.expert_action()), transcript(core, 2)) == expected
    first = digest(*core.reset(seed=5)), digest(*core.step(core.expert_action()))
    assert (digest(*core.reset(seed=5)), digest(*core.step(core.expert_action()))) == first
    env.close()


def check_with_stable_baselines(env: ManipulationEnv) -> None:
    """Run Stable-Baselines3's checks, if it is installed. They warn of depths in metres only."""
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        checker.check_env(env)
    texts = [str(warning.message) for warning in caught]
    assert all(any(known in text for known in SB3_IMAGE_WARNINGS) for text in texts)


def solves(env: Any, seed: int) -> bool:
    """Check the values of an episode of the expert; return whether it succeeds."""
    observation, info = env.reset(seed=seed)
    keys = info.keys()
    assert keys >= {"is_success", "is_valid", "ignored"} and "success" not in keys
    assert observation["holding"].tolist() == [0.0]
    over = False
    while not over:
        previous = observation
        action = env.unwrapped.expert_action()
        assert action in env.action_space
        observation, reward, terminated, truncated, info = env.step(action)
        assert observation in env.observation_space
        for key, array in observation.items():
            assert array.flags.c_contiguous and array.flags.writeable and np.isfinite(array).all()
            assert not np.may_share_memory(array, previous[key])
        assert info.keys() == keys and {type(value) for value in info.values()} == {bool}
        assert type(reward) is float and reward == float(info["is_success"])
        assert info["is_success"] == (terminated and info["is_valid"])
        over = terminated or truncated
    return bool(info["is_success"])


# Checkers


@pytest.mark.filterwarnings("error")
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="displays are found on Linux only")
@pytest.mark.parametrize("display", ["", ":0"])
def test_window_needs_a_display(display: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DISPLAY", display)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    env = make_env(PICKING, render_mode="rgb_array", obs_size=16)
    modes = ["rgb_array", "depth_array", "human"]
    assert type(env).metadata["render_modes"] == modes
    assert env.metadata["render_modes"] == modes[: 3 if display else 2]
    if not display:
        check_env(env)
        with pytest.raises(RuntimeError, match="DISPLAY"):
            make_env(PICKING, render_mode="human")
    env.close()


# Observations and information


def test_changed_observations_do_not_matter(typical_env: ManipulationEnv) -> None:
    expected = transcript(typical_env, 3, seed=3)
    observation, info = typical_env.reset(seed=3)
    for array in observation.values():
        array[:] = 7.0
    info.clear()
    assert transcript(typical_env, 3) == expected[1:]


@pytest.mark.parametrize(
    "predicates", [None, {"is_success": True}, {"success": True, "ignored": False}], ids=str
)
def test_predicates_of_a_task_are_checked(predicates: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    env = make_env(PICKING, obs_size=16)
    monkeypatch.setattr(env.task, "evaluate", lambda scene: predicates)
    with pytest.raises(ValueError, match=r"^evaluate\(\) of BlockPicking must return a dict with 'success'"):
        env.reset(seed=0)
    env.close()


# Reward and end


def paid(scene: Scene, outcome: Mapping[str, bool]) -> float:
    return 0.25 + 2.0 * outcome["is_success"]


@pytest.mark.parametrize("kind", ["path", "function", "lambda"])
def test_rewards_are_functions_of_scene_and_info(kind: str) -> None:
    path = f"{paid.__module__}:paid"
    reward = {"path": path, "function": paid, "lambda": lambda scene, info: paid(scene, info)}[kind]
    env = gymnasium.make(REACHING, obs_size=16, reward=reward)
    again = gymnasium.make(env.spec)
    for each in (env, again, *([] if kind == "lambda" else [pickle.loads(pickle.dumps(env))])):
        core: Any = each.unwrapped
        each.reset(seed=0)
        rewards = [0.0]
        while rewards[-1] <= 0.25:
            rewards.append(each.step(core.expert_action())[1])
        assert rewards[1] == 0.25 and rewards[-1] == 2.25
        assert kind == "lambda" or (core.config.reward == path and path in each.spec.to_json())
        each.close()


def test_rewards_must_be_finite_numbers() -> None:
    value: list[Any] = [None]
    env = make_env(PICKING, obs_size=16, reward=lambda scene, outcome: value[0])
    for value[0] in (None, math.nan, "much"):
        env.reset(seed=0)
        with pytest.raises(ValueError, match=rf"^reward must be .*, got {value[0]!r} from .*:.*lambda"):
            env.step(idle(env))
    env.close()
    for path in ("no:where", "math:pi"):
        with pytest.raises(ValueError, match=rf"reward must be .*, got '{path}'"):
            make_env(PICKING, reward=path)


def test_time_limit_truncates(make: Make, typical_id: str) -> None:
    env = make(typical_id, max_steps=2)
    env.reset(seed=0)
    if env.task.single_step:
        assert env.step(idle(env))[1:4] == (0.0, True, False)
        return
    assert [env.step(idle(env))[1:4] for _ in range(2)] == [(0.0, False, False), (0.0, False, True)]


@pytest.mark.parametrize("name", ["max_steps", "max_episode_steps"])
def test_success_at_the_time_limit_terminates(make: Make, name: str) -> None:
    free = make(REACHING)
    free.reset(seed=0)
    length = next(number for number in itertools.count(1) if free.step(free.expert_action())[2])
    limited = gymnasium.make(REACHING, **{name: length})
    for env in (limited, gymnasium.make(EnvSpec.from_json(limited.spec.to_json()))):
        env.reset(seed=0)
        core: Any = env.unwrapped
        results = [env.step(core.expert_action())[1:4] for _ in range(length)]
        assert results[-1] == (1.0, True, False)
        env.close()


def test_free_object_outside_the_workspace_ends_the_episode(typical_env: ManipulationEnv) -> None:
    env = typical_env
    (_, high), centre, side = env.config.workspace[0], env.config.centre, env.config.workspace_size
    outside = [(-0.7, 0.0, 0.025), (0.0, 0.8, 0.025), (0.0, -0.504, 0.025), (0.0, 0.0, -0.2)]
    env.reset(seed=0)
    state, role = env.get_state(), next(item.slot.name for item in env.scene if item.spec.mass > 0.0)
    for x, y, z in outside:
        env.set_state(state)
        place(env, role, centre[0] + x * side, centre[1] + y * side, z)
        assert env.expert_action() in env.action_space
        _, reward, terminated, truncated, info = env.step(idle(env))
        assert (reward, terminated, truncated) == (0.0, True, False)
        assert info["is_valid"] is False and info["is_success"] is False
    env.set_state(state)
    place(env, role, high - 1e-4, 0.1, 0.025)
    assert env.step(idle(env))[4]["is_valid"], "the border belongs to the workspace"


@pytest.mark.parametrize(("check", "valid"), [("point", True), ("bounding_box", False)])
def test_bounding_box_is_stricter_than_point(make: Make, check: str, valid: bool) -> None:
    env = make(PICKING, workspace_check=check)
    assert env.reset(seed=0)[1]["is_valid"]
    place(env, "cube", 0.59, 0.1, 0.025)
    assert env.step(idle(env))[4]["is_valid"] is valid


@pytest.mark.parametrize(("x", "valid"), [(0.595, True), (0.605, False)])
def test_success_counts_only_in_a_valid_scene(make: Make, x: float, valid: bool) -> None:
    env = make(REACHING)
    env.reset(seed=0)
    place(env, "cube", 0.35, 0.1, 0.025)
    for _ in range(8):
        step = np.subtract((0.6, 0.0, 0.04), env.scene.robot.pose.position)
        env.step(env.encode_action(DeltaMove(1.0, tuple(step.tolist()))))
    place(env, "cube", x, 0.0, 0.025)
    _, reward, terminated, _, info = env.step([1.0, 0.0, 0.0, 0.0, 0.0])
    assert env.task.evaluate(env.scene)["success"] and terminated
    assert (reward, info["is_success"], info["is_valid"]) == (float(valid), valid, valid)


# Robots


def narrow_kuka() -> RobotModel:
    return dataclasses.replace(
        KUKA, name="narrow_kuka", gripper=dataclasses.replace(KUKA.gripper, stroke=0.08)
    )


@pytest.mark.parametrize("kind", ["function", "lambda", "model"])
def test_robot_may_be_a_model_or_a_function(kind: str) -> None:
    kinds: dict[str, Any] = {"function": narrow_kuka, "lambda": lambda: narrow_kuka(), "model": narrow_kuka()}
    env, other = (make_env(PICKING, obs_size=16, robot=robot) for robot in (kinds[kind], narrow_kuka))
    assert env.scene.robot.model.name == "narrow_kuka"
    other.set_state(advance(env, 0, 4))
    if kind != "lambda":
        copy = pickle.loads(pickle.dumps(env))
        assert copy.scene.robot.model.gripper == env.scene.robot.model.gripper
        assert transcript(copy, 3) == transcript(env, 3)
    env.close()
    other.close()
    with pytest.raises(ValueError, match="robot must be a RobotModel"):
        make_env(PICKING, robot=dict)


# Actions


def test_actions_outside_the_box_are_clipped(typical_env: ManipulationEnv) -> None:
    size = typical_env.action_space.shape[0]
    action = np.array([3.0, -2.0, 1.5, -7.0, 1.01, 2.0, -1.5], np.float32)[:size]
    typical_env.reset(seed=0)
    far = digest(*typical_env.step(action))
    typical_env.reset(seed=0)
    assert digest(*typical_env.step(action.clip(-1.0, 1.0))) == far


@pytest.mark.parametrize(
    "action",
    [[math.nan] * 5, [0, 0, -math.inf, 0, 0], np.zeros(3), np.zeros((1, 5)), 0.0, "open", None, [[1, 2], 0]],
    ids=str,
)
def test_step_rejects_other_actions_and_does_nothing(picking: ManipulationEnv, action: Any) -> None:
    picking.reset(seed=0)
    state = picking.get_state()
    with pytest.raises(ValueError, match="action must be"):
        picking.step(action)
    assert picking.get_state() == state


@pytest.mark.parametrize("sequence", ["pxyzr", "pxyz", "rzyxp", "xyzp"])
def test_actions_are_decoded_in_the_order_of_the_sequence(make: Make, sequence: str) -> None:
    env, plain = make(PICKING, action_sequence=sequence), make(PICKING)
    numbers = {"p": -1.0, "x": 1.0, "y": -1.0, "z": 0.5, "r": 1.0}
    move = env.decode_action([numbers[name] for name in sequence])
    assert move.opening == 0.0 and move.translation == pytest.approx((0.05, -0.05, 0.025))
    assert move.rotation == pytest.approx(math.pi / 4 if "r" in sequence else 0.0)
    assert env.encode_action(move).tolist() == [numbers[name] for name in sequence]
    clipped = env.encode_action(DeltaMove(2.0, (1.0, -1.0, 0.0), 9.0))
    assert clipped.tolist() == [{**numbers, "p": 1.0, "z": 0.0}[name] for name in sequence]
    move = DeltaMove(0.5, (0.03, -0.02, -0.04), 0.3 if "r" in sequence else 0.0)
    for each in (env, plain):
        each.reset(seed=4)
    moved, expected = (each.step(each.encode_action(move))[0] for each in (env, plain))
    np.testing.assert_allclose(moved["heightmap"], expected["heightmap"], atol=1e-5)


# Images


def test_render_without_a_mode_warns(picking: ManipulationEnv) -> None:
    picking.reset(seed=0)
    with pytest.warns(UserWarning, match=r"render_mode must be set for render\(\), got None"):
        assert picking.render() is None


# Making


def test_many_environments_at_once() -> None:
    envs = [make_env(env_id, obs_size=32) for env_id in (*TYPICAL, *[PICKING] * 10)]
    first = [digest(*env.reset(seed=1)) for env in envs]
    assert len(set(first)) == len(TYPICAL)
    for env in envs:
        env.step(env.expert_action())
        env.close()


@pytest.mark.parametrize("env_id", [PICKING, "BulletArm/CloseLoopObjectGrasping-v0"])
def test_spec_keeps_the_parameters_as_json(env_id: str) -> None:
    registered = gymnasium.spec(env_id).to_json()
    workspace = np.array([[0.32, 0.6], [-0.14, 0.14], [0.01, 0.25]])
    parameters: dict[str, Any] = {
        "object_scale_range": (0.8, 0.8),
        "max_steps": np.int64(7),
        "fast_mode": np.True_,
    }
    env: Any = gymnasium.make(env_id, workspace=workspace, **parameters)
    assert env.unwrapped.spec.kwargs["workspace"] == workspace.tolist()
    again: Any = gymnasium.make(EnvSpec.from_json(env.spec.to_json()))
    assert again.unwrapped.config == env.unwrapped.config and again.spec == env.spec
    assert digest(*again.reset(seed=2)) == digest(*env.reset(seed=2))
    assert gymnasium.spec(env_id).to_json() == registered
    env.close()
    again.close()


@pytest.mark.parametrize(
    ("first", "then", "steps"),
    [
        ({}, {}, 50),
        ({"max_episode_steps": 5}, {}, 5),
        ({"max_steps": 7, "max_episode_steps": 60}, {}, 60),
        ({}, {"max_steps": 6}, 6),
        ({"max_steps": 60}, {"max_episode_steps": 7}, 7),
        ({"max_episode_steps": -1}, {}, UNLIMITED),
        ({}, {"max_episode_steps": -1}, UNLIMITED),
    ],
    ids=str,
)
def test_spec_has_the_number_of_steps_of_an_episode(
    first: dict[str, int], then: dict[str, int], steps: int
) -> None:
    """Made with some parameters, and again from its spec with others."""
    made = gymnasium.make(PICKING, obs_size=16, **first)
    again = gymnasium.make(EnvSpec.from_json(made.spec.to_json()), **then)
    for env in (again, pickle.loads(pickle.dumps(again))):
        limits = {env.spec.max_episode_steps, env.unwrapped.spec.max_episode_steps}
        assert limits == {TimeAwareObservation(env).max_timesteps} == {steps}
        env.reset(seed=0)
        ends = [env.step(idle(env.unwrapped))[2:4] for _ in range(min(steps, 60))]
        assert ends == [(False, False)] * (len(ends) - 1) + [(False, steps <= 60)]
        env.close()
    vector = gymnasium.make_vec(PICKING, num_envs=1, obs_size=16, **{**first, **then})
    assert [spec.max_episode_steps for spec in vector.get_attr("spec")] == [steps]
    vector.close()
    made.close()


def test_measure_adds_up_seconds() -> None:
    env = make_env(PICKING, obs_size=16)
    env.reset(seed=0)
    seconds = env.measure()
    assert set(seconds.values()) == {0.0}
    while not env.step(env.expert_action())[2]:
        pass
    assert seconds.keys() == {"physics", "rendering"} and min(seconds.values()) > 0.0
    env.close()
