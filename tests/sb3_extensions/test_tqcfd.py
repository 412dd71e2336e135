"""TQCfD: differences to SACfD."""

import copy
from typing import Any

import numpy as np
import pytest
import torch as th
from sb3_contrib import TQC
from sb3_contrib.tqc.policies import MultiInputPolicy as StockPolicy
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_extensions.replay.buffer import ExpertReplayBuffer
from sb3_extensions.tqcfd import TQCfD

SMALL_STOCK = {"net_arch": [16], "features_extractor_kwargs": {"cnn_output_dim": 8}}
STOCK = (StockPolicy, SMALL_STOCK)
N_QUANTILES, N_CRITICS = 7, 3


def make_model(env: Any, policy: tuple[Any, Any] = STOCK, **kwargs: Any) -> TQCfD:
    name, policy_kwargs = policy
    kwargs = {"expert_episodes": 5, "batch_size": 16, "buffer_size": 500, "seed": 0, **kwargs}
    return TQCfD(name, env, policy_kwargs=policy_kwargs, device="cpu", **kwargs)


def parameters(model: Any) -> dict[str, np.ndarray]:
    return {name: value.numpy().copy() for name, value in model.policy.state_dict().items()}


@pytest.mark.parametrize(
    "kwargs",
    [
        {},
        {"n_steps": 3, "ent_coef": 0.1},
        {"augmentation": "drq"},
        {
            "replay_buffer_kwargs": {"sampler": "prioritized"},
            "augmentation": {"rotation": {}, "rad": {"size": 12}},
        },
    ],
)
def test_run(policy: Any, kwargs: dict[str, Any], make_toy: Any) -> None:
    model = make_model(make_toy(2), policy, **kwargs).learn(12)
    assert model._n_updates == 6
    assert model.replay_buffer.expert_size > 0
    assert model.policy.n_quantiles == 25
    assert all(np.isfinite(value).all() for value in parameters(model).values())


def test_deterministic_training(policy: Any, make_toy: Any) -> None:
    first, second = (parameters(make_model(make_toy(2), policy).learn(10)) for _ in range(2))
    for name, value in first.items():
        np.testing.assert_array_equal(value, second[name], err_msg=name)


def test_tqcfd_without_imitation_equals_tqc(make_toy: Any) -> None:
    kwargs: dict[str, Any] = {
        "learning_rate": 1e-3,
        "buffer_size": 500,
        "learning_starts": 10,
        "batch_size": 16,
        "tau": 0.02,
        "gamma": 0.9,
        "ent_coef": "auto_0.01",
        "policy_kwargs": dict(SMALL_STOCK),
        "device": "cpu",
        "seed": 0,
        "top_quantiles_to_drop_per_net": 3,
    }

    def trained(model: Any) -> Any:
        # The actor's loss uses the critic before its step: let it stand still
        model.critic.optimizer.step = lambda *args: None
        return model.learn(40)

    alone = {"bc_weight": 0, "expert_episodes": 0}
    buffer = {"replay_buffer_kwargs": {"handle_timeout_termination": True}}
    ours = trained(TQCfD(StockPolicy, make_toy(2, endless=True), **kwargs, **alone, **buffer))
    kwargs |= {"replay_buffer_class": ExpertReplayBuffer, "replay_buffer_kwargs": {"seed": 0}}
    stock = trained(TQC(StockPolicy, make_toy(2, endless=True), **kwargs))
    assert ours._n_updates == stock._n_updates > 10
    theirs = parameters(stock)
    for name, value in parameters(ours).items():
        np.testing.assert_allclose(value, theirs[name], rtol=1e-3, atol=1e-5, err_msg=name)


def reference_critic_loss(current: np.ndarray, targets: np.ndarray, weights: np.ndarray) -> float:
    """
    Weighted quantile Huber loss, one pair of numbers after the other.

    :param current: quantiles of each critic, shape (batch, critics, quantiles)
    :param targets: shape (batch, target quantiles)
    """
    batch, critics, quantiles = current.shape
    loss = 0.0
    for k in range(batch):
        for c in range(critics):
            for i in range(quantiles):
                level = (i + 0.5) / quantiles
                for target in targets[k]:
                    delta = target - current[k, c, i]
                    huber = delta**2 / 2 if abs(delta) <= 1 else abs(delta) - 0.5
                    loss += weights[k] * (1 - level if delta < 0 else level) * huber
    return loss / (batch * critics * quantiles * targets.shape[1])


@pytest.mark.parametrize("dropped", [0, 2])
def test_losses_equal_a_slow_reference(dropped: int, make_toy: Any) -> None:
    policy_kwargs = {**SMALL_STOCK, "n_quantiles": N_QUANTILES, "n_critics": N_CRITICS}
    model = make_model(
        make_toy(),
        (StockPolicy, policy_kwargs),
        top_quantiles_to_drop_per_net=dropped,
        replay_buffer_kwargs={"sampler": "prioritized"},
        bc_weight=0.7,
        n_steps=2,
        gamma=0.9,
    )
    model.learn(10)
    assert model.replay_buffer is not None
    sample = model.replay_buffer.sample(16)
    weights = th.linspace(0.1, 1, 16)[:, None]
    rows = np.flatnonzero(model.replay_buffer.table.columns["valid"])[:16]
    sample = sample._replace(
        weights=weights, indices=rows, rewards=sample.rewards * 3, dones=th.zeros_like(sample.dones)
    )
    model.replay_buffer.sample = lambda *args, **kwargs: sample  # type: ignore[method-assign]
    alpha, critic = model.log_ent_coef.exp().item(), copy.deepcopy(model.critic)
    th.manual_seed(3)
    with th.no_grad():
        actions, log_prob = (x.numpy() for x in model.actor.action_log_prob(sample.observations))
        next_actions, next_log_prob = model.actor.action_log_prob(sample.next_observations)
        next_quantiles = model.critic_target(sample.next_observations, next_actions).numpy()
        current = model.critic(sample.observations, sample.actions).numpy()
    th.manual_seed(3)
    model.train(1, 16)
    logged = model.logger.name_to_value

    targets, td_errors = [], []
    for k in range(16):
        kept = sorted(next_quantiles[k].ravel())[: N_CRITICS * (N_QUANTILES - dropped)]
        factor = (1 - sample.dones[k].item()) * sample.discounts[k].item()
        entropy = alpha * next_log_prob[k].item()
        targets.append([sample.rewards[k].item() + factor * (z - entropy) for z in kept])
        td_errors.append(np.mean([abs(current[k, c].mean() - np.mean(targets[k])) for c in range(N_CRITICS)]))
    expected = reference_critic_loss(current, np.array(targets), weights[:, 0].numpy())
    np.testing.assert_allclose(logged["train/critic_loss"], expected, rtol=1e-4)
    priorities = model.replay_buffer.sampler.masses[rows] ** (1 / 0.6)
    bonus = rows < model.replay_buffer.table.n_pinned
    np.testing.assert_allclose(priorities, np.array(td_errors) + bonus, rtol=1e-3, atol=2e-6)
    # The actor's loss uses the critic before its step
    with th.no_grad():
        values = critic(sample.observations, th.as_tensor(actions)).numpy().mean(axis=(1, 2))
    np.testing.assert_allclose(logged["train/actor_loss"], (alpha * log_prob - values).mean(), rtol=1e-4)
    experts = sample.is_expert[:, 0].numpy()
    squared_error = ((actions - sample.actions.numpy()) ** 2)[experts].mean()
    np.testing.assert_allclose(logged["train/bc_loss"], squared_error, rtol=1e-4)


def test_equivariant_networks(make_toy: Any) -> None:
    kwargs = {"features_extractor_kwargs": {"n": 4, "channels": [2, 4, 8]}, "n_quantiles": N_QUANTILES}
    model = make_model(make_toy(), ("EquivariantPolicy", kwargs)).learn(4)
    assert model.replay_buffer is not None
    sample = model.replay_buffer.sample(8)
    p, x, y, z, r = sample.actions.unbind(1)
    turned = {**sample.observations, "heightmap": th.rot90(sample.observations["heightmap"], 1, (2, 3))}
    with th.no_grad():
        quantiles = th.stack(model.critic(sample.observations, sample.actions), dim=1)
        turned_quantiles = th.stack(model.critic(turned, th.stack([p, -y, x, z, r], dim=1)), dim=1)
        p, x, y, z, r = model.actor(sample.observations, deterministic=True).unbind(1)
        turned_actions = model.actor(turned, deterministic=True)
    assert quantiles.shape == (8, 2, N_QUANTILES) and quantiles.std() > 1e-3
    th.testing.assert_close(turned_quantiles, quantiles, atol=1e-4, rtol=0)
    th.testing.assert_close(turned_actions, th.stack([p, -y, x, z, r], dim=1), atol=1e-4, rtol=0)


def test_save_and_load(policy: Any, make_toy: Any, tmp_path: Any) -> None:
    model = make_model(make_toy(), policy, top_quantiles_to_drop_per_net=3, bc_weight=0.3).learn(5)
    model.save(tmp_path / "model")
    loaded = TQCfD.load(tmp_path / "model", env=make_toy(), device="cpu")
    theirs = parameters(loaded)
    for name, value in parameters(model).items():
        np.testing.assert_array_equal(value, theirs[name], err_msg=name)
    assert loaded.top_quantiles_to_drop_per_net == 3 and loaded.bc_weight == 0.3
    loaded.learn(5, reset_num_timesteps=False)


@pytest.mark.parametrize("dropped", [-1, 25])
def test_dropping_all_quantiles_is_rejected(dropped: int, make_toy: Any) -> None:
    with pytest.raises(ValueError, match="top_quantiles_to_drop_per_net"):
        make_model(make_toy(), top_quantiles_to_drop_per_net=dropped)


def test_learns_to_reach(policy: Any, make_toy: Any) -> None:
    kwargs = {"expert_episodes": 20, "pretrain_steps": 60, "learning_rate": 3e-3, "batch_size": 32}
    model = make_model(make_toy(2), policy, **kwargs)
    untrained, _ = evaluate_policy(model, make_toy(seed=9), 30)
    model.learn(100)
    trained, _ = evaluate_policy(model, make_toy(seed=9), 30)
    assert untrained < 0.6
    assert trained >= 0.95
