"""SpatialDQN, ADET, DQfD and SDQfD: training, losses, actions on the grid, and files."""

import math
from functools import partial

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_extensions.common.checkpoint import DirectoryCheckpointCallback, resume
from sb3_extensions.demonstrations.collection import collect_episodes
from sb3_extensions.demonstrations.expert_envs import make_expert_envs
from sb3_extensions.spatial_dqn import ADET, DQfD, SDQfD, SpatialDQN
from sb3_extensions.spatial_dqn.codec import EXPLORED_HEIGHT, explore_on_grid
from sb3_extensions.spatial_dqn.losses import cross_entropy, large_margin, strict_margin

MARGIN = 0.125  # exact in binary, as are the multiples of it that make ties
BATCH, CHOICES = 12, 7


def slow_strict_margin(row, chosen, level):
    above = [q - row[chosen] + MARGIN for a, q in enumerate(row) if a != chosen and q > row[chosen] - MARGIN]
    return float(np.mean(above)) if above else 0.0


def slow_large_margin(row, chosen, level):
    return float(max(q + MARGIN * (a != chosen) for a, q in enumerate(row)) - row[chosen])


def slow_cross_entropy(row, chosen, level):
    logits = (100.0 if level == 0 else 1.0) * row
    return float(logits.max() + math.log(np.exp(logits - logits.max()).sum()) - logits[chosen])


each_loss = pytest.mark.parametrize(
    ("loss", "slow", "mean_of_all"),
    [
        (partial(strict_margin, margin=MARGIN), slow_strict_margin, True),
        (partial(large_margin, margin=MARGIN), slow_large_margin, False),
        (cross_entropy, slow_cross_entropy, False),
    ],
    ids=["sdqfd", "dqfd", "adet"],
)


def make_batch(kind):
    """Values (float64), choices, and whether they are the expert's."""
    generator = th.Generator().manual_seed(0)
    values = th.randn(BATCH, CHOICES, generator=generator, dtype=th.float64) * 0.2
    choices = th.randint(CHOICES, (BATCH,), generator=generator)
    if kind == "ties":
        values = (values / MARGIN).round() * MARGIN
    elif kind == "best already":
        values.scatter_(1, choices[:, None], 5.0)
    return values, choices, (th.arange(BATCH) % 3 != 0) & (kind != "no expert")


@each_loss
@pytest.mark.parametrize("kind", ["random", "ties", "best already", "no expert"])
@pytest.mark.parametrize("level", [0, 1, 4])
def test_losses_equal_slow_references(loss, slow, mean_of_all, kind, level):
    values, choices, is_expert = make_batch(kind)
    rows = zip(values.numpy(), choices.tolist(), is_expert.tolist(), strict=True)
    terms = [slow(row, chosen, level) for row, chosen, expert in rows if expert]
    expected = sum(terms) / (BATCH if mean_of_all else max(len(terms), 1))
    found = loss(values, choices, is_expert, level)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)
    assert (expected > 0.01) == (kind == "random") or kind in ("ties", "best already")
    assert loss(values.float(), choices, is_expert, level).dtype == th.float32


@each_loss
def test_gradients_of_extreme_values_are_finite(loss, slow, mean_of_all):
    extreme = th.tensor([[1e4, -1e4, 0.0]], requires_grad=True)
    result = loss(extreme, th.tensor([1]), th.tensor([True]), 0)
    [gradient] = th.autograd.grad(result, extreme)
    assert result.isfinite() and gradient.isfinite().all()


# Their imitation losses, and their weights in the paper
ALGORITHMS = {
    SpatialDQN: (None, None),
    ADET: (cross_entropy, 0.01),
    DQfD: (large_margin, 0.1),
    SDQfD: (strict_margin, 0.1),
}
ASR, ASR_6D = ("ASRPolicy", "pxyr"), ("EquivariantASRPolicy", "pxyzrrr")


def parameters(module):
    return np.concatenate([value.detach().numpy().flatten() for value in module.parameters()])


def is_on_grid(model, actions):
    return np.array_equal(model.codec.snap(actions), actions)


@pytest.mark.parametrize(
    "kwargs",
    [
        {"exploration_initial_eps": 0.5, "exploration_final_eps": 0.2, "augmentation": "rigid_motion"},
        {"case": ("ASRPolicy", "pxyzrrr"), "replay_buffer_kwargs": {"sampler": "prioritized"}},
    ],
)
def test_training_is_deterministic_and_can_be_resumed(kwargs, make_picking, make_model, tmp_path):
    def make_env(seed):
        return make_picking(2, seed, size=24, action_sequence=kwargs.get("case", ASR)[1])

    def make():
        return make_model(env=make_env(0), target_update_interval=3, **kwargs)

    whole = make().learn(26)
    np.random.seed(1)  # global generators have no effect
    saving = make().learn(26, callback=DirectoryCheckpointCallback(14, tmp_path))
    env = make_env(123)
    resumed = resume(min(tmp_path.iterdir()), env, device="cpu")
    assert env.get_attr("steps") != [0, 0]  # mid-episode
    resumed.learn(12, reset_num_timesteps=False)
    for model in (saving, resumed):
        assert (whole._n_updates, whole.exploration_rate) == (model._n_updates, model.exploration_rate)
        np.testing.assert_array_equal(parameters(whole.policy), parameters(model.policy))
    samples = [model.replay_buffer.sample(50).indices for model in (whole, resumed)]
    np.testing.assert_array_equal(*samples)


def one_update(model, **changes):
    """One gradient step on one sample, which it returns."""
    sample = model.replay_buffer.sample(8)._replace(**changes)
    model.replay_buffer.sample = lambda *args, **kwargs: sample
    model.train(1, 8)
    return sample


def huber(error):
    return 0.5 * error**2 if abs(error) < 1 else abs(error) - 0.5


def copy_of(model, name):
    network = model.policy.make_q_net()
    network.load_state_dict(getattr(model, name).state_dict())
    return network


@pytest.mark.parametrize(
    ("algorithm", "which"),
    [*((algorithm, ASR) for algorithm in ALGORITHMS), (SDQfD, ("RotFCNPolicy", "pxyr")), (SDQfD, ASR_6D)],
)
def test_losses_equal_a_slow_reference(algorithm, which, make_model):
    """All levels have one target: the value of the greedy action at the last level of the target network."""
    model = make_model(which, algorithm, gamma=0.9, learning_rate=0.05, target_update_interval=2).learn(5)
    rewards = th.tensor([0.0, 3.0, -2.0, 0.5, 1.0, 0.0, 0.0, 0.0])[:, None]  # on both sides of Huber's delta
    dones = th.tensor([1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])[:, None]
    weights = th.linspace(0.1, 1.0, 8)[:, None]
    is_expert = (th.arange(8) % 2 == 0)[:, None]
    network, target = (copy_of(model, name) for name in ("q_net", "q_net_target"))
    assert not all(th.equal(*pair) for pair in zip(network.parameters(), target.parameters(), strict=True))
    sample = one_update(model, rewards=rewards, dones=dones, weights=weights, is_expert=is_expert)

    best = target.greedy(sample.next_observations)[1].tolist()
    np.testing.assert_allclose(sample.discounts, 0.9, rtol=1e-6)
    targets = [rewards[k].item() + (1 - dones[k].item()) * 0.9 * best[k] for k in range(8)]
    with th.no_grad():
        indices = th.as_tensor(model.codec.encode(sample.actions.numpy()))
        levels = network.values(sample.observations, indices)
    expected = {"loss": 0.0}
    imitation, weight = ALGORITHMS[algorithm]
    for place, (values, choices) in enumerate(zip(levels, network.choices(indices), strict=True)):
        errors = [values[k, choices[k]].item() - targets[k] for k in range(8)]
        td_loss = np.mean([w * huber(error) for w, error in zip(weights[:, 0].tolist(), errors, strict=True)])
        expected[f"td_loss_{place}"] = td_loss
        expected["loss"] += td_loss
        if imitation is not None:
            term = imitation(values, choices, is_expert[:, 0], place, 0.1).item()
            expected[f"imitation_loss_{place}"] = term
            expected["loss"] += weight * term
    last = levels[-1].gather(1, network.choices(indices)[-1][:, None])
    expected |= {"value_expert": last[is_expert].mean(), "value_online": last[~is_expert].mean()}
    logged = model.logger.name_to_value
    for name, value in expected.items():
        np.testing.assert_allclose(logged[f"train/{name}"], value, rtol=1e-3, atol=1e-6, err_msg=name)
    assert any("imitation" in name for name in logged) == (imitation is not None)


def test_target_is_copied_every_target_update_interval(make_model):
    model = make_model(target_update_interval=3, learning_rate=1e-2).learn(1)
    for update in range(2, 8):
        before = parameters(model.q_net_target)
        model.train(1, 4)
        online, target = parameters(model.q_net), parameters(model.q_net_target)
        np.testing.assert_array_equal(target, online if update % 3 == 0 else before)
        assert np.array_equal(online, target) == (update % 3 == 0)


def test_gradients_are_clipped_by_value(make_model, monkeypatch):
    gradients = []
    for limit in (1e-2, 1e9):
        model = make_model(max_grad_value=limit).learn(1)
        monkeypatch.setattr(model.policy.optimizer, "step", lambda *args: None)
        one_update(model, rewards=th.full((8, 1), 50.0))
        gradients.append([parameter.grad.clone() for parameter in model.q_net.parameters()])
    [clipped, whole] = gradients
    assert max(gradient.abs().max() for gradient in whole) > 0.1
    for first, second in zip(clipped, whole, strict=True):
        th.testing.assert_close(first, second.clamp(-1e-2, 1e-2))


def test_augmented_samples_are_trained_on(make_model):
    losses = []
    for augmentation in (None, "rigid_motion"):
        model = make_model(augmentation=augmentation).learn(1)
        one_update(model)
        losses.append(model.logger.name_to_value["train/loss"])
    assert losses[0] != losses[1]


def test_half_of_a_batch_are_demonstrations_once_these_are_as_many(make_picking, make_model, tmp_path):
    """Also for a loaded model with another batch size."""
    model = make_model(batch_size=4)
    sampler = model.replay_buffer.sampler
    assert (sampler.expert_fraction, sampler.balanced_from) == (0.5, 2)
    model.save(tmp_path / "model")
    loaded = SDQfD.load(tmp_path / "model", env=make_picking(size=24), device="cpu", batch_size=32)
    assert loaded.replay_buffer.sampler.balanced_from == 16


def test_exploration_stays_on_the_grid(make_picking, make_model):
    """In an action space from 2 to 5; the first 40 steps are random, half of the others."""
    env = make_picking(2, size=24, low=2.0, high=5.0)
    kwargs = {"expert_episodes": 0, "learning_starts": 40, "gradient_steps": 0}
    kwargs |= {"exploration_initial_eps": 0.5, "exploration_final_eps": 0.5}
    model = make_model(env=env, **kwargs).learn(80)
    buffer, codec = model.replay_buffer, model.codec
    valid = np.flatnonzero(buffer.table.columns["valid"])
    sample = buffer._get_samples(valid)
    observations = {key: value.numpy() for key, value in sample.observations.items()}
    stored = sample.actions.numpy()
    assert len(stored) == 80 and is_on_grid(model, stored)
    np.testing.assert_array_equal(codec.places(stored), observations["holding"][:, 0] > 0.5)
    scaled = 2 * (model.predict(observations)[0] - 2.0) / 3.0 - 1
    is_greedy = np.isclose(scaled, stored, atol=1e-5).all(axis=1).reshape(2, 40)  # of each environment
    assert is_greedy[:, :20].mean() < 0.1 and 0.25 < is_greedy[:, 20:].mean() < 0.75
    assert set(codec.encode(stored)[:20, 2]) == {0, 1, 2, 3}


def test_random_actions_are_at_objects():
    heights = np.zeros((600, 8, 8), np.float32)
    heights[:300, 2, 3:5] = 2 * EXPLORED_HEIGHT
    heights[:300, 6, 6] = 0.5 * EXPLORED_HEIGHT
    greedy = np.full((600, 4), 7)
    shape, generator = (8, 8, 3, 5), th.Generator().manual_seed(0)
    explored = explore_on_grid(greedy, heights, 0.5, shape, generator)
    assert explored.dtype == np.int64 and isinstance(explored, np.ndarray)
    changed = (explored[:, 2] != 7) | (explored[:, 3] != 7)
    np.testing.assert_allclose(changed.mean(), 0.5, atol=0.06)
    assert (explored[~changed] == 7).all()
    found = explored[:300][changed[:300]]
    assert {tuple(pixel) for pixel in found[:, :2].tolist()} == {(2, 3), (2, 4)}
    assert len(np.unique(explored[300:][changed[300:], :2], axis=0)) > 50  # nothing stands: anywhere
    for place, count in ((2, 3), (3, 5)):
        assert set(explored[changed, place]) == set(range(count))
    np.testing.assert_array_equal(explore_on_grid(greedy, heights, 0.0, shape, generator), greedy)


def test_exploration_rate_decreases(make_model):
    rates = []
    kwargs = {"exploration_initial_eps": 1.0, "exploration_final_eps": 0.2, "exploration_fraction": 0.5}
    model = make_model(gradient_steps=0, **kwargs)
    model.learn(10, callback=lambda *args: rates.append(model.exploration_rate) or True)
    np.testing.assert_allclose(rates, [0.0, 0.84, 0.68, 0.52, 0.36, *[0.2] * 5], atol=1e-9)


def test_demonstrations_are_executed_on_the_grid(make_picking, make_model):
    """Where they fail so, they are not kept: two yaws are too few for some bars."""
    few = {"codec_kwargs": {"num_rotations": 2, "num_heights": 4, "num_tilts": 3}}
    env = make_picking(size=24, max_steps=2, low=2.0, high=5.0)
    model = make_model(env=env, policy_kwargs=few, expert_episodes=6, gradient_steps=0).learn(1)
    assert model.replay_buffer.expert_size == 12
    assert is_on_grid(model, model.replay_buffer.steps("action")[:12])
    for name in ("reward", "done"):
        assert model.replay_buffer.steps(name)[:12].tolist() == [0.0, 1.0] * 6


def test_expert_data_is_snapped_to_the_grid(make_picking, make_model):
    env = make_picking(size=24, low=2.0, high=5.0)
    episodes = list(collect_episodes(make_expert_envs(env)[0][0], 3, seed=0, progress_bar=False))
    model = make_model(env=env, expert_data=iter(episodes), gradient_steps=0).learn(1)
    stored = model.replay_buffer.steps("action")[: model.replay_buffer.expert_size]
    given = 2 * (np.concatenate([episode.actions for episode in episodes]) - 2.0) / 3.0 - 1
    assert is_on_grid(model, stored) and not is_on_grid(model, given)
    np.testing.assert_allclose(stored, model.codec.snap(given), atol=1e-6)


@pytest.mark.parametrize(
    ("kwargs", "named"),
    [
        ({"imitation_weight": -1.0}, "imitation_weight .* got -1.0"),
        ({"exploration_fraction": 1.5}, "exploration_fraction .* got 1.5"),
        ({"target_update_interval": 0}, "target_update_interval .* got 0"),
        ({"max_grad_value": 0.0}, "max_grad_value"),
        ({"augmentation": "rad"}, "augmentation .*, got .rad."),
    ],
)
def test_invalid_arguments_are_rejected(kwargs, named, make_model):
    with pytest.raises(ValueError, match=named):
        make_model(**kwargs)


def test_agent_learns_to_pick_and_place(make_picking, make_model):
    """From 40 demonstrations, in some hundred updates."""
    networks = {"channels": [4, 8, 8], "in_hand_channels": [8, 16, 16], "hidden": 32, "output_gain": 0.01}
    kwargs = {"expert_episodes": 40, "buffer_size": 500, "batch_size": 16, "learning_rate": 3e-3}
    kwargs |= {"gamma": 0.9, "policy_kwargs": {"network_kwargs": networks}, "pretrain_steps": 100}
    model = make_model(ASR, SDQfD, make_picking(size=24), **kwargs)
    untrained, _ = evaluate_policy(model, make_picking(10, seed=9, size=24), 40)
    model.learn(10)
    trained, _ = evaluate_policy(model, make_picking(10, seed=9, size=24), 40)
    assert untrained < 0.1
    assert trained >= 0.85
