"""Every network of every preset, built by what `train` runs: what it says before it has learned anything."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm

from measure_updates import make_model
from zoo_configs.cli import main
from zoo_configs.environments import register_environments
from zoo_configs.experiments.config import resolve
from zoo_configs.experiments.rules import family_of
from zoo_configs.training.trainer import Trainer

register_environments()
STACKING = "BulletArm/CloseLoopBlockStacking-v0"
SCALES = {
    "plain": {"standardise": None, "above_ground": None},
    "centimetres": {"standardise": [0.1, 0.01], "above_ground": None},
    "heights": {"standardise": [0.0, 0.1], "above_ground": [0.2, 0.1]},
}
FAMILY = family_of(STACKING)
SEEING = [name for name, row in FAMILY.baselines.items() if row.network != "state"]
Build = Callable[..., Any]


@pytest.fixture
def build(toy_id: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Build:
    """Runs `bulletarm-zoo train` up to the first step: ``build(baseline, preset, *hyperparameters)``."""
    built: list[BaseAlgorithm] = []
    monkeypatch.setattr(Trainer, "learn", lambda trainer: not built.append(trainer.model))

    def run(baseline: str, preset: str, *params: str) -> BaseAlgorithm:
        arguments = ["train", "--baseline", baseline, "--preset", preset, "--env", toy_id, "--seed", "0"]
        arguments += ["-f", str(tmp_path), "--device", "cpu", "--vec-env", "dummy", "--no-progress"]
        assert main([*arguments, "--eval-freq", "-1", "-params", "buffer_size:100", *params]) == 0
        return built[-1]

    return run


@functools.cache
def real_observations(**env_kwargs: Any) -> dict[str, th.Tensor]:
    """What is observed while blocks are stacked, (n, ...) each."""
    env = gym.make(STACKING, **env_kwargs)
    observations, ended = [env.reset(seed=0)[0]], False
    while not ended:
        observation, _, terminated, truncated, _ = env.step(env.unwrapped.expert_action())  # type: ignore[attr-defined]
        observations.append(observation)
        ended = terminated or truncated
    env.close()
    return {key: th.as_tensor(np.stack([entry[key] for entry in observations])) for key in observations[0]}


@pytest.mark.parametrize("scale", list(SCALES))
@pytest.mark.parametrize("preset", [name for name in FAMILY.presets if name != "paper"])  # not normalised
@pytest.mark.parametrize("baseline", SEEING)
def test_an_untrained_agent_expects_nothing_and_tries_everything(
    baseline: str, preset: str, scale: str, build: Build
) -> None:
    """
    True values lie in [0, 1]: what a critic says wrongly at first, it says for long. An actor whose actions
    are large at first explores a few of them only.
    """
    kwargs = {"features_extractor_kwargs": SCALES[scale]}
    model = build(baseline, preset, f"policy_kwargs:{kwargs}")
    assert_expects_nothing(model, real_observations(obs_size=model.observation_space["heightmap"].shape[-1]))


@pytest.mark.parametrize("preset", [name for name in FAMILY.presets if name != "paper"])  # not normalised
def test_an_untrained_agent_of_states_expects_nothing_and_tries_everything(preset: str) -> None:
    model = make_model(resolve("sacfd_state", preset, STACKING), "cpu", expert_episodes=0, pretrain_steps=0)
    assert set(model.observation_space.spaces) == {"state", "holding"}
    assert_expects_nothing(model, real_observations(observation="state"))
    model.env.close()


def assert_expects_nothing(model: Any, observations: dict[str, th.Tensor]) -> None:
    actions = th.rand(len(observations["holding"]), 5, generator=th.Generator().manual_seed(0)) * 2 - 1
    with th.no_grad():
        mean, log_std, _ = model.actor.get_action_dist_params(observations)
        values = th.stack(tuple(model.critic(observations, actions)))
    assert values.isfinite().all() and values.abs().max() <= 1
    assert mean.tanh().abs().max() <= 0.3
    assert 0.5 <= log_std.exp().min() and log_std.exp().max() <= 2
    first = {key: value[0].numpy() for key, value in observations.items()}
    assert model.predict(first, deterministic=True)[0].shape == model.action_space.shape
