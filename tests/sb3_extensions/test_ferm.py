"""FERM: parameters that each loss trains, momentum encoder, and pretraining."""

from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import Logger

from sb3_extensions.common.checkpoint import resume, save_checkpoint
from sb3_extensions.encoders.extractors import CnnExtractor
from sb3_extensions.ferm import FERM
from sb3_extensions.ferm.policies import BilinearContrast
from sb3_extensions.replay.augmentation import RAD, DrQ
from sb3_extensions.sacfd import SACfD
from sb3_extensions.sacfd.policies import MultiInputPolicy as SacfdPolicy

SIDE, CROP = 18, 16
SMALL = {"features_extractor_kwargs": {"channels": [4, 8, 8], "features_dim": 6}, "net_arch": [16]}


def make_model(env: Any, **kwargs: Any) -> FERM:
    defaults: dict[str, Any] = {
        "augmentation": RAD(CROP),
        "contrastive_steps": 3,
        "expert_episodes": 5,
        "batch_size": 16,
        "buffer_size": 500,
        "policy_kwargs": SMALL,
        "seed": 0,
        "device": "cpu",
    }
    return FERM("MultiInputPolicy", env, **{**defaults, **kwargs})


def values(parameters: Iterable[th.Tensor]) -> list[np.ndarray]:
    return [parameter.detach().numpy().copy() for parameter in parameters]


def changed(before: dict[str, th.Tensor], after: dict[str, th.Tensor]) -> set[str]:
    """Return the parts of the policy, such as ``critic.features_extractor.encoder``, that differ."""
    names = {name for name, value in after.items() if not th.equal(value, before[name])}
    return {".".join(name.split(".")[: 3 if "features_extractor" in name else 1]) for name in names}


def state(model: FERM) -> dict[str, th.Tensor]:
    return {name: value.clone() for name, value in model.policy.state_dict().items()}


def steps(optimizer: th.optim.Optimizer) -> set[int]:
    """Return the numbers of steps of the parameters of an Adam optimizer."""
    parameters = [p for group in optimizer.param_groups for p in group["params"]]
    assert len(set(parameters)) == len(parameters)
    return {int(optimizer.state[p]["step"]) if p in optimizer.state else 0 for p in parameters}


def test_loss_is_info_nce() -> None:
    th.manual_seed(0)
    contrast, queries, keys = BilinearContrast(3), th.randn(5, 3), th.randn(5, 3)
    q, w, k = queries.numpy(), contrast.weight.detach().numpy(), keys.numpy()
    expected = 0.0
    for i in range(5):
        likeness = [sum(q[i, a] * w[a, b] * k[j, b] for a in range(3) for b in range(3)) for j in range(5)]
        expected -= np.log(np.exp(likeness[i]) / sum(np.exp(value) for value in likeness)) / 5
    assert contrast(queries, keys).item() == pytest.approx(expected, rel=1e-5)


def test_actor_and_critic_share_convolutions_alone(make_toy: Any) -> None:
    model = make_model(make_toy(size=SIDE))
    actor, critic, target = (
        net.features_extractor for net in (model.actor, model.critic, model.critic_target)
    )
    assert actor.encoder is critic.encoder is not target.encoder
    assert actor.projection is not critic.projection
    for a, b in zip(values(critic.parameters()), values(target.parameters()), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("in_hand_size", [0, 8])
def test_each_loss_trains_its_parameters_only(in_hand_size: int, make_toy: Any) -> None:
    model = make_model(make_toy(size=SIDE, in_hand_size=in_hand_size)).learn(2)
    sample = model.replay_buffer.sample(16)
    actions, log_prob = model.actor.action_log_prob(sample.observations)
    parts = ("encoder", "small_images") if in_hand_size else ("encoder",)
    extractor = model.critic.features_extractor
    encoder = {parameter for part in parts for parameter in getattr(extractor, part).parameters()}
    losses = {
        "actor": (actions.square().sum() + log_prob.sum(), set(model.actor.parameters()) - encoder),
        "critic": (
            th.cat(model.critic(sample.observations, sample.actions)).sum(),
            set(model.critic.parameters()),
        ),
    }
    for name, (loss, expected) in losses.items():
        model.policy.zero_grad(set_to_none=True)
        loss.backward()
        assert {p for p in model.policy.parameters() if p.grad is not None} == expected, name
        optimizer = getattr(model, name).optimizer
        assert {p for group in optimizer.param_groups for p in group["params"]} == expected, name
    before = state(model)
    model._update_encoder(sample.observations)
    shared = {f"{network}.features_extractor.{part}" for network in ("actor", "critic") for part in parts}
    assert changed(before, state(model)) == {*shared, "critic.features_extractor.projection", "contrast"}


def test_contrastive_loss_compares_two_views_by_critic_and_target(make_toy: Any) -> None:
    model = make_model(make_toy(size=SIDE)).learn(2)
    observations = model.replay_buffer.sample(16).observations
    generator = th.Generator().set_state(model.augmentation_generator.get_state())
    views = [model.augmentation.view(observations, generator) for _ in range(2)]
    assert not th.equal(views[0]["heightmap"], views[1]["heightmap"])
    with th.no_grad():
        queries = model.critic.features_extractor(views[0])
        keys = model.critic_target.features_extractor(views[1])
        expected = model.contrast(queries, keys)
    assert th.equal(model._update_encoder(observations)["contrastive_loss"], expected)


def test_target_extractor_follows_faster_than_the_heads(make_toy: Any) -> None:
    model = make_model(make_toy(size=SIDE), encoder_tau=0.3, tau=0.1).learn(2)
    before = {name: value.clone() for name, value in model.critic_target.named_parameters()}
    model.train(1, 16)
    critic = dict(model.critic.named_parameters())
    for name, value in model.critic_target.named_parameters():
        tau = 0.3 if name.startswith("features_extractor.") else 0.1
        th.testing.assert_close(value, (1 - tau) * before[name] + tau * critic[name])
        assert not th.equal(critic[name], before[name]), name


def test_pretraining_updates_each_parameter_once_per_step(make_toy: Any) -> None:
    model = make_model(make_toy(size=SIDE), contrastive_steps=7, learning_starts=100)
    initial = state(model)
    model.learn(2)
    assert steps(model.contrast.optimizer) == {7} and model._n_updates == 0
    trained = {f"{net}.features_extractor.encoder" for net in ("actor", "critic", "critic_target")}
    trained |= {f"{net}.features_extractor.projection" for net in ("critic", "critic_target")}
    assert changed(initial, state(model)) == {*trained, "contrast"}
    model.learn(3, reset_num_timesteps=False)
    assert steps(model.contrast.optimizer) == {7}  # not again
    model.train(4, 16)
    assert steps(model.contrast.optimizer) == {11}
    assert steps(model.critic.optimizer) == steps(model.actor.optimizer) == {4}


def test_pretraining_reduces_the_contrastive_loss(make_toy: Any) -> None:
    losses = []
    for contrastive_steps in (0, 60):
        env = make_toy(size=SIDE)
        kwargs = {"expert_episodes": 20, "learning_starts": 100, "learning_rate": 3e-3}
        model = make_model(env, contrastive_steps=contrastive_steps, **kwargs).learn(1)
        losses.append(model._update_encoder(model.replay_buffer.sample(64).observations)["contrastive_loss"])
    assert losses[0] > np.log(64) - 1.5  # chance: log(batch)
    assert losses[1] < 0.7 * losses[0]


@pytest.mark.parametrize("kwargs", [{"expert_episodes": 0}, {"bc_weight": 0.0}])
def test_without_demonstrations_or_imitation(kwargs: dict[str, Any], make_toy: Any) -> None:
    model = make_model(make_toy(size=SIDE), learning_starts=5, **kwargs).learn(10)
    pretrained = 0 if kwargs == {"expert_episodes": 0} else 3
    assert steps(model.contrast.optimizer) == {pretrained + model._n_updates} != {pretrained}


@pytest.mark.parametrize(("augmentation", "side"), [(RAD(CROP), SIDE), (DrQ(pad=1), 16)])
def test_run_save_and_load(augmentation: Any, side: int, make_toy: Any, tmp_path: Any) -> None:
    env = make_toy(2, size=side)
    model = make_model(env, augmentation=augmentation, n_steps=2).learn(8)
    model.save(tmp_path / "model")
    loaded = FERM.load(tmp_path / "model", env=env, device="cpu")
    for name, value in state(model).items():
        assert th.equal(value, loaded.policy.state_dict()[name]), name
    assert loaded.actor.features_extractor.encoder is loaded.critic.features_extractor.encoder
    assert steps(loaded.contrast.optimizer) == steps(model.contrast.optimizer) == {3 + 4}
    assert (loaded.contrastive_steps, loaded.encoder_tau) == (3, 0.05)
    observation = env.reset()
    actions = [m.predict(observation, deterministic=True)[0] for m in (model, loaded)]
    np.testing.assert_array_equal(*actions)
    loaded.learn(2)  # demonstrations and the pretraining of the encoder begin again
    assert steps(loaded.contrast.optimizer) == {3 + 4 + 3 + 1}


def test_resumed_run_equals_uninterrupted_run(make_toy: Any, tmp_path: Any) -> None:
    whole = make_model(make_toy(2, size=SIDE)).learn(20)
    save_checkpoint(make_model(make_toy(2, size=SIDE)).learn(12), tmp_path)
    th.manual_seed(9)
    resumed = resume(tmp_path, make_toy(2, seed=5, size=SIDE), device="cpu")
    resumed.learn(8, reset_num_timesteps=False)
    for name, value in state(whole).items():
        assert th.equal(value, resumed.policy.state_dict()[name]), name
    assert steps(whole.contrast.optimizer) == steps(resumed.contrast.optimizer) == {3 + 10}


def test_policy_acts_on_the_centre_of_an_image(make_toy: Any) -> None:
    env = make_toy(3, size=SIDE)
    model = make_model(env)
    observation = env.reset()
    border = {**observation, "heightmap": np.full_like(observation["heightmap"], 0.2)}
    border["heightmap"][..., 1:17, 1:17] = observation["heightmap"][..., 1:17, 1:17]
    assert not np.array_equal(border["heightmap"], observation["heightmap"])
    actions = [model.predict(each, deterministic=True)[0] for each in (observation, border)]
    np.testing.assert_array_equal(*actions)


def test_the_papers_networks(make_toy: Any) -> None:
    model = FERM("MultiInputPolicy", make_toy(size=142), buffer_size=10, device="cpu")
    extractor = model.critic.features_extractor
    convolutions = [layer for layer in extractor.encoder.layers if isinstance(layer, th.nn.Conv2d)]
    assert [layer.out_channels for layer in convolutions] == [16, 32, 64, 128, 256, 256, 1024]
    assert (extractor.stack.size, extractor.features_dim) == (128, 50)
    assert (model.contrastive_steps, model.encoder_tau) == (1600, 0.05)
    heads = [layer for layer in model.critic.q_networks[0] if isinstance(layer, th.nn.Linear)]
    assert [(head.in_features, head.out_features) for head in heads] == [(55, 1024), (1024, 1024), (1024, 1)]


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"augmentation": None}, "augmentation must have 'rad' or 'drq', got None"),
        ({"contrastive_steps": -1}, "contrastive_steps must not be negative, got -1"),
        ({"encoder_tau": 0.0}, "encoder_tau must be greater than 0 and at most 1, got 0.0"),
        ({"policy": SacfdPolicy}, "policy must be FERM's MultiInputPolicy"),
        ({"policy_kwargs": {"share_features_extractor": True}}, "share_features_extractor"),
        ({"policy_kwargs": {"features_extractor_class": CnnExtractor}}, "ContrastiveExtractor"),
    ],
)
def test_bad_arguments(kwargs: dict[str, Any], message: str, make_toy: Any) -> None:
    arguments = {"policy": "MultiInputPolicy", "augmentation": RAD(CROP), **kwargs}
    with pytest.raises(ValueError, match=message):
        FERM(env=make_toy(size=SIDE), **arguments)


def test_learns_to_reach(make_toy: Any) -> None:
    policy_kwargs = {"features_extractor_kwargs": {"channels": [8, 16, 32]}, "net_arch": [32]}
    kwargs: dict[str, Any] = {"policy_kwargs": policy_kwargs, "batch_size": 32, "learning_rate": 3e-3}
    kwargs |= {"expert_episodes": 20, "contrastive_steps": 50, "bc_weight": 10.0, "pretrain_steps": 80}
    reached = []
    for seed in range(3):  # so short a training differs from seed to seed
        model = make_model(make_toy(2, size=SIDE), seed=seed, **kwargs)
        untrained, _ = evaluate_policy(model, make_toy(seed=9, size=SIDE), 30)
        assert untrained < 0.6
        model.learn(80)
        trained, _ = evaluate_policy(model, make_toy(seed=9, size=SIDE), 30)
        reached.append(trained)
    assert np.mean(reached) >= 0.9


@pytest.mark.parametrize("algorithm", [SACfD, FERM])
def test_runs_are_named_after_their_class(
    algorithm: Any, make_toy: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = []

    def configure(verbose: int, folder: Any, name: str, reset: bool) -> Logger:
        names.append(name)
        return Logger(None, [])

    monkeypatch.setattr("stable_baselines3.common.utils.configure_logger", configure)
    kwargs: dict[str, Any] = {"features_extractor_kwargs": {"channels": [4, 8, 8]}, "net_arch": [8]}
    env = make_toy(size=SIDE)
    model = algorithm(
        "MultiInputPolicy", env, augmentation=RAD(CROP), expert_episodes=0, policy_kwargs=kwargs
    )
    model.learn(1)
    assert names == [algorithm.__name__]
