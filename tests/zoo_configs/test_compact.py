"""Small files of agents, which the algorithm's own load reads."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import nn

from sb3_extensions.ferm import FERM
from sb3_extensions.sacfd import SACfD
from zoo_configs.publishing.compact import save_compact, stored_weights

SMALL = {"features_extractor_kwargs": {"n": 4, "channels": [1, 2, 2, 2, 2]}}


class Bf16(nn.Module):
    """Computes its plain layers in bfloat16."""

    autocast = "bf16"

    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Linear(3, 2)


class Policy(nn.Module):
    """An actor that shares its encoder with the critic."""

    def __init__(self) -> None:
        super().__init__()
        encoder = Bf16()
        self.actor = nn.ModuleDict({"encoder": encoder, "mean": nn.Linear(2, 2)})
        self.critic = nn.ModuleDict({"encoder": encoder, "value": nn.Linear(2, 1)})


def test_weights_are_rounded_as_the_network_rounds_them() -> None:
    policy = Policy()
    weights = stored_weights(policy, half=True)
    assert set(weights) == set(policy.state_dict())
    encoder = policy.actor["encoder"].layer.weight  # type: ignore[union-attr, index]
    assert th.equal(weights["actor.encoder.layer.weight"], encoder.bfloat16())
    assert weights["actor.mean.weight"].dtype == th.float16
    assert weights["actor.mean.bias"].dtype == th.float32


def test_shared_parameters_and_targets_are_stored_once() -> None:
    policy = Policy()
    policy.critic_target = nn.ModuleDict({"encoder": Bf16(), "value": nn.Linear(2, 1)})
    weights = stored_weights(policy, half=True)
    assert weights["critic.encoder.layer.weight"] is weights["actor.encoder.layer.weight"]
    assert weights["critic_target.value.weight"] is weights["critic.value.weight"]


def test_weights_too_large_for_float16_stay() -> None:
    policy = Policy()
    with th.no_grad():
        policy.actor["mean"].weight[0, 0] = 1e6  # type: ignore[index, operator, union-attr]
    assert stored_weights(policy, half=True)["actor.mean.weight"].dtype == th.float32


def make_model(name: str, toy_id: str) -> BaseAlgorithm:
    if name == "sac":
        return SAC("MlpPolicy", "Pendulum-v1", seed=0)
    if name == "ppo":
        return PPO("MlpPolicy", "Pendulum-v1", seed=0)
    kwargs: dict[str, Any] = {**SMALL, "share_features_extractor": name == "shared"}
    env = gym.make(toy_id, obs_size=48)
    if name == "ferm":
        kwargs = {"features_extractor_kwargs": {"channels": [4, 8, 8, 8, 8], "features_dim": 6}}
        more: dict[str, Any] = {"augmentation": "drq", "policy_kwargs": {**kwargs, "actor_tau": 0.1}}
        return FERM("MultiInputPolicy", env, seed=0, **more)
    kwargs["actor_tau"] = 0.1 if name == "average" else None
    return SACfD("EquivariantPolicy", env, policy_kwargs=kwargs, seed=0)


def wander(model: BaseAlgorithm) -> None:
    """Another average than the actor's weights, as training brings about."""
    if getattr(model.policy, "actor_average", None) is not None:
        with th.no_grad():
            for parameter in model.policy.get_submodule("actor").parameters():
                parameter.mul_(1.5)


@pytest.mark.parametrize("name", ["sac", "ppo", "sacfd", "shared", "average", "ferm"])
@pytest.mark.parametrize("half", [False, True])
def test_what_is_loaded_acts_alike(name: str, half: bool, toy_id: str, tmp_path: Path) -> None:
    model = make_model(name, toy_id)
    wander(model)
    stored = save_compact(model, tmp_path / "agent.zip", half)
    loaded = type(model).load(tmp_path / "agent.zip")
    assert stored == ("float16" if half else "float32")
    space = model.observation_space
    space.seed(0)
    for _ in range(5):
        seen = space.sample()
        expected, _ = model.predict(seen, deterministic=True)
        action, _ = loaded.predict(seen, deterministic=True)
        np.testing.assert_allclose(action, expected, atol=0.01 if half else 0.0)
        assert np.isfinite(loaded.predict(seen)[0]).all()  # sampled


def test_a_file_is_small_and_says_nothing_of_the_machine(toy_id: str, tmp_path: Path) -> None:
    model = SACfD(
        "EquivariantPolicy",
        gym.make(toy_id, obs_size=48),
        policy_kwargs=SMALL,
        expert_episodes=2,
        learning_starts=0,
        pretrain_steps=1,
        batch_size=4,
        seed=0,
    )
    model.learn(2)
    model.save(tmp_path / "whole.zip")
    save_compact(model, tmp_path / "small.zip")
    assert (tmp_path / "small.zip").stat().st_size < (tmp_path / "whole.zip").stat().st_size / 4
    with zipfile.ZipFile(tmp_path / "small.zip") as archive:
        data = archive.read("data").decode()
    assert str(tmp_path) not in data
    assert json.loads(data)["_last_obs"] is None
    loaded = SACfD.load(tmp_path / "small.zip")
    assert not loaded.actor.optimizer.state_dict()["state"]
    assert all(weight.isfinite().all() for weight in loaded.policy.parameters())


def test_a_compact_agent_trains_further(toy_id: str, tmp_path: Path) -> None:
    env = gym.make(toy_id, obs_size=48)
    schedule = {"learning_rate": lambda progress: 1e-3 * progress, "expert_episodes": 1, "batch_size": 4}
    save_compact(SACfD("EquivariantPolicy", env, policy_kwargs=SMALL, seed=0, **schedule), tmp_path / "a.zip")
    loaded = SACfD.load(tmp_path / "a.zip", env=env)
    before = [parameter.detach().clone() for parameter in loaded.actor.parameters()]
    loaded.learn(3)
    assert loaded.learning_rate == 1e-3
    assert all(weight.isfinite().all() for weight in loaded.policy.parameters())
    assert any(not th.equal(old, new) for old, new in zip(before, loaded.actor.parameters(), strict=True))


def test_the_same_agent_gives_the_same_bytes(toy_id: str, tmp_path: Path) -> None:
    model = make_model("sacfd", toy_id)
    for name in ("a.zip", "b.zip"):
        save_compact(model, tmp_path / name)
    assert (tmp_path / "a.zip").read_bytes() == (tmp_path / "b.zip").read_bytes()
