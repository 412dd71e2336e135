"""FERM: parameters that each loss trains, momentum encoder, and pretraining."""

import pytest
import torch as th

from sb3_extensions.ferm import FERM
from sb3_extensions.replay.augmentation import RAD


@pytest.fixture
def make_model(make_toy, make_learner):
    """Makes FERM with random crops of 16 pixels: ``make_model(in_hand_size, **kwargs)``."""

    def make(in_hand_size=0, **kwargs):
        env = make_toy(size=18, in_hand_size=in_hand_size)
        model = make_learner(env, FERM, augmentation=RAD(16), **kwargs)
        assert isinstance(model, FERM)
        return model

    return make


def changed(before, after):
    """Return the parts of the policy, such as ``critic.features_extractor.encoder``, that differ."""
    names = {name for name, value in after.items() if not th.equal(value, before[name])}
    return {".".join(name.split(".")[: 3 if "features_extractor" in name else 1]) for name in names}


def state(model):
    return {name: value.clone() for name, value in model.policy.state_dict().items()}


def steps(optimizer):
    """Return the numbers of steps of the parameters of an Adam optimizer."""
    parameters = [p for group in optimizer.param_groups for p in group["params"]]
    assert len(set(parameters)) == len(parameters)
    return {int(optimizer.state[p]["step"]) if p in optimizer.state else 0 for p in parameters}


@pytest.mark.parametrize("in_hand_size", [0, 8])
def test_each_loss_trains_its_parameters_only(in_hand_size, make_model):
    model = make_model(in_hand_size).learn(2)
    assert model.actor.features_extractor.projection is not model.critic.features_extractor.projection
    sample = model.replay_buffer.sample(16)
    actions, log_prob = model.actor.action_log_prob(sample.observations)
    values = th.cat(model.critic(sample.observations, sample.actions))
    parts = ("encoder", "small_images") if in_hand_size else ("encoder",)
    extractor = model.critic.features_extractor
    encoder = {parameter for part in parts for parameter in getattr(extractor, part).parameters()}
    losses = {
        "actor": (actions.square().sum() + log_prob.sum(), set(model.actor.parameters()) - encoder),
        "critic": (values.sum(), set(model.critic.parameters())),
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


def test_contrastive_loss_is_info_nce_of_two_views_by_critic_and_target(make_model):
    model = make_model().learn(2)
    observations = model.replay_buffer.sample(16).observations
    generator = th.Generator().set_state(model.augmentation_generator.get_state())
    views = [model.augmentation.view(observations, generator) for _ in range(2)]
    assert not th.equal(views[0]["heightmap"], views[1]["heightmap"])
    with th.no_grad():
        queries = model.critic.features_extractor(views[0]).double()
        keys = model.critic_target.features_extractor(views[1]).double()
        likeness = th.exp(queries @ model.contrast.weight.double() @ keys.T)
        expected = -th.log(likeness.diag() / likeness.sum(dim=1)).mean().item()
    assert model._update_encoder(observations)["contrastive_loss"].item() == pytest.approx(expected, rel=1e-4)


def test_target_extractor_follows_faster_than_the_heads(make_model):
    model = make_model(encoder_tau=0.3, tau=0.1).learn(2)
    before = {name: value.clone() for name, value in model.critic_target.named_parameters()}
    model.train(1, 16)
    critic = dict(model.critic.named_parameters())
    for name, value in model.critic_target.named_parameters():
        tau = 0.3 if name.startswith("features_extractor.") else 0.1
        th.testing.assert_close(value, (1 - tau) * before[name] + tau * critic[name])
        assert not th.equal(critic[name], before[name]), name


def test_pretraining_updates_each_parameter_once_per_step(make_model, tmp_path):
    model = make_model(contrastive_steps=7, learning_starts=100)
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
    model.save(tmp_path / "model")
    loaded = FERM.load(tmp_path / "model", env=model.get_env(), device="cpu")
    assert loaded.actor.features_extractor.encoder is loaded.critic.features_extractor.encoder
    loaded.learn(2)  # demonstrations and the pretraining of the encoder begin again
    assert steps(loaded.contrast.optimizer) == {11 + 7}


@pytest.mark.parametrize(("kwargs", "pretrained"), [({"expert_episodes": 0}, 0), ({"bc_weight": 0.0}, 3)])
def test_without_demonstrations_or_imitation(kwargs, pretrained, make_model):
    model = make_model(learning_starts=5, **kwargs).learn(10)
    assert steps(model.contrast.optimizer) == {pretrained + model._n_updates} != {pretrained}


def test_the_papers_networks(make_toy):
    model = FERM("MultiInputPolicy", make_toy(size=142), buffer_size=10, device="cpu")
    extractor = model.critic.features_extractor
    convolutions = [layer for layer in extractor.encoder.layers if isinstance(layer, th.nn.Conv2d)]
    assert [layer.out_channels for layer in convolutions] == [16, 32, 64, 128, 256, 256, 1024]
    assert (extractor.stack.size, extractor.features_dim) == (128, 50)
    assert (model.contrastive_steps, model.encoder_tau) == (1600, 0.05)
    heads = [layer for layer in model.critic.q_networks[0] if isinstance(layer, th.nn.Linear)]
    assert [(head.in_features, head.out_features) for head in heads] == [(55, 1024), (1024, 1024), (1024, 1)]
