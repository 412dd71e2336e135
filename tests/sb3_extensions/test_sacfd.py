"""SACfD: losses, imitation and pretraining, compared with slow references; the encoder of FERM."""

import numpy as np
import pytest
import torch as th
from sb3_contrib import TQC
from stable_baselines3 import SAC

from sb3_extensions.demonstrations.dagger import DaggerCallback
from sb3_extensions.ferm import FERM
from sb3_extensions.replay.augmentation import RAD
from sb3_extensions.replay.buffer import ExpertReplayBuffer
from sb3_extensions.sacfd import SACfD
from sb3_extensions.tqcfd import TQCfD


def parameters(model):
    module = getattr(model, "policy", model)
    return {name: value.numpy().copy() for name, value in module.state_dict().items()}


def moved(before, after):
    """Return the networks of the policy whose parameters differ."""
    return {name.split(".")[0] for name in after if not np.array_equal(after[name], before[name])}


def copies(model):
    """Return copies of the actor, the critic and the target of the critic."""
    policy = type(model.policy)(
        model.observation_space, model.action_space, lambda _: 0.0, **model.policy_kwargs
    )
    policy.load_state_dict(model.policy.state_dict())
    return [policy.actor, policy.critic, policy.critic_target]


@pytest.mark.parametrize(("learner", "stock"), [(SACfD, SAC), (TQCfD, TQC)])
def test_without_imitation_it_is_the_stock_algorithm(learner, stock, make_toy):
    """But for the actor's loss, which uses the critic before its step: equal with a constant critic."""
    kwargs = {"learning_rate": 1e-3, "buffer_size": 500, "learning_starts": 10, "tau": 0.02}
    kwargs |= {"batch_size": 16, "gamma": 0.9, "ent_coef": "auto_0.01", "seed": 0, "device": "cpu"}
    kwargs |= {"policy_kwargs": {"net_arch": [16]}, "policy": stock.policy_aliases["MultiInputPolicy"]}
    if stock is TQC:
        kwargs["top_quantiles_to_drop_per_net"] = 3
    # All targets bootstrap: SACfD draws no noise for the others.
    ours = {"bc_weight": 0, "expert_episodes": 0}
    ours["replay_buffer_kwargs"] = {"handle_timeout_termination": True}
    theirs = {"replay_buffer_class": ExpertReplayBuffer, "replay_buffer_kwargs": {"seed": 0}}
    trained = []
    for algorithm, options in ((learner, ours), (stock, theirs)):
        model = algorithm(env=make_toy(2, endless=True), **kwargs, **options)
        model.critic.optimizer.step = lambda *args: None
        trained.append(model.learn(60))
    assert trained[0]._n_updates == trained[1]._n_updates > 0
    for name in ("critic_loss", "actor_loss", "ent_coef_loss"):  # of the last update
        losses = [model.logger.name_to_value[f"train/{name}"] for model in trained]
        assert losses[0] == pytest.approx(losses[1], rel=1e-3), name
    expected = parameters(trained[1])
    for name, value in parameters(trained[0]).items():
        np.testing.assert_allclose(value, expected[name], rtol=1e-3, atol=1e-5, err_msg=name)


@pytest.mark.parametrize(
    "kwargs",
    [
        {"n_steps": 2},
        {"n_steps": 2, "ent_coef": 0.3},
        {"expert_episodes": 0},
        {"augmentation": {"drq": {"K": 3, "M": 2, "pad": 1}}},
        {"augmentation": {"rad": {"size": 15}}},
    ],
)
def test_losses_equal_a_slow_reference(kwargs, make_learner):
    """Losses and priorities are means over the views of an augmentation."""
    settings = {"expert_noise": 0.05, "bc_weight": 0.7, "gamma": 0.9}
    model = make_learner(replay_buffer_kwargs={"sampler": "prioritized"}, **settings, **kwargs).learn(40)
    sample = model.replay_buffer.sample(16)._replace(weights=th.linspace(0.1, 1, 16)[:, None])
    if model.augmentation is not None:  # so that the rows of all views are known
        sample = sample._replace(dones=th.zeros(16, 1))
    model.replay_buffer.sample = lambda *args, **kwargs: sample
    priorities = []
    model.replay_buffer.update_priorities = lambda *args: priorities.extend(args)
    before, alpha = parameters(model), float(model.log_ent_coef.exp()) if model.ent_coef != 0.3 else 0.3
    (actor, critic, target), state = copies(model), model.augmentation_generator.get_state()
    th.manual_seed(3)
    model.train(1, 16)
    th.manual_seed(3)

    views = sample
    if model.augmentation is not None:
        views = model.augmentation(sample, th.Generator().set_state(state))
    k_views, m_views = (len(obs["holding"]) // 16 for obs in (views.next_observations, views.observations))
    continues = (sample.dones[:, 0] == 0).repeat(k_views)  # the other values are not computed
    row = continues.cumsum(0) - 1
    with th.no_grad():
        actions, log_prob = (x.numpy() for x in actor.action_log_prob(views.observations))
        after = {key: values[continues] for key, values in views.next_observations.items()}
        next_actions, next_log_prob = actor.action_log_prob(after)
        next_q = th.stack(target(after, next_actions)).amin(dim=0)[:, 0]
        q = th.stack(critic(views.observations, sample.actions.repeat(m_views, 1))).numpy()
        # The actor's loss uses the critic before its step.
        q_pi = th.stack(critic(views.observations, th.as_tensor(actions))).amin(dim=0)[:, 0].numpy()
    critic_loss = squared_error = 0.0
    errors = np.zeros((16, 1))
    for b in range(16):
        y = sample.rewards[b].item()
        for k in (row[b + 16 * k] for k in range(k_views) if continues[b]):
            entropy = alpha * next_log_prob[k].item()
            y += sample.discounts[b].item() * (next_q[k].item() - entropy) / k_views
        for view, head in np.ndindex(m_views, 2):
            error = q[head, view * 16 + b, 0] - y
            errors[b] += abs(error) / (2 * m_views)
            critic_loss += 0.5 * sample.weights[b].item() * error**2 / (16 * m_views)
        if sample.is_expert[b]:
            imitated = actions[b::16] - sample.expert_actions[b].numpy()
            squared_error += (imitated**2).mean() / int(sample.is_expert.sum())
    expected = {"critic_loss": critic_loss, "bc_loss": squared_error}
    expected["actor_loss"] = (alpha * log_prob - q_pi).mean()
    if model.ent_coef_optimizer is not None:
        expected |= {"ent_coef": alpha, "ent_coef_loss": -(np.log(alpha) * (log_prob - 5.0)).mean()}
    for name, value in expected.items():
        found = model.logger.name_to_value[f"train/{name}"]
        np.testing.assert_allclose(found, value, rtol=1e-4, atol=1e-9, err_msg=name)
    np.testing.assert_array_equal(priorities[0], sample.indices)
    np.testing.assert_allclose(priorities[1], errors, rtol=1e-3)
    assert moved(before, parameters(model)) == {"actor", "critic", "critic_target"}


@pytest.mark.parametrize("gradient_steps", [1, 2])
def test_the_target_follows_after_so_many_updates(gradient_steps, make_learner):
    settings = {"gradient_steps": gradient_steps, "target_update_interval": 4, "tau": 1.0}
    model = make_learner(**settings).learn(1)
    moves = []
    for _ in range(8 // gradient_steps):
        before = parameters(model.critic_target)
        model.train(gradient_steps, 4)
        moves.append(bool(moved(before, parameters(model.critic_target))))
    assert sum(moves) == 2


@pytest.mark.parametrize(("warmup", "networks"), [(0, set()), (3, {"critic", "critic_target"})])
def test_pretraining_updates_the_actor_and_the_warm_up_everything(warmup, networks, make_learner):
    before = parameters(make_learner())
    model = make_learner(pretrain_steps=5, critic_warmup_steps=warmup, learning_starts=9).learn(1)
    assert moved(before, parameters(model)) == {"actor", *networks} and model._n_updates == 5
    size = model.replay_buffer.expert_size
    model.learn(1, reset_num_timesteps=False)
    assert (model._n_updates, model.replay_buffer.expert_size) == (5, size)  # not again
    assert model.replay_buffer.size() == size + 2


def test_dagger_queries_the_expert_before_every_step(make_toy, make_learner):
    model = make_learner(make_toy(2), learning_starts=40, gradient_steps=0)
    model.learn(40, callback=DaggerCallback())
    table = model.replay_buffer.table
    rows = np.flatnonzero(table.columns["valid"])[model.replay_buffer.expert_size :]
    actions, experts = (table.columns[name][rows] for name in ("action", "expert_action"))
    assert len(rows) == 40 and np.isfinite(experts).all() and not experts[:, [0, 3, 4]].any()
    # The distance to the target is the expert's action where that is within the limits; a step reduces it.
    left = np.clip(experts - actions, -1, 1)[:, 1:3]
    next_rows = table.next(rows)
    within = (np.abs(experts) < 1)[:, 1:3] & table.columns["valid"][next_rows][:, None]
    assert within.sum() > 5
    following = table.columns["expert_action"][next_rows][:, 1:3]
    np.testing.assert_allclose(following[within], left[within], atol=1e-5)


def test_online_steps_are_imitated_with_dagger_only(make_learner):
    sampler = {"shares": {"expert_fraction": 0.0}}
    losses = []
    for callback in (None, DaggerCallback()):
        model = make_learner(
            expert_episodes=1, learning_starts=20, replay_buffer_kwargs={"sampler": sampler}
        ).learn(25, callback=callback)
        losses.append(model.logger.name_to_value["train/bc_loss"])
    assert losses[0] == 0.0 < losses[1]


def test_dagger_needs_an_expert(make_learner):
    model = make_learner()
    model.env.has_attr = lambda name: name != "expert_action"
    with pytest.raises(ValueError, match=r"env must have expert_action\(\)"):
        model.learn(5, callback=DaggerCallback())


def test_dagger_needs_an_algorithm_that_imitates(make_toy, make_learner):
    for model in (SAC("MultiInputPolicy", make_toy(), buffer_size=10), make_learner(bc_weight=0.0)):
        with pytest.raises(ValueError, match=r"^model must .*bc_weight.*, got SAC"):
            model.learn(5, callback=DaggerCallback())


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
    names = {name for name in after if not np.array_equal(after[name], before[name])}
    return {".".join(name.split(".")[: 3 if "features_extractor" in name else 1]) for name in names}


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
    before = parameters(model)
    model._update_encoder(sample.observations)
    shared = {f"{network}.features_extractor.{part}" for network in ("actor", "critic") for part in parts}
    assert changed(before, parameters(model)) == {*shared, "critic.features_extractor.projection", "contrast"}


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


@pytest.mark.parametrize(("update", "heads_tau"), [("train", 0.1), ("_imitate", 0.0)])
def test_target_extractor_follows_faster_than_the_heads(update, heads_tau, make_model):
    """In imitation alone, the contrastive loss trains the extractor, and nothing trains the heads."""
    model = make_model(encoder_tau=0.3, tau=0.1).learn(2)
    before = {name: value.clone() for name, value in model.critic_target.named_parameters()}
    getattr(model, update)(*[1, 16] if update == "train" else [])
    critic = dict(model.critic.named_parameters())
    for name, value in model.critic_target.named_parameters():
        tau = 0.3 if name.startswith("features_extractor.") else heads_tau
        th.testing.assert_close(value, (1 - tau) * before[name] + tau * critic[name])
        assert not th.equal(critic[name], before[name]), name


def test_pretraining_updates_each_parameter_once_per_step(make_model, tmp_path):
    model = make_model(contrastive_steps=7, learning_starts=100)
    initial = parameters(model)
    model.learn(2)
    assert steps(model.contrast.optimizer) == {7} and model._n_updates == 0
    trained = {f"{net}.features_extractor.encoder" for net in ("actor", "critic", "critic_target")}
    trained |= {f"{net}.features_extractor.projection" for net in ("critic", "critic_target")}
    assert changed(initial, parameters(model)) == {*trained, "contrast"}
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
