"""SACfD: in the manner of Stable-Baselines3's tests of its own algorithms."""

from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.sac.policies import MultiInputPolicy as StockPolicy

from sb3_extensions.demonstrations.collection import collect_episodes
from sb3_extensions.demonstrations.dagger import DaggerCallback
from sb3_extensions.demonstrations.expert_envs import make_expert_envs
from sb3_extensions.ferm import FERM
from sb3_extensions.replay.buffer import ExpertReplayBuffer
from sb3_extensions.sacfd import SACfD
from sb3_extensions.sacfd.exploration import replace_one_number
from sb3_extensions.sacfd.losses import imitation_loss, self_imitation_weights
from sb3_extensions.spatial_dqn import SDQfD, SpatialDQN
from sb3_extensions.tqcfd import TQCfD

SMALL_STOCK = {"net_arch": [16], "features_extractor_kwargs": {"cnn_output_dim": 8}}


def make_model(env: Any, policy: tuple[Any, Any] = (StockPolicy, SMALL_STOCK), **kwargs: Any) -> SACfD:
    name, policy_kwargs = policy
    kwargs = {"expert_episodes": 5, "batch_size": 16, "buffer_size": 500, "seed": 0, **kwargs}
    return SACfD(name, env, policy_kwargs=policy_kwargs, device="cpu", **kwargs)


def parameters(model: Any) -> dict[str, np.ndarray]:
    module = getattr(model, "policy", model)
    return {name: value.numpy().copy() for name, value in module.state_dict().items()}


def assert_equal_parameters(first: Any, second: Any) -> None:
    theirs = parameters(second)
    for name, value in parameters(first).items():
        np.testing.assert_array_equal(value, theirs[name], err_msg=name)


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("n_steps", [1, 3])
def test_run(policy: Any, n_envs: int, n_steps: int, make_toy: Any) -> None:
    model = make_model(make_toy(n_envs), policy, n_steps=n_steps)
    model.learn(20)
    assert model.num_timesteps == 20
    assert model._n_updates == 20 // n_envs
    assert model.replay_buffer.n_steps == n_steps
    assert model.replay_buffer.expert_size > 0
    assert model.replay_buffer.size() == model.replay_buffer.expert_size + 20


@pytest.mark.parametrize(
    "kwargs", [{"train_freq": (1, "episode")}, {"ent_coef": 0.1}, {"gradient_steps": -1}]
)
def test_run_variants(kwargs: dict[str, Any], make_toy: Any) -> None:
    make_model(make_toy(), **kwargs).learn(30)


def test_run_with_vec_normalize(make_toy: Any) -> None:
    make_model(VecNormalize(make_toy(), norm_obs_keys=["holding"])).learn(20)


def test_id_as_env() -> None:
    make_model("ToyReach-v0").learn(5)


def test_deterministic_training(policy: Any, make_toy: Any) -> None:
    models = [make_model(make_toy(2), policy).learn(20) for _ in range(2)]
    assert_equal_parameters(*models)
    np.random.seed(1)  # neither demonstrations nor samples depend on what came before
    assert_equal_parameters(models[0], make_model(make_toy(2), policy).learn(20))
    samples = [model.replay_buffer.sample(16).indices for model in models]
    np.testing.assert_array_equal(*samples)


def test_demonstrations_are_no_timesteps(make_toy: Any) -> None:
    env = make_toy()
    model = make_model(env, pretrain_steps=3, learning_starts=1000)
    model.learn(4)
    assert env.get_attr("total_steps") == [4]
    assert model._n_updates == 3
    size = model.replay_buffer.expert_size
    model.learn(4, reset_num_timesteps=False)
    assert model._n_updates == 3
    assert model.replay_buffer.expert_size == size


def test_expert_data_is_an_iterable_of_episodes(make_toy: Any) -> None:
    env = make_toy()
    episodes = list(collect_episodes(make_expert_envs(env)[0][0], 3, seed=0, progress_bar=False))
    model = make_model(env, expert_data=iter(episodes)).learn(2)
    assert model.replay_buffer.expert_size == sum(len(episode.actions) for episode in episodes)
    stored = model.replay_buffer.steps("action")[: model.replay_buffer.expert_size]
    np.testing.assert_allclose(stored, np.concatenate([episode.actions for episode in episodes]), atol=1e-6)


def frozen_critic(model: Any) -> Any:
    model.critic.optimizer.step = lambda *args: None
    return model


def test_without_imitation_it_is_sac(make_toy: Any) -> None:
    """But for the actor's loss, which uses the critic before its step: equal if the critic stands still."""
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
    }

    def ours() -> SACfD:
        alone = {"bc_weight": 0, "expert_episodes": 0}
        # All targets bootstrap: SACfD draws no noise for the others.
        buffer = {"replay_buffer_kwargs": {"handle_timeout_termination": True}}
        return SACfD(StockPolicy, make_toy(2, endless=True), **kwargs, **alone, **buffer)

    def stock() -> SAC:
        buffer = {"replay_buffer_class": ExpertReplayBuffer, "replay_buffer_kwargs": {"seed": 0}}
        return SAC(StockPolicy, make_toy(2, endless=True), **kwargs, **buffer)

    for steps in (80, 12):
        models = [frozen_critic(make()).learn(steps) for make in (ours, stock)]
        assert models[0]._n_updates == models[1]._n_updates > 0
        assert_equal_parameters(*models)
    first_update = [parameters(make().learn(12)) for make in (ours, stock)]
    for name, value in first_update[0].items():
        if not name.startswith("actor."):
            np.testing.assert_array_equal(value, first_update[1][name], err_msg=name)


def one_update(model: SACfD, **changes: Any) -> tuple[Any, dict[str, float]]:
    """One gradient step on one sample; returns the sample and what was logged."""
    sample = model.replay_buffer.sample(16)._replace(**changes)
    model.replay_buffer.sample = lambda *args, **kwargs: sample  # type: ignore[method-assign]
    model.train(1, 16)
    return sample, model.logger.name_to_value


@pytest.mark.parametrize("experts", [0, 5, 16])
def test_losses_equal_a_slow_reference(experts: int, make_toy: Any) -> None:
    model = make_model(make_toy(), bc_weight=0.7, n_steps=2, gamma=0.9)
    model.learn(20)
    expert_actions = th.full((16, 5), np.nan)
    expert_actions[:experts] = th.rand(experts, 5)
    weights = th.linspace(0.1, 1, 16)[:, None]
    before = parameters(model)
    alpha = model.log_ent_coef.exp().item()
    actor, critic, target = (copy_of(model, name) for name in ("actor", "critic", "critic_target"))
    th.manual_seed(3)
    sample, logged = one_update(model, expert_actions=expert_actions, weights=weights, dones=th.zeros(16, 1))

    th.manual_seed(3)
    with th.no_grad():
        actions, log_prob = (x.numpy() for x in actor.action_log_prob(sample.observations))
        next_actions, next_log_prob = actor.action_log_prob(sample.next_observations)
        next_q = np.stack([q.numpy() for q in target(sample.next_observations, next_actions)])
        q = np.stack([q.numpy() for q in critic(sample.observations, sample.actions)])
    critic_loss = squared_error = 0.0
    for k in range(16):
        value = next_q[:, k, 0].min() - alpha * next_log_prob[k].item()
        y = sample.rewards[k].item() + sample.discounts[k].item() * (1 - sample.dones[k].item()) * value
        for head in range(2):
            critic_loss += 0.5 * weights[k].item() * (q[head, k, 0] - y) ** 2 / 16
        if k < experts:
            squared_error += ((actions[k] - expert_actions[k].numpy()) ** 2).sum() / (5 * experts)
    np.testing.assert_allclose(logged["train/critic_loss"], critic_loss, rtol=1e-4)
    np.testing.assert_allclose(logged["train/bc_loss"], squared_error, rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(logged["train/ent_coef"], alpha, rtol=1e-5)
    target_entropy = -5.0
    ent_coef_loss = -(np.log(alpha) * (log_prob + target_entropy)).mean()
    np.testing.assert_allclose(logged["train/ent_coef_loss"], ent_coef_loss, rtol=1e-4)
    # The actor's loss uses the critic before its step.
    with th.no_grad():
        q_pi = np.stack([x.numpy() for x in critic(sample.observations, th.as_tensor(actions))])
    expected = (alpha * log_prob - q_pi.min(axis=0)[:, 0]).mean()
    np.testing.assert_allclose(logged["train/actor_loss"], expected, rtol=1e-4)
    moved = {name for name, value in parameters(model).items() if not np.array_equal(value, before[name])}
    assert {name.split(".")[0] for name in moved} == {"actor", "critic", "critic_target"}


@pytest.mark.parametrize("gradient_steps", [1, 2])
def test_the_target_follows_after_so_many_updates(gradient_steps: int, make_toy: Any) -> None:
    settings: dict[str, Any] = {"gradient_steps": gradient_steps, "target_update_interval": 4, "tau": 1.0}
    model = make_model(make_toy(), batch_size=4, **settings).learn(1)
    moves = []
    for _ in range(8 // gradient_steps):
        before = parameters(model.critic_target)
        model.train(gradient_steps, 4)
        after = parameters(model.critic_target)
        moves.append(any(not np.array_equal(after[name], before[name]) for name in before))
    assert sum(moves) == 2


def copy_of(model: SACfD, name: str) -> Any:
    copy = type(model.policy)(
        model.observation_space, model.action_space, lambda _: 0.0, **model.policy_kwargs
    )
    copy.load_state_dict(model.policy.state_dict())
    return getattr(copy, name)


def test_imitation_moves_the_actor_only(make_toy: Any) -> None:
    models = [make_model(make_toy(), bc_weight=weight).learn(1) for weight in (0.0, 10.0)]
    first, second = (parameters(model) for model in models)
    different = {name.split(".")[0] for name in first if not np.array_equal(first[name], second[name])}
    assert different == {"actor"}


@pytest.mark.parametrize("n_envs", [1, 2])
def test_dagger_queries_the_expert_before_every_step(n_envs: int, make_toy: Any) -> None:
    model = make_model(make_toy(n_envs), learning_starts=40, gradient_steps=0)
    model.learn(40, callback=DaggerCallback())
    buffer = model.replay_buffer
    rows = np.flatnonzero(buffer.table.columns["valid"])[buffer.expert_size :]
    actions, experts = (buffer.table.columns[name][rows] for name in ("action", "expert_action"))
    assert len(rows) == 40 and np.isfinite(experts).all()
    assert (experts[:, [0, 3, 4]] == 0).all()
    # The distance to the target is the expert's action where that is within the limits; a step reduces it.
    left = np.clip(experts - actions, -1, 1)[:, 1:3]
    next_rows = buffer.table.next(rows)
    within = (np.abs(experts) < 1)[:, 1:3] & buffer.table.columns["valid"][next_rows][:, None]
    after = buffer.table.columns["expert_action"][next_rows][:, 1:3]
    assert within.sum() > 5
    np.testing.assert_allclose(after[within], left[within], atol=1e-5)


def test_dagger_imitates_in_online_steps(make_toy: Any) -> None:
    shares = {"sampler": {"shares": {"expert_fraction": 0.0}}}
    kwargs = {"expert_episodes": 1, "learning_starts": 20, "replay_buffer_kwargs": shares}
    losses = []
    for callback in (None, DaggerCallback()):
        model = make_model(make_toy(), **kwargs).learn(25, callback=callback)
        losses.append(model.logger.name_to_value["train/bc_loss"])
    assert losses[0] == 0.0 < losses[1]


def test_dagger_without_an_expert_is_refused(make_toy: Any) -> None:
    env = make_toy()
    model = make_model(env, expert_episodes=0)
    env.has_attr = lambda name: name != "expert_action"
    with pytest.raises(ValueError, match=r"env must have expert_action\(\) for DaggerCallback"):
        model.learn(5, callback=DaggerCallback())


@pytest.mark.parametrize("backup_entropy", [True, False])
@pytest.mark.parametrize("value_range", [None, (-0.01, 0.01)])
def test_targets_equal_a_slow_reference(
    backup_entropy: bool, value_range: tuple[float, float] | None, make_toy: Any
) -> None:
    kwargs = {"backup_entropy": backup_entropy, "value_range": value_range, "ent_coef": 0.3, "gamma": 0.9}
    model = make_model(make_toy(), n_steps=2, **kwargs).learn(20)
    actor, critic, target = (copy_of(model, name) for name in ("actor", "critic", "critic_target"))
    th.manual_seed(3)
    sample, logged = one_update(model)
    th.manual_seed(3)
    loss = 0.0
    continues = sample.dones[:, 0] == 0
    assert 0 < continues.sum() < 16  # the other values are not computed
    row = continues.cumsum(0) - 1
    with th.no_grad():
        actor.action_log_prob(sample.observations)
        after = {key: values[continues] for key, values in sample.next_observations.items()}
        actions, log_prob = actor.action_log_prob(after)
        next_q = th.stack(target(after, actions)).numpy()
        q = th.stack(critic(sample.observations, sample.actions)).numpy()
    for k in range(16):
        value = next_q[:, row[k], 0].min() if continues[k] else 0.0
        if value_range is not None:
            value = min(max(value, value_range[0]), value_range[1])
        value -= 0.3 * log_prob[row[k]].item() * backup_entropy
        y = sample.rewards[k].item() + sample.discounts[k].item() * (1 - sample.dones[k].item()) * value
        loss += 0.5 * ((q[:, k, 0] - y) ** 2).sum() / 16
    np.testing.assert_allclose(logged["train/critic_loss"], loss, rtol=1e-4)


def test_imitation_equals_a_slow_reference(make_toy: Any) -> None:
    model = make_model(make_toy(), learning_starts=60).learn(60)
    sample = model.replay_buffer.sample(64)
    sample = sample._replace(succeeded=sample.is_expert | (th.arange(64) % 2 == 0)[:, None])
    advantages, actions = th.linspace(-1, 1, 64)[:, None], th.rand(64, 5) * 2 - 1
    weights = self_imitation_weights(advantages, sample.succeeded, 0.2)
    total = count = 0.0
    for k in range(64):
        weight = float(np.exp(min(advantages[k].item() / 0.2, 0.0))) if sample.succeeded[k] else 0.0
        np.testing.assert_allclose(weights[k], weight, rtol=1e-5)
        weight = 1.0 if sample.is_expert[k] else weight
        error = (actions[k].numpy() - np.clip(sample.actions[k].numpy(), -0.9, 0.9)) ** 2
        total, count = total + weight * error.mean(), count + weight
    assert 0 < count < 64
    np.testing.assert_allclose(imitation_loss(actions, sample, weights, 0.9), total / count, rtol=1e-5)
    assert not self_imitation_weights(advantages, sample.succeeded, None).any()


def test_self_imitation_learns_from_successful_steps(make_toy: Any) -> None:
    kwargs = {"expert_episodes": 0, "learning_starts": 400, "gradient_steps": 1}
    losses = []
    for temperature in (None, 0.1):
        model = make_model(make_toy(), self_imitation_temperature=temperature, **kwargs).learn(410)
        losses.append(model.logger.name_to_value["train/bc_loss"])
    assert losses[0] == 0.0 < losses[1]


def test_pretraining_updates_the_actor_alone(make_toy: Any) -> None:
    before = parameters(make_model(make_toy()))
    model = make_model(make_toy(), pretrain_steps=5, learning_starts=9).learn(1)
    after = parameters(model)
    moved = {name.split(".")[0] for name in after if not np.array_equal(after[name], before[name])}
    assert moved == {"actor"} and model._n_updates == 5


def test_the_warm_up_updates_everything(make_toy: Any) -> None:
    before = parameters(make_model(make_toy()))
    model = make_model(make_toy(), pretrain_steps=5, critic_warmup_steps=3, learning_starts=9).learn(1)
    after = parameters(model)
    moved = {name.split(".")[0] for name in after if not np.array_equal(after[name], before[name])}
    assert moved == {"actor", "critic", "critic_target"} and model._n_updates == 5


def test_the_critic_has_no_effect_on_the_actor_at_expert_steps_with_weight_0(make_toy: Any) -> None:
    def pretrained(**kwargs: Any) -> dict[str, np.ndarray]:
        model = make_model(make_toy(), learning_starts=9, ent_coef=0.0, **kwargs).learn(1)
        return parameters(model.actor)

    imitated = pretrained(pretrain_steps=20, critic_warmup_steps=None, expert_q_weight=0.0)
    scaled = pretrained(pretrain_steps=20, critic_warmup_steps=None, expert_q_weight=0.0, gamma=0.1)
    for name, value in imitated.items():
        np.testing.assert_array_equal(value, scaled[name], err_msg=name)
    led = pretrained(pretrain_steps=20, critic_warmup_steps=None)
    assert any((value != led[name]).any() for name, value in imitated.items())


def test_exploration_draws_one_number_of_an_action() -> None:
    actions = np.full((4000, 5), 0.25, np.float32)
    disturbed = replace_one_number(actions, 0.3, th.Generator().manual_seed(0))
    changed = disturbed != actions
    assert disturbed.dtype == np.float32 and changed.sum(axis=1).max() == 1
    np.testing.assert_allclose(changed.mean(axis=0), 0.3 / 5, atol=0.02)
    drawn = disturbed[changed]
    assert -1 <= drawn.min() < -0.95 and 0.95 < drawn.max() <= 1 and abs(drawn.mean()) < 0.1


def test_explored_actions_are_those_that_are_stored(make_toy: Any) -> None:
    steady, explored = (
        make_model(make_toy(), exploration=share, gradient_steps=0).learn(40) for share in (0.0, 1.0)
    )
    first, other = (
        model.replay_buffer.steps("action")[model.replay_buffer.expert_size] for model in (steady, explored)
    )
    assert (first != other).sum() == 1
    for model, share in (steady, 0), (explored, 1):
        assert model.replay_buffer.steps("explored")[model.replay_buffer.expert_size :].mean() == share
    assert explored.predict(make_toy().reset(), deterministic=True)[0].shape == (1, 5)


def test_some_episodes_have_deterministic_actions(make_toy: Any) -> None:
    model = make_model(make_toy(3), exploration=1.0, deterministic_fraction=0.5, gradient_steps=0).learn(300)
    table = model.replay_buffer.table
    rows = np.flatnonzero(table.columns["valid"])[model.replay_buffer.expert_size :]
    observations = model.replay_buffer._get_samples(rows).observations
    with th.no_grad():
        actions = model.actor(observations, deterministic=True).numpy()
    is_deterministic = np.isclose(table.columns["action"][rows], actions, atol=0.02).all(axis=1)
    assert 0.2 < is_deterministic.mean() < 0.8
    np.testing.assert_array_equal(table.columns["explored"][rows], ~is_deterministic)
    within = table.columns["valid"][table.next(rows)]  # equal until the end of an episode
    np.testing.assert_array_equal(is_deterministic[:-1][within[:-1]], is_deterministic[1:][within[:-1]])


def test_critic_parameters_get_no_gradient_from_the_actor(make_toy: Any) -> None:
    model = make_model(make_toy()).learn(2)
    gradients = []
    step = model.critic.optimizer.step

    def remember(*args: Any) -> Any:
        gradients.append([p.grad.clone() for p in model.critic.parameters()])
        return step(*args)

    model.critic.optimizer.step = remember  # type: ignore[method-assign]
    model.train(1, 16)
    for parameter, gradient in zip(model.critic.parameters(), gradients[0], strict=True):
        assert parameter.requires_grad
        assert th.equal(parameter.grad, gradient)  # as the critic's own step left it


def test_shared_features_extractor_still_learns(make_toy: Any) -> None:
    kwargs = {"features_extractor_kwargs": {"channels": [4, 8, 8]}, "share_features_extractor": True}
    model = make_model(make_toy(), ("MultiInputPolicy", kwargs))
    before = {name: value.clone() for name, value in model.actor.features_extractor.named_parameters()}
    model.learn(2)
    after = dict(model.actor.features_extractor.named_parameters())
    assert any(not th.equal(value, after[name]) for name, value in before.items())


def test_predict(policy: Any, make_toy: Any) -> None:
    env = make_toy(3)
    model = make_model(env, policy)
    obs = env.reset()
    one = {key: value[0] for key, value in obs.items()}
    assert model.predict(obs)[0].shape == (3, 5)
    assert model.predict(one)[0].shape == (5,)
    first, second = (model.predict(obs, deterministic=True)[0] for _ in range(2))
    np.testing.assert_array_equal(first, second)
    assert env.action_space.contains(model.predict(one)[0])


def test_save_and_load(policy: Any, make_toy: Any, tmp_path: Any) -> None:
    kwargs = {"bc_weight": 0.3, "n_steps": 2, "gamma": 0.9, "ent_coef": "auto_0.01"}
    model = make_model(make_toy(2), policy, **kwargs).learn(20)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = SACfD.load(tmp_path / "model", env=make_toy(2), device="cpu")
    assert_equal_parameters(model, loaded)
    assert loaded.bc_weight == 0.3 and loaded.expert_episodes == 5
    assert loaded.replay_buffer.n_steps == 2 and loaded.replay_buffer.gamma == 0.9
    assert th.equal(model.log_ent_coef, loaded.log_ent_coef)
    for name in ("actor.optimizer", "critic.optimizer", "ent_coef_optimizer"):
        ours, theirs = (states(m, name) for m in (model, loaded))
        assert all(th.equal(a, b) for a, b in zip(ours, theirs, strict=True)) and ours
    loaded.load_replay_buffer(tmp_path / "buffer")
    ours, theirs = model.replay_buffer.sample(32), loaded.replay_buffer.sample(32)
    np.testing.assert_array_equal(ours.indices, theirs.indices)
    np.testing.assert_array_equal(ours.is_expert, theirs.is_expert)
    np.testing.assert_array_equal(ours.observations["heightmap"], theirs.observations["heightmap"])
    expert_size = loaded.replay_buffer.expert_size
    loaded.learn(10, reset_num_timesteps=False)
    assert loaded.replay_buffer.expert_size == expert_size


@pytest.mark.parametrize("name", ["CnnPolicy", "unknown"])
@pytest.mark.parametrize("algorithm", [SACfD, TQCfD, FERM, SpatialDQN, SDQfD])
def test_an_unknown_policy_is_refused_with_the_known_ones(algorithm: Any, name: str, make_toy: Any) -> None:
    known = ", ".join(algorithm.policy_aliases)
    with pytest.raises(ValueError, match=f"policy must be one of {known}, got '{name}'"):
        algorithm(name, make_toy())


@pytest.mark.parametrize(("n_envs", "train_freq"), [(2, (1, "episode")), (1, (0, "episode")), (2, 0)])
def test_an_impossible_train_freq_is_refused_at_once(n_envs: int, train_freq: Any, make_toy: Any) -> None:
    with pytest.raises(ValueError, match=rf"train_freq must be positive, .* with n_envs={n_envs}"):
        make_model(make_toy(n_envs), train_freq=train_freq)


def test_episodic_training_is_refused_for_a_model_loaded_with_two_environments(
    make_toy: Any, tmp_path: Any
) -> None:
    make_model(make_toy(), train_freq=(1, "episode")).save(tmp_path / "model")
    with pytest.raises(ValueError, match=r"got \(1, 'episode'\) with n_envs=2"):
        SACfD.load(tmp_path / "model", env=make_toy(2))


def test_an_equivariant_actor_is_refused_in_open_loop(monkeypatch: pytest.MonkeyPatch, make_toy: Any) -> None:
    env = make_toy()
    monkeypatch.setattr(type(env.envs[0].unwrapped), "action_ranges", {"theta": (0.0, 3.1)}, raising=False)
    with pytest.raises(ValueError, match=r"policy must be 'MultiInputPolicy' .*got EquivariantPolicy"):
        SACfD("EquivariantPolicy", env)
    SACfD("MultiInputPolicy", env)


def test_a_loaded_model_begins_again_with_demonstrations_of_its_environment(
    make_toy: Any, tmp_path: Any
) -> None:
    make_model(make_toy(), pretrain_steps=4).learn(2).save(tmp_path / "model")
    for steps in (2, 6):
        loaded = SACfD.load(tmp_path / "model", env=make_toy(), pretrain_steps=steps, expert_episodes=3)
        updates = loaded._n_updates
        loaded.learn(1)
        assert loaded.n_pretrained == steps and loaded._n_updates >= updates + steps


def states(model: Any, name: str) -> list[th.Tensor]:
    optimizer = model
    for part in name.split("."):
        optimizer = getattr(optimizer, part)
    return [value for state in optimizer.state.values() for value in state.values()]


def test_expert_data_is_not_saved(make_toy: Any, tmp_path: Any) -> None:
    env = make_toy()
    episodes = list(collect_episodes(make_expert_envs(env)[0][0], 2, seed=0, progress_bar=False))
    model = make_model(env, expert_data=episodes, expert_episodes=0).learn(2)
    model.save(tmp_path / "model")
    assert SACfD.load(tmp_path / "model", env=env).expert_data is None


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"bc_weight": -1}, "bc_weight"),
        ({"expert_episodes": -1}, "expert_episodes"),
        ({"pretrain_steps": -1}, "pretrain_steps"),
        ({"expert_noise": -0.1}, "expert_noise"),
        ({"pretrain_steps": 5, "expert_episodes": 0}, "must be 0 without demonstrations"),
        ({"replay_buffer_class": ReplayBuffer}, "replay_buffer_class must be an ExpertReplayBuffer, got"),
        (
            {"pretrain_steps": 5, "bc_weight": 0},
            "critic_warmup_steps must be None or at least pretrain_steps",
        ),
        ({"n_steps": 0}, "n_steps"),
        ({"expert_q_weight": -1}, "expert_q_weight must not be negative, got -1"),
        ({"bc_limit": 1.5}, "bc_limit must be between 0 and 1, got 1.5"),
        ({"exploration": -0.1}, "exploration"),
        ({"deterministic_fraction": 1.1}, "deterministic_fraction must be between 0 and 1, got 1.1"),
        ({"self_imitation_temperature": 0.0}, "self_imitation_temperature must be None or greater than 0"),
        ({"value_range": (1.0, 0.0)}, "value_range"),
        ({"policy": "NoSuchPolicy"}, "NoSuchPolicy"),
    ],
)
def test_bad_arguments(kwargs: dict[str, Any], message: str, make_toy: Any) -> None:
    with pytest.raises(ValueError, match=message):
        SACfD(**{"policy": StockPolicy, "env": make_toy(), "policy_kwargs": dict(SMALL_STOCK), **kwargs})


def test_learns_to_reach(policy: Any, make_toy: Any) -> None:
    kwargs = {"bc_weight": 10.0, "buffer_size": 1500}
    kwargs |= {"expert_episodes": 20, "pretrain_steps": 60, "learning_rate": 3e-3, "batch_size": 32}
    model = make_model(make_toy(2), policy, **kwargs)
    untrained, _ = evaluate_policy(model, make_toy(seed=9), 30)
    model.learn(100)
    trained, _ = evaluate_policy(model, make_toy(seed=9), 30)
    assert untrained < 0.6
    assert trained >= 0.95
