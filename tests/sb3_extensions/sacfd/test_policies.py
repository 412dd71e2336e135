"""Policies of SACfD: they rotate with the scene, serve SAC, and may average the actor's weights."""

import itertools
import pickle

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from torch import nn

from sb3_extensions.common.action_sequence import ActionSequence
from sb3_extensions.encoders.extractors import CnnExtractor
from sb3_extensions.ferm import FERM
from sb3_extensions.sacfd.policies import EquivariantPolicy, MultiInputPolicy
from sb3_extensions.tqcfd import TQCfD
from sb3_extensions.tqcfd.policies import EquivariantPolicy as EquivariantTQCPolicy

EXACT = 2e-6
SMALL = {"n": 4, "channels": [4, 4, 4]}
SCENE = spaces.Dict(
    {"heightmap": spaces.Box(0, 0.4, (1, 16, 16), np.float32), "holding": spaces.Box(0, 1, (1,), np.float32)}
)
IN_HAND = spaces.Dict({**SCENE, "in_hand": spaces.Box(0, 0.4, (1, 8, 8), np.float32)})


def make_policy(action_dim=5, policy_class=EquivariantPolicy, extractor=SMALL, space=SCENE, **kwargs):
    """Biases differ from zero, so that a small network has no dead features."""
    action_space = spaces.Box(-1, 1, (action_dim,), np.float32)
    kwargs["features_extractor_kwargs"] = dict(extractor)
    policy = policy_class(space, action_space, lambda _: 1e-3, **kwargs)
    for parameter in policy.parameters():
        if parameter.dim() == 1:
            nn.init.uniform_(parameter, 0.1, 0.5)
    return policy


def sample(space=SCENE):
    space.seed(0)
    observations = [space.sample() for _ in range(4)]
    return {key: th.from_numpy(np.stack([each[key] for each in observations])) for key in space}


def turn_actions(actions, sequence, turns, mirror):
    """A quarter turn takes (x, y) to (-y, x); the reflection, which comes first, to (x, -y), and r to -r.

    Of three r's, the turns (u, v) about x and y go to (-v, u) by the turn, to (-u, v) by the reflection.
    """
    names = ActionSequence(sequence, len(sequence)).names
    numbers = dict(zip(names, actions.unbind(1), strict=True))
    for name in "yur" * mirror:
        if name in numbers:
            numbers[name] = -numbers[name]
    for _ in range(turns):
        numbers["x"], numbers["y"] = -numbers["y"], numbers["x"]
        if "u" in numbers:
            numbers["u"], numbers["v"] = -numbers["v"], numbers["u"]
    return th.stack([numbers[name] for name in names], dim=1)


@pytest.mark.parametrize(
    "group, n, policy_class",
    [
        ("cyclic", 8, EquivariantPolicy),
        ("dihedral", 4, EquivariantPolicy),
        ("cyclic", 4, EquivariantTQCPolicy),
    ],
)
@pytest.mark.parametrize(
    "sequence, hidden, space", [("pxyzr", [], SCENE), ("pxyz", [8], IN_HAND), ("rpxryzr", [8], SCENE)]
)
def test_actor_and_critic_rotate_with_the_scene(group, n, policy_class, sequence, hidden, space):
    extractor = {**SMALL, "group": group, "n": n}
    kwargs = {"action_sequence": sequence, "net_arch": {"pi": hidden, "qf": hidden or [4]}}
    policy = make_policy(len(sequence), policy_class, extractor, space, **kwargs)
    observations, actions = sample(space), th.rand(4, len(sequence)) * 2 - 1

    def q_values(*inputs):
        return th.stack(list(policy.critic(*inputs))).flatten(1)

    with th.no_grad():
        mean, log_std, _ = policy.actor.get_action_dist_params(observations)
        action = policy.actor(observations, deterministic=True)
        values = q_values(observations, actions)
        assert mean.abs().max(dim=0).values.min() > 100 * EXACT and values.std() > 1e-3
        for turns, mirror in itertools.product(range(4), {False, group == "dihedral"}):
            image = observations["heightmap"].flip(-1) if mirror else observations["heightmap"]
            turned = {**observations, "heightmap": th.rot90(image, turns, (-2, -1))}
            turned_mean, turned_log_std, _ = policy.actor.get_action_dist_params(turned)
            rounding = EXACT * max(1.0, mean.abs().max().item())  # of float32, relative to the largest mean
            assert th.allclose(turned_mean, turn_actions(mean, sequence, turns, mirror), atol=rounding)
            assert th.allclose(turned_log_std, log_std, atol=rounding)
            squashed = policy.actor(turned, deterministic=True)
            assert th.allclose(squashed, turn_actions(action, sequence, turns, mirror), atol=rounding)
            found = q_values(turned, turn_actions(actions, sequence, turns, mirror))
            assert th.allclose(found, values, atol=EXACT * max(1.0, values.abs().max().item()))
        assert not th.allclose(q_values(observations, -actions), values, atol=1e-3)
    names = ActionSequence(sequence, len(sequence)).names
    columns = {name: log_std[:, names.index(name)] for name in names}
    for first, second in itertools.combinations(names, 2):
        assert th.equal(columns[first], columns[second]) == ({first, second} in ({"x", "y"}, {"u", "v"}))


def test_cnn_policy_is_the_papers():
    actions = spaces.Box(-1, 1, (5,), np.float32)
    policy = MultiInputPolicy(SCENE, actions, lambda _: 1e-3)
    assert isinstance(policy.actor.features_extractor, CnnExtractor)
    assert policy.actor.features_extractor is not policy.critic.features_extractor
    widths = {}
    for name, network in (("actor", policy.actor), ("critic", policy.critic)):
        layers = [layer for layer in network.modules() if isinstance(layer, nn.Linear)]
        widths[name] = [(layer.in_features, layer.out_features) for layer in layers]
        for layer in layers:
            bound = (6.0 / (layer.in_features + layer.out_features)) ** 0.5  # Xavier uniform
            assert 0.8 * bound < layer.weight.abs().max() <= bound and not layer.bias.any()
    assert widths == {"actor": [(128, 5), (128, 5)], "critic": [(133, 128), (128, 1)] * 2}


@pytest.mark.parametrize(
    ("policy_class", "extractor"), [(MultiInputPolicy, {"channels": [4, 4, 4]}), (EquivariantPolicy, SMALL)]
)
def test_outputs_of_normalised_networks_do_not_grow_with_their_features(policy_class, extractor):
    options = {"net_arch": {"pi": [8], "qf": [8]}, "normalise": True}
    policy = make_policy(policy_class=policy_class, extractor=extractor, **options)
    features = th.rand(8, policy.actor.features_extractor.features_dim)
    small, large = (policy.actor.mu(policy.actor.latent_pi(scale * features)) for scale in (1.0, 1e3))
    assert large.abs().max() < 2.0 * small.abs().max()
    joint = th.cat([features, th.zeros(8, 5)], dim=1)
    small, large = (policy.critic.q_networks[0](scale * joint) for scale in (1.0, 1e3))
    assert large.abs().max() < 2.0 * small.abs().max()


@pytest.mark.parametrize(
    "action_dim, kwargs, named",
    [
        (4, {"action_sequence": "pxyzr"}, "action_sequence .* 4 .* got 'pxyzr'"),
        (5, {"action_sequence": "pxyzq"}, "action_sequence .* got 'pxyzq'"),
        (6, {"action_sequence": "pxyzrr"}, "action_sequence .* got 'pxyzrr'"),
        (5, {"extractor": {**SMALL, "output": "invariant"}}, "output='regular'"),
        (5, {"extractor": {}, "features_extractor_class": CnnExtractor}, "features_extractor_class"),
        (5, {"use_sde": True}, "use_sde"),
    ],
)
def test_invalid_arguments_are_rejected(action_dim, kwargs, named):
    with pytest.raises(ValueError, match=named):
        make_policy(action_dim, **kwargs)


@pytest.mark.parametrize("sequence", ["pzr", "xy"])
def test_actions_without_a_vector_or_of_one_alone(sequence):
    extractor = {**SMALL, "group": "dihedral"}
    policy = make_policy(len(sequence), action_sequence=sequence, extractor=extractor)
    assert policy.actor(sample()).shape == (4, len(sequence))
    assert policy.critic(sample(), th.rand(4, len(sequence)))[0].shape == (4, 1)


def weights(module):
    return th.nn.utils.parameters_to_vector(module.parameters()).detach().numpy().copy()


def test_first_updates_count_alike_then_the_latest_most(make_learner):
    model = make_learner(policy_kwargs={"actor_tau": 0.25}).learn(1)
    after = [weights(model.actor)]
    for _ in range(7):
        model.train(1, 16)
        after.append(weights(model.actor))
    expected = np.mean(after[:4], axis=0)
    for latest in after[4:]:
        expected = 0.75 * expected + 0.25 * latest
    assert (after[0] != after[-1]).any()
    np.testing.assert_allclose(weights(model.policy.actor_average.module), expected, atol=1e-5)


def test_average_acts_without_dropout(make_toy, make_learner):
    model = make_learner(policy_kwargs={"actor_tau": 0.25, "activation_fn": nn.Dropout, "net_arch": [64]})
    observation = make_toy().reset()
    first, second = (model.learn(1).predict(observation, deterministic=True)[0] for _ in range(2))
    again, _ = model.predict(observation, deterministic=True)
    np.testing.assert_array_equal(second, again)
    assert (first != second).any()


@pytest.mark.parametrize(("learner", "policy"), [(TQCfD, "EquivariantPolicy"), (FERM, "MultiInputPolicy")])
def test_average_acts_where_actions_are_not_sampled(learner, policy, make_toy, make_learner, tmp_path):
    """The average is saved and not trained, and learning is the same with it. Actors are saved alone, too."""
    kwargs = {"actor_tau": 0.25, "normalise": True}
    model = make_learner(make_toy(2), learner, policy, policy_kwargs=kwargs).learn(20)
    without = make_learner(make_toy(2), learner, policy, policy_kwargs={"normalise": True}).learn(20)
    for name in ("actor", "critic"):
        np.testing.assert_array_equal(weights(getattr(model, name)), weights(getattr(without, name)))
    model.policy.set_training_mode(False)
    observation = make_toy(3).reset()
    tensors, _ = model.policy.obs_to_tensor(observation)
    average = model.policy.actor_average.module
    for actor, deterministic in ((average, True), (model.actor, False)):
        th.manual_seed(0)
        with th.no_grad():
            expected = model.policy.unscale_action(actor(tensors, deterministic).numpy())
        th.manual_seed(0)
        found, _ = model.predict(observation, deterministic=deterministic)
        np.testing.assert_array_equal(found, expected)
    assert (weights(average) != weights(model.actor)).any()
    assert not any(parameter.requires_grad for parameter in average.parameters())
    expected, _ = model.predict(observation, deterministic=True)
    model.save(tmp_path / "model")
    model.policy.save(tmp_path / "policy")
    others = [learner.load(tmp_path / "model", device="cpu")]
    others += [
        type(model.policy).load(tmp_path / "policy", device="cpu"),
        pickle.loads(pickle.dumps(model.policy)),
    ]
    for other in others:
        np.testing.assert_array_equal(other.predict(observation, deterministic=True)[0], expected)
    model.actor.save(tmp_path / "actor")
    actors = [model.actor, type(model.actor).load(tmp_path / "actor", device="cpu")]
    np.testing.assert_array_equal(*(actor.predict(observation, deterministic=True)[0] for actor in actors))
