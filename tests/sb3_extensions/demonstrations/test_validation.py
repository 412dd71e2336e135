"""Demonstrations of another environment are refused before anything is stored."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path
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
from sb3_extensions.sacfd import SACfD
from sb3_extensions.tqcfd import TQCfD

ENV_ID = "BulletArm/CloseLoopBlockReaching-v0"
OTHER_ID = "BulletArm/CloseLoopBlockPicking-v0"


@pytest.fixture(scope="module")
def reaching() -> Demonstrations:
    return collect(ENV_ID, 1, seed=0, env_kwargs={"observation": "state"})


class MinariLike(list[Any]):
    """Episodes with the attributes of a Minari data set."""

    action_ranges: Any = None

    def __init__(self, episodes: Any, **kwargs: Any) -> None:
        super().__init__(episodes)
        self.env_spec = SimpleNamespace(id=kwargs.pop("id", ENV_ID), kwargs=kwargs)
        self.action_space = spaces.Box(-1.0, 1.0, (5,), np.float32)


def learn(data: Any, env: Any = None, policy: str = "StatePolicy", **env_kwargs: Any) -> SACfD:
    env = env or make_vec_env(ENV_ID, env_kwargs={"observation": "state", **env_kwargs})
    model = SACfD(policy, env, expert_data=data, buffer_size=100, seed=0)
    try:
        return model.learn(1)
    except ValueError:
        assert model.replay_buffer is not None and model.replay_buffer.size() == 0
        raise


def test_demonstrations_of_the_environment_are_stored(reaching: Demonstrations) -> None:
    model = learn(reaching)
    assert model.replay_buffer is not None and model.replay_buffer.expert_size == len(reaching[0])


@pytest.mark.parametrize("sequence", ["xyzrp", "pxyz"])
def test_demonstrations_of_another_action_sequence_are_refused(
    sequence: str, reaching: Demonstrations
) -> None:
    message = f"^expert_data must have action_sequence='{sequence}', as the environment, got 'pxyzr'$"
    with pytest.raises(ValueError, match=message):
        learn(reaching, action_sequence=sequence)


def test_demonstrations_of_other_action_ranges_are_refused(reaching: Demonstrations) -> None:
    data = MinariLike(reaching)
    assert reaching.action_ranges is not None
    data.action_ranges = {**reaching.action_ranges, "x": (0.0, 1.0)}
    with pytest.raises(ValueError, match=r"^expert_data must have action_ranges=.* got .*\(0\.0, 1\.0\)"):
        learn(data)


def test_demonstrations_of_another_action_space_are_refused(reaching: Demonstrations) -> None:
    def make() -> Any:
        return RescaleAction(gym.make(ENV_ID, observation="state"), np.float32(0.0), np.float32(1.0))

    with pytest.raises(ValueError, match=r"must have action_space=Box\(0\.0, 1\.0.*got Box\(-1\.0, 1\.0"):
        learn(reaching, make_vec_env(make))


def plain_episode(episode: Any, **changes: Any) -> Episode:
    names = ("observations", "actions", "rewards", "terminations", "truncations", "seed")
    parts = {name: getattr(episode, name) for name in names}
    return dataclasses.replace(Episode(**parts, expert_actions=episode.actions), **changes)


def test_episodes_of_other_shapes_are_refused_with_both_shapes(reaching: Demonstrations) -> None:
    episode = reaching[0]
    state = episode.observations["state"]
    wrong: list[tuple[dict[str, Any], str]] = [
        ({"actions": episode.actions[:, :4]}, r"actions of shape \(\d+, 5\), got \(\d+, 4\)"),
        ({"actions": episode.actions[:0]}, "at least one step in an episode, got 0 in episode 1"),
        ({"observations": state}, r"observations with the keys \['holding', 'state'\], got ndarray"),
        ({"observations": {"other": state}}, r".* keys \['holding', 'state'\], got \['other'\]"),
        (
            {"observations": {**episode.observations, "state": state[:, :3]}},
            r"observations\['state'\] of shape \(\d+, 14\), got \(\d+, 3\) in episode 1$",
        ),
        (
            {"observations": {**episode.observations, "state": state[1:]}},
            r"observations\['state'\] of shape",
        ),
        ({"terminations": episode.terminations[1:]}, r"terminations of shape \(\d+,\), got"),
    ]
    for changes, message in wrong:
        with pytest.raises(ValueError, match=f"^expert_data must have {message}"):
            learn([plain_episode(episode), plain_episode(episode, **changes)])


@pytest.fixture(scope="module")
def picking() -> Demonstrations:
    """Demonstrations of another task with the same spaces."""
    return collect(OTHER_ID, 1, seed=0, env_kwargs={"obs_size": 48})


def test_demonstrations_of_another_task_are_refused(picking: Demonstrations) -> None:
    env_kwargs = {"observation": "image", "obs_size": 48}
    message = f"^expert_data must be episodes of {ENV_ID}, got episodes of {OTHER_ID}"
    for data in (picking, MinariLike(picking, id=OTHER_ID)):
        with pytest.raises(ValueError, match=message):
            learn(data, policy="MultiInputPolicy", **env_kwargs)


def test_episodes_without_an_env_id_are_accepted(picking: Demonstrations) -> None:
    learn(list(picking), policy="MultiInputPolicy", observation="image", obs_size=48)


def test_expert_data_can_be_the_path_of_a_file(reaching: Demonstrations, tmp_path: Path) -> None:
    reaching.save(tmp_path / "reaching.h5")
    models = [learn(data) for data in (reaching, tmp_path / "reaching.h5", str(tmp_path / "reaching.h5"))]
    for model in models:
        assert model.replay_buffer is not None and models[0].replay_buffer is not None
        stored = model.replay_buffer.steps("action")
        np.testing.assert_array_equal(stored, models[0].replay_buffer.steps("action"))


def test_path_of_another_file_is_refused_by_the_constructor(tmp_path: Path) -> None:
    (tmp_path / "other.h5").write_bytes(b"other")
    with pytest.raises(ValueError, match=r"other\.h5"):
        learn(tmp_path / "other.h5")
    with pytest.raises(FileNotFoundError, match=r"none\.h5"):
        learn(tmp_path / "none.h5")


def test_bulletarm_gym_is_imported_for_a_path_only() -> None:
    code = "import sys, sb3_extensions.sacfd; assert 'bulletarm_gym' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_further_observations_are_ignored(reaching: Demonstrations) -> None:
    more = {**reaching[0].observations, "more": np.zeros((len(reaching[0]) + 1, 2))}
    learn([plain_episode(reaching[0], observations=more)])


def test_action_sequence_of_a_minari_data_set_is_compared(reaching: Demonstrations) -> None:
    with pytest.raises(ValueError, match="got 'xyzrp'"):
        learn(MinariLike(reaching, action_sequence="xyzrp"))
    learn(MinariLike(reaching, action_sequence="pxyzr"))


@pytest.mark.parametrize("algorithm", [SACfD, TQCfD])
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
def test_learners_name_the_observations_without_images(wrapper: Any, got: str, algorithm: Any) -> None:
    env = wrapper(gym.make(ENV_ID, obs_size=48))
    with pytest.raises(ValueError, match=rf"^observation_space must have images, .* got {got}\. Use"):
        algorithm("EquivariantPolicy", env, buffer_size=100)


def rescaled(env: Any) -> Any:
    return RescaleAction(env, np.float32(-2.0), np.float32(5.0))


@pytest.mark.parametrize("callback", [None, DaggerCallback()])
def test_learner_stores_the_experts_actions_in_the_wrapped_action_space(callback: Any) -> None:
    def make() -> Any:
        return rescaled(gym.make(ENV_ID, observation="state"))

    stored = []
    for env in (make_vec_env(ENV_ID, env_kwargs={"observation": "state"}), make_vec_env(make)):
        model = SACfD("StatePolicy", env, expert_episodes=2, buffer_size=100, seed=0).learn(
            2, callback=callback
        )
        assert model.replay_buffer is not None
        stored.append(model.replay_buffer.steps("expert_action")[: model.replay_buffer.expert_size + 1])
    np.testing.assert_allclose(stored[0], stored[1], atol=1e-5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"actions": lambda x: x * 1000}, r"actions from -1 to 1, got -?\d+ to \d+ in episode 0"),
        ({"actions": lambda x: np.full_like(x, np.nan)}, "actions from -1 to 1, got nan to nan in episode 0"),
        ({"rewards": lambda x: x + np.inf}, "rewards from .* got inf to inf in episode 0"),
        ({"rewards": lambda x: x[:-1]}, r"rewards of shape \(\d+,\), got \(\d+,\) in episode 0"),
        ({"expert_actions": lambda x: x - 7}, "expert_actions from -1 to 1, got -8"),
        (
            {"observations": lambda x: {**x, "holding": x["holding"] * 255 - 3}},
            r"observations\['holding'\] from 0 to 1, got -3 to .* in episode 0",
        ),
    ],
)
def test_values_outside_their_bounds_are_refused(
    changes: dict[str, Any], message: str, reaching: Demonstrations
) -> None:
    parts = {**vars(plain_episode(reaching[0]))}
    changed = {name: change(parts[name]) for name, change in changes.items()}
    with pytest.raises(ValueError, match=f"^expert_data must have {message}"):
        learn([plain_episode(reaching[0], **changed)])


def test_learner_names_the_wrapper_without_an_inverse() -> None:
    def make() -> Any:
        env = gym.make(ENV_ID, observation="state")
        return gym.wrappers.TransformAction(env, np.negative, env.action_space)

    model = SACfD("StatePolicy", make_vec_env(make), expert_episodes=2, buffer_size=100)
    with pytest.raises(ValueError, match=r"expert_action must be queried below .*, got TransformAction"):
        model.learn(1)
