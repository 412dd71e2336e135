"""The average of an actor's weights."""

from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.sac.policies import Actor

from sb3_extensions.ferm import FERM
from sb3_extensions.sacfd import SACfD
from sb3_extensions.sacfd.policies import EquivariantPolicy, SACfDPolicy
from sb3_extensions.tqcfd import TQCfD

CNN = {"features_extractor_kwargs": {"channels": [8, 16, 32]}, "net_arch": [32]}
EQUIVARIANT = {"features_extractor_kwargs": {"n": 4, "channels": [2, 4, 8]}}
CONTRASTIVE = {"features_extractor_kwargs": {"channels": [4, 8, 8], "features_dim": 6}, "net_arch": [16]}
LEARNERS = [
    pytest.param(SACfD, "MultiInputPolicy", CNN, {}, id="cnn"),
    pytest.param(SACfD, "EquivariantPolicy", EQUIVARIANT, {}, id="equivariant"),
    pytest.param(
        SACfD, "EquivariantPolicy", {**EQUIVARIANT, "share_features_extractor": True}, {}, id="shared"
    ),
    pytest.param(TQCfD, "EquivariantPolicy", EQUIVARIANT, {}, id="tqcfd"),
    pytest.param(
        FERM, "MultiInputPolicy", CONTRASTIVE, {"augmentation": "drq", "contrastive_steps": 2}, id="ferm"
    ),
]


def make_model(
    env: Any,
    learner: type[SACfD] = SACfD,
    name: str = "EquivariantPolicy",
    policy_kwargs: dict[str, Any] = EQUIVARIANT,
    actor_tau: float | None = 0.25,
    **kwargs: Any,
) -> SACfD:
    defaults = {"expert_episodes": 5, "batch_size": 16, "buffer_size": 500, "seed": 0}
    averaged = {**policy_kwargs, "actor_tau": actor_tau}
    return learner(name, env, policy_kwargs=averaged, device="cpu", **{**defaults, **kwargs})


def weights(module: th.nn.Module) -> np.ndarray:
    return th.nn.utils.parameters_to_vector(module.parameters()).detach().numpy().copy()


def average(model: SACfD) -> Actor:
    assert isinstance(model.policy, SACfDPolicy) and model.policy.actor_average is not None
    return model.policy.actor_average.module


def batch(env: Any) -> dict[str, np.ndarray]:
    obs: dict[str, np.ndarray] = env.reset()
    return obs


class Actors(BaseCallback):
    """Keeps the actor's weights before every gradient step and after the last."""

    def __init__(self) -> None:
        super().__init__()
        self.history: list[np.ndarray] = []

    def _on_rollout_start(self) -> None:
        self.history.append(weights(self.model.actor))  # type: ignore[attr-defined]

    def _on_step(self) -> bool:
        return True


def test_first_updates_count_alike_then_the_latest_most(make_toy: Any) -> None:
    model, actors = make_model(make_toy(), pretrain_steps=3), Actors()
    model.learn(5, callback=actors)
    after = [*actors.history[1:], weights(model.actor)]
    assert len(after) == 3 + 5 and (after[0] != after[-1]).any()
    expected = np.mean(after[:4], axis=0)
    for latest in after[4:]:
        expected = 0.75 * expected + 0.25 * latest
    np.testing.assert_allclose(weights(average(model)), expected, atol=1e-5)


@pytest.mark.parametrize(("learner", "name", "policy_kwargs", "kwargs"), LEARNERS)
def test_acts_where_actions_are_not_sampled(
    learner: type[SACfD], name: str, policy_kwargs: dict[str, Any], kwargs: dict[str, Any], make_toy: Any
) -> None:
    env = make_toy(3)
    model = make_model(env, learner, name, policy_kwargs, **kwargs)
    obs = batch(env)
    tensors, _ = model.policy.obs_to_tensor(obs)

    def means(actor: Any) -> np.ndarray:
        with th.no_grad():
            actions: np.ndarray = actor(tensors, deterministic=True).numpy()
        return model.policy.unscale_action(actions)

    np.testing.assert_array_equal(model.predict(obs, deterministic=True)[0], means(model.actor))
    model.learn(30)
    model.policy.set_training_mode(False)
    assert (means(model.actor) != means(average(model))).any()
    np.testing.assert_array_equal(model.predict(obs, deterministic=True)[0], means(average(model)))
    th.manual_seed(0)
    sampled = model.predict(obs)[0]
    th.manual_seed(0)
    with th.no_grad():
        expected = model.policy.unscale_action(model.actor(tensors).numpy())
    np.testing.assert_array_equal(sampled, expected)


@pytest.mark.parametrize(("learner", "name", "policy_kwargs", "kwargs"), LEARNERS)
def test_is_saved_and_not_trained(
    learner: type[SACfD],
    name: str,
    policy_kwargs: dict[str, Any],
    kwargs: dict[str, Any],
    make_toy: Any,
    tmp_path: Any,
) -> None:
    env = make_toy()
    model = make_model(env, learner, name, policy_kwargs, **kwargs).learn(10)
    averages = list(average(model).parameters())
    optimizers = [model.actor.optimizer, model.critic.optimizer]
    trained = {p for optimizer in optimizers for group in optimizer.param_groups for p in group["params"]}
    assert trained.isdisjoint(averages) and not any(p.requires_grad for p in averages)
    model.save(tmp_path / "model")
    model.policy.save(tmp_path / "policy")
    obs = batch(env)
    expected, _ = model.predict(obs, deterministic=True)
    for loaded in (
        learner.load(tmp_path / "model", device="cpu"),
        type(model.policy).load(tmp_path / "policy", device="cpu"),
    ):
        np.testing.assert_array_equal(loaded.predict(obs, deterministic=True)[0], expected)


def test_there_is_none_without_a_coefficient(make_toy: Any) -> None:
    env = make_toy()
    model = make_model(env, actor_tau=None).learn(5)
    assert isinstance(model.policy, EquivariantPolicy) and model.policy.actor_average is None
    assert not any("average" in name for name in model.policy.state_dict())
    assert model._n_updates == 5


def test_learning_is_the_same_with_it(make_toy: Any) -> None:
    averaged, plain = (make_model(make_toy(), actor_tau=tau) for tau in (0.1, None))
    plain.policy.load_state_dict(averaged.policy.state_dict(), strict=False)
    for model in (averaged, plain):
        model.set_random_seed(3)
        model.learn(10)
    np.testing.assert_array_equal(weights(averaged.actor), weights(plain.actor))
    np.testing.assert_array_equal(weights(averaged.critic), weights(plain.critic))


@pytest.mark.parametrize("actor_tau", [0.0, 1.5])
def test_bad_coefficients(actor_tau: float, make_toy: Any) -> None:
    with pytest.raises(
        ValueError, match=f"actor_tau must be None or greater than 0 and at most 1, got {actor_tau}"
    ):
        make_model(make_toy(), actor_tau=actor_tau)
