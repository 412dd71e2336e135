"""Demonstrations that users pass: accepted forms, and refusals before anything is stored."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import FlattenObservation, FrameStackObservation, RescaleAction
from stable_baselines3.common.env_util import make_vec_env

from bulletarm_gym.demonstrations import Demonstrations, collect
from sb3_extensions.demonstrations.dagger import DaggerCallback
from sb3_extensions.demonstrations.episodes import Episode
from sb3_extensions.demonstrations.source import DemonstrationSource, load_episodes
from sb3_extensions.sacfd import SACfD

ENV_ID = "BulletArm/CloseLoopBlockReaching-v0"
OTHER_ID = "BulletArm/CloseLoopBlockPicking-v0"
PARTS = ("observations", "actions", "rewards", "terminations")


@pytest.fixture(scope="module")
def reaching() -> Demonstrations:
    return collect(ENV_ID, 1, seed=0, env_kwargs={"observation": "state"})


class MinariLike(list[Any]):
    """Episodes with the attributes of a Minari data set."""

    action_ranges = None

    def __init__(self, episodes, **kwargs):
        super().__init__(episodes)
        self.env_spec = SimpleNamespace(id=kwargs.pop("id", ENV_ID), kwargs=kwargs)
        self.action_space = spaces.Box(-1.0, 1.0, (5,), np.float32)


def learn(data, env=None, policy: str = "StatePolicy", **env_kwargs):
    """Return the replay buffer after a step; refused demonstrations leave it empty."""
    env = env or make_vec_env(ENV_ID, env_kwargs={"observation": "state", **env_kwargs})
    model = SACfD(policy, env, expert_data=data, buffer_size=100, seed=0)
    try:
        return model.learn(1).replay_buffer
    except ValueError:
        assert model.replay_buffer.size() == 0
        raise


def plain_episode(episode, **changes) -> Episode:
    parts = {name: getattr(episode, name) for name in (*PARTS, "truncations", "seed")}
    return dataclasses.replace(Episode(**parts, expert_actions=episode.actions), **changes)


def rescaled(low: float, high: float):
    env = gym.make(ENV_ID, observation="state")
    return make_vec_env(lambda: RescaleAction(env, np.float32(low), np.float32(high)))


def test_forms_of_expert_data(reaching, tmp_path):
    """Demonstrations, files, episodes with Minari's attributes, iterators, and further observations."""
    path = tmp_path / "reaching.h5"
    reaching.save(path)
    more = {**reaching[0].observations, "more": np.zeros((len(reaching[0]) + 1, 2))}
    few = SimpleNamespace(**{name: getattr(reaching[0], name) for name in PARTS})
    minari = MinariLike(reaching, action_sequence="pxyzr")
    actions = []
    for data in (
        reaching,
        path,
        str(path),
        minari,
        iter([few]),
        [plain_episode(reaching[0], observations=more)],
    ):
        buffer = learn(data)
        assert buffer.expert_size == len(reaching[0])
        actions.append(buffer.steps("action")[: buffer.expert_size])
    assert all(np.array_equal(actions[0], other) for other in actions[1:])


def test_expert_data_without_episodes_is_refused(reaching, tmp_path):
    used = iter([plain_episode(reaching[0])])
    learn(used)
    for data in ([], used):
        with pytest.raises(ValueError, match=r"expert_data .*, got none"):
            learn(data)
    with pytest.raises(ValueError, match=r"expert_data .* got 3"):
        load_episodes(3)
    (tmp_path / "other.h5").write_bytes(b"other")
    with pytest.raises(ValueError, match=r"other\.h5"):
        learn(tmp_path / "other.h5")
    with pytest.raises(FileNotFoundError, match=r"none\.h5"):
        learn(tmp_path / "none.h5")
    sources = DemonstrationSource(0), DemonstrationSource(1), DemonstrationSource(0, data=[])
    assert [source.is_empty for source in sources] == [True, False, False]


@pytest.mark.parametrize("sequence", ["xyzrp", "pxyz"])
def test_demonstrations_of_other_actions_are_refused(sequence, reaching):
    with pytest.raises(ValueError, match=f"^expert_data must have action_sequence='{sequence}'.*'pxyzr'$"):
        learn(reaching, action_sequence=sequence)
    with pytest.raises(ValueError, match=f"got '{sequence}'"):
        learn(MinariLike(reaching, action_sequence=sequence))
    data = MinariLike(reaching)
    data.action_ranges = {**(reaching.action_ranges or {}), "x": (0.0, 1.0)}
    with pytest.raises(ValueError, match=r"^expert_data must have action_ranges=.* got .*\(0\.0, 1\.0\)"):
        learn(data)
    with pytest.raises(ValueError, match=r"action_space=Box\(0\.0, 1\.0.*got Box\(-1\.0, 1\.0"):
        learn(reaching, rescaled(0.0, 1.0))


def test_demonstrations_of_another_task_are_refused():
    picking = collect(OTHER_ID, 1, seed=0, env_kwargs={"obs_size": 48})
    kwargs = {"policy": "MultiInputPolicy", "observation": "image", "obs_size": 48}
    for data in (picking, MinariLike(picking, id=OTHER_ID)):
        with pytest.raises(ValueError, match=f"^expert_data .*{ENV_ID}, got episodes of {OTHER_ID}"):
            learn(data, **kwargs)
    learn(list(picking), **kwargs)  # episodes alone have no environment


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("actions", lambda x: x[:, :4], r"actions of shape \(\d+, 5\), got \(\d+, 4\)"),
        ("actions", lambda x: x[:0], "at least one step .* got 0 in episode 1"),
        ("observations", lambda x: x["state"], r"keys \['holding', 'state'\], got ndarray"),
        ("observations", lambda x: {"other": x["state"]}, r"keys \['holding', 'state'\], got \['other'\]"),
        (
            "observations",
            lambda x: {**x, "state": x["state"][:, :3]},
            r"observations\['state'\] of shape \(\d+, 14\), got \(\d+, 3\) in episode 1$",
        ),
        ("observations", lambda x: {**x, "state": x["state"][1:]}, r"observations\['state'\] of shape"),
        ("terminations", lambda x: x[1:], r"terminations of shape \(\d+,\), got"),
        ("rewards", lambda x: x[:-1], r"rewards of shape \(\d+,\), got \(\d+,\) in episode 1"),
        ("actions", lambda x: x * 1000, r"actions from -1 to 1, got -?\d+ to \d+ in episode 1"),
        ("actions", lambda x: np.full_like(x, np.nan), "actions from -1 to 1, got nan to nan in episode 1"),
        ("rewards", lambda x: x + np.inf, "rewards from .* got inf to inf in episode 1"),
        ("expert_actions", lambda x: x - 7, "expert_actions from -1 to 1, got -8"),
        (
            "observations",
            lambda x: {**x, "holding": x["holding"] * 255 - 3},
            r"observations\['holding'\] from 0 to 1, got -3 to .* in episode 1",
        ),
    ],
)
def test_shapes_and_values_outside_their_bounds_are_refused(name, change, message, reaching):
    episode = plain_episode(reaching[0])
    wrong = dataclasses.replace(episode, **{name: change(getattr(episode, name))})
    with pytest.raises(ValueError, match=f"^expert_data must have .*{message}"):
        learn([episode, wrong])


def test_bulletarm_gym_is_imported_for_a_path_only():
    code = "import sys, sb3_extensions.sacfd; assert 'bulletarm_gym' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize(
    ("wrapper", "got"),
    [
        (FlattenObservation, r"\{'observation': \(2305,\)\}"),
        (
            lambda env: FrameStackObservation(env, 2),
            r"\{'heightmap': \(2, 1, 48, 48\), 'holding': \(2, 1\)\}",
        ),
    ],
)
def test_learners_name_the_observations_without_images(wrapper, got):
    env = wrapper(gym.make(ENV_ID, obs_size=48))
    with pytest.raises(ValueError, match=f"^observation_space .* got {got}"):
        SACfD("EquivariantPolicy", env, buffer_size=100)


@pytest.mark.parametrize("callback", [None, DaggerCallback()])
def test_learner_stores_the_experts_actions_in_the_wrapped_action_space(callback):
    stored = []
    for env in (make_vec_env(ENV_ID, env_kwargs={"observation": "state"}), rescaled(-2.0, 5.0)):
        model = SACfD("StatePolicy", env, expert_episodes=2, expert_noise=0.05, buffer_size=100, seed=0)
        buffer = model.learn(2, callback=callback).replay_buffer
        executed, intended = (buffer.steps(name) for name in ("action", "expert_action"))
        assert np.abs(executed - intended)[: buffer.expert_size].max() > 0.02
        stored.append(intended[: buffer.expert_size + 1])
    np.testing.assert_allclose(stored[0], stored[1], atol=1e-5)


def test_learner_names_the_wrapper_without_an_inverse():
    def make():
        env = gym.make(ENV_ID, observation="state")
        return gym.wrappers.TransformAction(env, np.negative, env.action_space)

    model = SACfD("StatePolicy", make_vec_env(make), expert_episodes=2, buffer_size=100)
    with pytest.raises(ValueError, match=r"expert_action .*, got TransformAction"):
        model.learn(1)
