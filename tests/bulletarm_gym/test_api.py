"""The contract of every environment id, and the interface of environments, from make() to close()."""

import dataclasses
import gc
import json
import math
import pickle
import sys
import warnings
from unittest.mock import patch

import gymnasium
import numpy as np
import psutil
import pybullet
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import TimeAwareObservation
from rollouts import GRASPING, PICKING, REACHING, advance, digest, finish, idle, make_env, transcript

from bulletarm_gym.control import DeltaMove
from bulletarm_gym.demonstrations import json_state
from bulletarm_gym.geometry import PlacementError, Pose
from bulletarm_gym.wrappers import UNLIMITED

MAX_SERVERS = 1024
"""Number of PyBullet's physics servers in a process."""
SB3_IMAGE_WARNINGS = ("has to be `np.uint8`", "are not in [0, 255]", "minimal resolution for an image")
"""Warnings of Stable-Baselines3 about images that are depths in metres: their type, bounds and size."""


@pytest.mark.filterwarnings("error")
def test_contract(env_id):
    """Gymnasium's checks, an episode that the expert solves, equal seeds, exact states and an image."""
    assert json.dumps(gymnasium.spec(env_id).kwargs)
    few = {"num_objects": 5} if "ObjectGrasping" in env_id else {}  # 15 take long to fall
    env = gymnasium.make(env_id, render_mode="rgb_array", render_size=64, **few)
    assert gymnasium.spec(env_id).max_episode_steps == env.spec.max_episode_steps
    core = env.unwrapped
    check_env(core, skip_render_check=True)
    check_with_stable_baselines(core)
    assert any(solves(env, seed) for seed in range(3)), "the expert may fail once"
    image = env.render()
    assert image.shape == (64, 64, 3) and image.dtype == np.uint8 and image.std() > 10
    state = advance(core, 3, 0 if core.task.single_step else 1)
    assert json_state.loads(json_state.dumps(state)) == state == pickle.loads(pickle.dumps(state))
    expected = digest(core.observe(), core.expert_action()), transcript(core, 2)
    core.set_state(state)
    assert digest(core.observe(), core.expert_action()) == expected[0] and core.get_state() == state
    assert (digest(core.observe(), core.expert_action()), transcript(core, 2)) == expected
    first = digest(*core.reset(seed=5)), digest(*core.step(core.expert_action()))
    assert (digest(*core.reset(seed=5)), digest(*core.step(core.expert_action()))) == first


def check_with_stable_baselines(env):
    """Run Stable-Baselines3's checks, if it is installed. They warn of depths in metres only."""
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        checker.check_env(env)
    texts = [str(warning.message) for warning in caught]
    assert all(any(known in text for known in SB3_IMAGE_WARNINGS) for text in texts)


def solves(env, seed):
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


@pytest.mark.filterwarnings("error")
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="displays are found on Linux only")
@pytest.mark.parametrize("display", ["", ":0"])
def test_window_needs_a_display(display, monkeypatch):
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


def test_free_object_outside_the_workspace_ends_the_episode(typical_env):
    env = typical_env
    (_, high), (x, y), side = env.config.workspace[0], env.config.centre, env.config.workspace_size
    env.reset(seed=0)
    state, item = env.get_state(), next(item for item in env.scene if item.spec.mass > 0.0)
    centre_of_mass = item.spec.mass_properties[0].position

    def step_from(*position):
        poses = list(state.world.poses)
        poses[item.body.index] = Pose(tuple(np.subtract(position, centre_of_mass).tolist()))
        world = dataclasses.replace(state.world, poses=tuple(poses))
        env.set_state(dataclasses.replace(state, world=world))
        assert env.expert_action() in env.action_space
        return env.step(idle(env))

    for dx, dy, z in [(-0.7, 0.0, 0.025), (0.0, 0.8, 0.025), (0.0, -0.504, 0.025), (0.0, 0.0, -0.2)]:
        _, reward, terminated, truncated, info = step_from(x + dx * side, y + dy * side, z)
        assert (reward, terminated, truncated) == (0.0, True, False)
        assert info["is_valid"] is False and info["is_success"] is False
    assert step_from(high - 1e-4, 0.1, 0.025)[4]["is_valid"], "the border belongs to the workspace"


@pytest.mark.parametrize(("x", "valid"), [(0.595, True), (0.605, False)])
def test_success_counts_only_in_a_valid_scene(make, x, valid):
    env = make(REACHING, seed=0)
    env.scene["cube"].place(Pose((0.35, 0.1, 0.025)))
    for _ in range(8):
        step = np.subtract((0.6, 0.0, 0.04), env.scene.robot.pose.position)
        env.step(env.encode_action(DeltaMove(1.0, tuple(step.tolist()))))
    env.scene["cube"].place(Pose((x, 0.0, 0.025)))
    _, reward, terminated, _, info = env.step([1.0, 0.0, 0.0, 0.0, 0.0])
    assert env.task.evaluate(env.scene)["success"] and terminated
    assert (reward, info["is_success"], info["is_valid"]) == (float(valid), valid, valid)


def test_success_at_the_time_limit_terminates():
    limited = gymnasium.make(REACHING, max_episode_steps=3)
    for env in (limited, gymnasium.make(EnvSpec.from_json(limited.spec.to_json()))):
        env.reset(seed=0)
        assert finish(env) == (True, 3)


@pytest.mark.parametrize(("check", "valid"), [("point", True), ("bounding_box", False)])
def test_bounding_box_is_stricter_than_point(make, check, valid):
    env = make(PICKING, workspace_check=check, seed=0)
    env.scene["cube"].place(Pose((0.59, 0.1, 0.025)))
    assert env.step(idle(env))[4]["is_valid"] is valid


def test_point_is_the_centre_of_mass(make):
    env = make(GRASPING, seed=0)
    hammer = env.scene["hammer_2"]
    hammer.place(Pose((0.45, 0.14, 0.02)))
    assert hammer.centre_of_mass[1] > 0.15 > hammer.pose.position[1]
    assert not env.task.is_valid(env.scene)


def test_form_of_an_action_does_not_matter(typical_env):
    """Numbers outside the box are clipped, and the action is not changed."""
    action = [0.5, -3.0, 0.125, -1.0, 0.75, 0.25, -0.5][: typical_env.action_space.shape[0]]
    array = np.array(action, np.float32)
    results = set()
    for form in (action, tuple(action), array, np.array(action, np.float64), array.clip(-1.0, 1.0)):
        typical_env.reset(seed=1)
        results.add(digest(*typical_env.step(form)))
    assert len(results) == 1 and array.tolist() == action


def test_other_actions_are_rejected_and_render_warns_without_a_mode(picking):
    picking.reset(seed=0)
    state = picking.get_state()
    wrong = ([math.nan] * 5, [0, 0, -math.inf, 0, 0], np.zeros(3), np.zeros((1, 5)), 0.0, "open", None)
    for action in (*wrong, [[1, 2], 0], ["0"] * 5):
        with pytest.raises(ValueError, match="action must be"):
            picking.step(action)
        assert picking.get_state() == state
    with pytest.warns(UserWarning, match=r"render_mode must be set for render\(\), got None"):
        assert picking.render() is None


def test_spec_keeps_the_parameters_as_json():
    env_id = "BulletArm/CloseLoopObjectGrasping-v0"
    registered = gymnasium.spec(env_id).to_json()
    workspace = np.array([[0.32, 0.6], [-0.14, 0.14], [0.01, 0.25]])
    env = gymnasium.make(env_id, workspace=workspace, max_steps=np.int64(7), fast_mode=np.True_)
    assert env.unwrapped.spec.kwargs["workspace"] == workspace.tolist()
    again = gymnasium.make(EnvSpec.from_json(env.spec.to_json()))
    assert again.unwrapped.config == env.unwrapped.config and again.spec == env.spec
    assert digest(*again.reset(seed=2)) == digest(*env.reset(seed=2))
    assert gymnasium.spec(env_id).to_json() == registered


def test_spec_has_the_number_of_steps_of_an_episode():
    """Made with some parameters, and again from its spec with others."""
    for first, then, steps in (
        ({}, {}, 50),
        ({"max_steps": 60, "max_episode_steps": 60}, {}, 60),
        ({}, {"max_steps": 6}, 6),
        ({"max_steps": 60}, {}, 60),
        ({"max_steps": 60}, {"max_episode_steps": 7}, 7),
        ({"max_steps": 60}, {"max_episode_steps": 50}, 50),
        ({"max_episode_steps": -1}, {}, UNLIMITED),
    ):
        made = gymnasium.make(PICKING, obs_size=16, **first)
        again = gymnasium.make(EnvSpec.from_json(made.spec.to_json()), **then)
        for env in (again, pickle.loads(pickle.dumps(again))):
            limits = {env.spec.max_episode_steps, env.unwrapped.spec.max_episode_steps}
            assert limits == {TimeAwareObservation(env).max_timesteps} == {steps}
            env.reset(seed=0)
            ends = [env.step(idle(env.unwrapped))[2:4] for _ in range(min(steps, 60))]
            assert ends == [(False, False)] * (len(ends) - 1) + [(False, steps <= 60)]
    for limit in (3, 50, -1):
        with pytest.raises(ValueError, match=r"^max_steps must be .* max_episode_steps .*, got 5"):
            gymnasium.make(PICKING, obs_size=16, max_steps=5, max_episode_steps=limit)


def test_no_step_after_the_end(picking):
    picking.reset(seed=0)
    finish(picking)
    at_the_end = picking.get_state()
    assert at_the_end.ended and picking.expert_action() in picking.action_space
    for _ in range(2):
        with pytest.raises(gymnasium.error.ResetNeeded, match=r"^the episode has ended\. Call reset\(\)"):
            picking.step(idle(picking))
        assert picking.get_state() == at_the_end
        picking.reset()
        picking.set_state(at_the_end)


@pytest.mark.parametrize("error", [PlacementError, KeyboardInterrupt])
def test_no_step_after_a_reset_without_a_scene(make, error):
    env = make(PICKING, seed=0)
    with patch.object(type(env.task), "arrange", side_effect=error("no room")):
        with pytest.raises(error, match="no room"):
            env.reset()
    for call in (env.expert_action, env.get_state, lambda: env.step(idle(env))):
        with pytest.raises(gymnasium.error.ResetNeeded):
            call()


def test_environment_needs_a_reset_and_rejects_calls_after_close():
    """PyBullet gives the number of a closed server to the next one."""
    env = gymnasium.make(PICKING, obs_size=16)
    inner = env.unwrapped
    action = np.zeros(5, np.float32)
    calls = (lambda: inner.step(action), inner.expert_action, inner.get_state)
    for call in calls:
        with pytest.raises(gymnasium.error.ResetNeeded):
            call()
    env.reset(seed=0)
    state = inner.get_state()
    env.close()
    env.close()
    fresh = make_env(PICKING, obs_size=16)
    for call in (
        *calls,
        *(env.reset, inner.reset, lambda: inner.reset(seed=0, options="foo")),
        *(lambda: env.step(action), lambda: inner.step("open"), env.render, inner.render),
        *(inner.observe, inner.look, inner.measure, inner.viewer.close_up),
        *(lambda: inner.set_state(state), lambda: inner.decode_action(action), lambda: pickle.dumps(inner)),
    ):
        with pytest.raises(gymnasium.error.ClosedEnvironmentError):
            call()
    fresh.close()


def test_resets_and_states_do_not_grow(typical_env):
    used = []
    for number in range(20):
        typical_env.reset()
        typical_env.step(typical_env.expert_action())
        typical_env.set_state(typical_env.get_state())
        if number in (4, 19):
            gc.collect()
            used.append(psutil.Process().memory_info().rss)
    assert used[1] - used[0] < 2.5 * 2**20


def test_server_is_released_by_close_by_the_collector_and_after_an_error():
    def servers():
        gc.collect()
        return sum(bool(pybullet.isConnected(number)) for number in range(MAX_SERVERS))

    before = servers()
    env = make_env(PICKING, obs_size=32)
    assert servers() == before + 1
    env.close()
    assert servers() == before
    make_env(PICKING, obs_size=32)
    assert servers() == before
    for parameters in ({"robot": "nobody"}, {"reward": "nowhere:nothing"}):
        with pytest.raises(ValueError, match=next(iter(parameters))):
            make_env(PICKING, **parameters)
    assert servers() == before
