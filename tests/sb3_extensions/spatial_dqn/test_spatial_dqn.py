"""SpatialDQN, ADET, DQfD and SDQfD, tested like the algorithms of Stable-Baselines3."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.evaluation import evaluate_policy

import bulletarm_gym  # noqa: F401  registers the environments
from sb3_extensions.spatial_dqn import ADET, DQfD, SDQfD, SpatialDQN
from sb3_extensions.spatial_dqn.losses import cross_entropy, large_margin, strict_margin

ALGORITHMS = [SpatialDQN, ADET, DQfD, SDQfD]
ASR, ASR_6D = ("ASRPolicy", "pxyr"), ("EquivariantASRPolicy", "pxyzrrr")


def parameters(module: Any) -> dict[str, np.ndarray]:
    return {name: value.detach().numpy().copy() for name, value in module.named_parameters()}


def assert_equal(first: Any, second: Any) -> None:
    assert first.keys() == second.keys()
    for name, value in first.items():
        np.testing.assert_array_equal(value, second[name], err_msg=name)


def is_on_grid(model: SpatialDQN, actions: np.ndarray) -> bool:
    return np.array_equal(model.codec.snap(actions), actions)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_training_runs(algorithm: Any, case: Any, make_model: Any) -> None:
    model = make_model(case, algorithm, expert_episodes=2).learn(2)
    assert model.num_timesteps == model._n_updates == 2
    assert model.replay_buffer.size() == model.replay_buffer.expert_size + 2
    for name, value in parameters(model.q_net).items():
        assert np.isfinite(value).all(), name
    levels = len(model.q_net.levels) + 1
    logged = [name for name in model.logger.name_to_value if "imitation_loss" in name]
    assert len(logged) == (0 if algorithm is SpatialDQN else levels)
    assert is_on_grid(model, model.replay_buffer.steps("action"))


@pytest.mark.parametrize(
    "kwargs",
    [
        {"train_freq": (1, "episode")},
        {"gradient_steps": -1, "tau": 0.5, "target_update_interval": 1},
        {"n_steps": 2, "augmentation": "rigid_motion"},
        {"expert_episodes": 0, "learning_starts": 4, "batch_size": 1},
        {"pretrain_steps": 2, "expert_episodes": 1},
        {"replay_buffer_kwargs": {"sampler": "prioritized"}},
        {"policy_kwargs": {"optimizer_kwargs": {"weight_decay": 1e-5}, "quantise": "uint16"}},
    ],
)
def test_training_runs_with_options(kwargs: dict[str, Any], make_model: Any) -> None:
    assert make_model(**kwargs).learn(8)._n_updates >= 2


@pytest.mark.parametrize(
    ("env_id", "policy", "sequence"),
    [
        ("BulletArm/OpenLoopBlockStacking-v0", "EquivariantASRPolicy", "pxyr"),
        ("BulletArm/OpenLoopRampBlockStacking-v0", "EquivariantASRPolicy", "pxyzrrr"),
    ],
)
def test_training_runs_in_the_simulator(env_id: str, policy: str, sequence: str, make_model: Any) -> None:
    env = gym.make(env_id, obs_size=32, in_hand_size=12, num_objects=2)
    # As many yaws and tilts as the expert needs to succeed on the grid
    grid = {"num_rotations": 16, "num_heights": 36, "num_tilts": 7}
    model = make_model((policy, sequence), SDQfD, env, {"codec_kwargs": grid}, expert_episodes=1)
    model.learn(3)
    assert model._n_updates == 3
    stored = model.replay_buffer.steps("action")
    assert is_on_grid(model, stored)
    rewards = model.replay_buffer.steps("reward")[: model.replay_buffer.expert_size]
    assert rewards[-1] == 1.0 and rewards[:-1].sum() == 0.0
    env.close()


def test_training_runs_with_several_environments(make_picking: Any, make_model: Any) -> None:
    model = make_model(env=make_picking(3, size=24)).learn(9)
    assert model.num_timesteps == 9 and model._n_updates == 3


def test_training_is_deterministic(make_picking: Any, make_model: Any) -> None:
    kwargs = {"augmentation": "rigid_motion", "exploration_initial_eps": 0.5, "exploration_final_eps": 0.5}
    first, second = (make_model(env=make_picking(2, size=24), **kwargs).learn(8) for _ in range(2))
    assert_equal(parameters(first.policy), parameters(second.policy))
    np.random.seed(1)  # what happened before does not matter
    third = make_model(env=make_picking(2, size=24), **kwargs).learn(8)
    assert_equal(parameters(first.policy), parameters(third.policy))
    other = make_model(env=make_picking(2, size=24), **{**kwargs, "seed": 1}).learn(8)
    assert any(
        (value != parameters(other.policy)[name]).any() for name, value in parameters(first.policy).items()
    )


@pytest.mark.parametrize("which", [ASR, ASR_6D])
def test_loaded_model_equals_the_saved_one(
    which: Any, make_picking: Any, make_model: Any, tmp_path: Path
) -> None:
    kwargs = {"exploration_initial_eps": 0.5, "margin": 0.2, "policy_kwargs": {"quantise": "uint16"}}
    model = make_model(which, DQfD, **kwargs).learn(4)
    env = make_picking(6, seed=3, action_sequence=which[1], size=24)
    observations = env.reset()
    model.save(tmp_path / "model")
    loaded = DQfD.load(tmp_path / "model", env=env, device="cpu")
    np.testing.assert_array_equal(model.predict(observations)[0], loaded.predict(observations)[0])
    assert_equal(parameters(model.policy), parameters(loaded.policy))
    ours, theirs = (m.policy.optimizer.state_dict()["state"] for m in (model, loaded))
    assert ours.keys() == theirs.keys() and len(ours) > 0
    assert all(th.equal(ours[k]["exp_avg"], theirs[k]["exp_avg"]) for k in ours)
    assert loaded.codec.shape == model.codec.shape
    assert loaded.q_net is loaded.policy.q_net and loaded.replay_buffer.image_dtype == "uint16"
    assert loaded.margin == 0.2 and loaded.exploration_rate == model.exploration_rate
    loaded.learn(12)
    assert loaded._n_updates > model._n_updates


def one_update(model: SpatialDQN, **changes: Any) -> Any:
    """One gradient step on one sample, which it returns."""
    assert model.replay_buffer is not None
    sample = model.replay_buffer.sample(8)._replace(**changes)
    model.replay_buffer.sample = lambda *args, **kwargs: sample  # type: ignore[method-assign]
    model.train(1, 8)
    return sample


def huber(error: float) -> float:
    return 0.5 * error**2 if abs(error) < 1 else abs(error) - 0.5


@pytest.mark.parametrize(
    ("algorithm", "which"),
    [*((algorithm, ASR) for algorithm in ALGORITHMS), (SDQfD, ("FCNPolicy", "pxyr")), (SDQfD, ASR_6D)],
)
def test_losses_equal_a_slow_reference(algorithm: Any, which: Any, make_model: Any) -> None:
    """All levels have one target: the value of the greedy action at the last level of the target network."""
    model = make_model(which, algorithm, gamma=0.9, learning_rate=0.05, target_update_interval=2).learn(5)
    rewards = th.tensor([0.0, 3.0, -2.0, 0.5, 1.0, 0.0, 0.0, 0.0])[:, None]  # on both sides of Huber's delta
    dones = th.tensor([1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])[:, None]
    weights = th.linspace(0.1, 1.0, 8)[:, None]
    is_expert = (th.arange(8) % 2 == 0)[:, None]
    network, target = (copy_of(model, name) for name in ("q_net", "q_net_target"))
    assert not all(th.equal(*pair) for pair in zip(network.parameters(), target.parameters(), strict=True))
    sample = one_update(model, rewards=rewards, dones=dones, weights=weights, is_expert=is_expert)
    logged = model.logger.name_to_value

    with th.no_grad():
        view = target.scene_view(sample.next_observations)
        maps, encoding = target.pixel_maps(view)
        chosen, best = [], [maps[k].max().item() for k in range(8)]
        for k in range(8):
            yaw, row, column = np.unravel_index(maps[k].numpy().argmax(), maps[k].shape)
            chosen.append([row, column, yaw][: 2 + (len(maps[k]) > 1)])
        for level in target.levels:
            found = level(view, encoding, th.tensor(np.array(chosen))).numpy()
            for k in range(8):
                chosen[k], best[k] = [*chosen[k], found[k].argmax()], found[k].max()
        np.testing.assert_allclose(sample.discounts, 0.9, rtol=1e-6)
        targets = [rewards[k].item() + (1 - dones[k].item()) * 0.9 * best[k] for k in range(8)]
        indices = th.as_tensor(model.codec.encode(sample.actions.numpy()))
        levels = network.values(sample.observations, indices)
    total = 0.0
    imitation = {ADET: cross_entropy, DQfD: large_margin, SDQfD: strict_margin}.get(algorithm)
    for place, (values, choices) in enumerate(zip(levels, network.choices(indices), strict=True)):
        errors = [values[k, choices[k]].item() - targets[k] for k in range(8)]
        td_loss = np.mean([w * huber(error) for w, error in zip(weights[:, 0].tolist(), errors, strict=True)])
        np.testing.assert_allclose(logged[f"train/td_loss_{place}"], td_loss, rtol=1e-4)
        total += td_loss
        if imitation is not None:
            expected = imitation(values, choices, is_expert[:, 0], place, 0.1).item()
            np.testing.assert_allclose(
                logged[f"train/imitation_loss_{place}"], expected, rtol=1e-4, atol=1e-9
            )
            total += model.imitation_weight * expected
    np.testing.assert_allclose(logged["train/loss"], total, rtol=1e-4)
    last = levels[-1].gather(1, network.choices(indices)[-1][:, None])
    np.testing.assert_allclose(logged["train/value_expert"], last[is_expert].mean(), rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(logged["train/value_online"], last[~is_expert].mean(), rtol=1e-3, atol=1e-6)


def copy_of(model: SpatialDQN, name: str) -> Any:
    network = model.policy.make_q_net()
    network.load_state_dict(getattr(model, name).state_dict())
    return network


def test_target_is_copied_every_target_update_interval(make_model: Any) -> None:
    model = make_model(target_update_interval=3, learning_rate=1e-2).learn(1)
    for update in range(2, 8):
        before = parameters(model.q_net_target)
        model.train(1, 4)
        assert model._n_updates == update
        target = parameters(model.q_net_target)
        assert_equal(target, parameters(model.q_net) if update % 3 == 0 else before)
        moved = [name for name, value in parameters(model.q_net).items() if (value != target[name]).any()]
        assert bool(moved) == (update % 3 != 0)


def test_gradients_are_clipped_by_value(make_model: Any) -> None:
    gradients = []
    for limit in (1e-2, 1e9):
        model = make_model(max_grad_value=limit).learn(1)

        def step(*args: Any, q_net: Any = model.q_net) -> None:
            gradients.append([parameter.grad.clone() for parameter in q_net.parameters()])

        model.policy.optimizer.step = step
        one_update(model, rewards=th.full((8, 1), 50.0))
    [clipped, whole] = gradients
    assert max(gradient.abs().max() for gradient in whole) > 0.1
    for first, second in zip(clipped, whole, strict=True):
        th.testing.assert_close(first, second.clamp(-1e-2, 1e-2))


def test_target_and_sample_have_no_gradient(make_model: Any) -> None:
    model = make_model().learn(2)
    assert all(parameter.grad is None for parameter in model.q_net_target.parameters())


def test_augmented_samples_are_trained_on(make_model: Any) -> None:
    losses = []
    for moves in (False, True):
        model = make_model(augmentation="rigid_motion" if moves else None).learn(1)
        state = model.augmentation_generator.get_state()
        one_update(model)
        losses.append(model.logger.name_to_value["train/loss"])
        assert th.equal(state, model.augmentation_generator.get_state()) != moves
    assert losses[0] != losses[1]


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"imitation_weight": -1.0}, "imitation_weight must not be negative, got -1.0"),
        ({"margin": -0.1}, "margin must not be negative"),
        ({"exploration_fraction": 1.5}, "exploration_fraction must be between 0 and 1, got 1.5"),
        ({"exploration_initial_eps": -0.1}, "exploration_initial_eps must be between 0 and 1"),
        ({"exploration_final_eps": 2.0}, "exploration_final_eps must be between 0 and 1"),
        ({"target_update_interval": 0}, "target_update_interval must be positive, got 0"),
        ({"max_grad_value": 0.0}, "max_grad_value must be positive"),
        ({"augmentation": "rad"}, "augmentation must be .*, got .rad."),
        ({"expert_episodes": -1}, "expert_episodes must not be negative"),
        ({"pretrain_steps": 5, "expert_episodes": 0}, "must be 0 without demonstrations"),
        ({"replay_buffer_class": ReplayBuffer}, "replay_buffer_class must be an ExpertReplayBuffer"),
        ({"replay_buffer_kwargs": {"gamma": 0.9}}, "gamma must be an argument of the algorithm"),
        ({"replay_buffer_kwargs": {"image_dtype": "uint16"}}, "image_dtype='uint16', got quantise='uint8'"),
        ({"replay_buffer_kwargs": {"sampler": "best"}}, "sampler must be None, one of"),
        ({"n_steps": 0}, "n_steps must be at least 1"),
        ({"case": ("ASRPolicy", "pxy")}, "Box of 3 numbers for action_sequence='pxy'"),
        ({"case": ("FCNPolicy", "pxyz")}, r"needs levels for \['z'\]"),
    ],
)
def test_invalid_arguments_are_rejected(
    kwargs: dict[str, Any], message: str, make_picking: Any, make_model: Any
) -> None:
    kwargs = dict(kwargs)
    env = make_picking(action_sequence="pxyz" if kwargs.get("case", ASR)[1] == "pxyz" else "pxyr")
    with pytest.raises(ValueError, match=message):
        make_model(env=env, **kwargs)


def test_environment_without_a_heightmap_is_rejected(make_toy: Any) -> None:
    with pytest.raises(ValueError, match=r"a Dict with a heightmap \(1, size, size\)"):
        kwargs = {"policy_kwargs": {"action_sequence": "pxyzr"}}
        SpatialDQN("FCNPolicy", make_toy(image_only=True), device="cpu", **kwargs)


def test_agent_learns_to_pick_and_place(make_picking: Any, make_model: Any) -> None:
    """From 40 demonstrations, in some two hundred updates."""
    networks = {"channels": [4, 8, 8], "in_hand_channels": [8, 16, 16], "hidden": 32}
    kwargs = {
        "expert_episodes": 40,
        "buffer_size": 500,
        "batch_size": 16,
        "learning_rate": 3e-3,
        "gamma": 0.9,
    }
    kwargs |= {"policy_kwargs": {"network_kwargs": networks}, "pretrain_steps": 160}
    model = make_model(ASR, SDQfD, make_picking(size=24), **kwargs)
    untrained, _ = evaluate_policy(model, make_picking(10, seed=9, size=24), 40)
    model.learn(20)
    trained, _ = evaluate_policy(model, make_picking(10, seed=9, size=24), 40)
    assert untrained < 0.1
    assert trained >= 0.85


@pytest.mark.parametrize(("algorithm", "weight"), [(ADET, 0.01), (DQfD, 0.1), (SDQfD, 0.1)])
def test_each_learner_imitates_with_the_papers_weight(algorithm: Any, weight: float, make_model: Any) -> None:
    assert make_model(algorithm=algorithm).imitation_weight == weight
