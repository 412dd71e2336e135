import copy
import itertools

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.utils import polyak_update
from torch import nn

from sb3_extensions.common.action_sequence import ActionSequence
from sb3_extensions.encoders.extractors import CnnExtractor
from sb3_extensions.sacfd.policies import EquivariantPolicy, MultiInputPolicy

SIZE = 16
EXACT = 2e-6
SMALL = {"n": 4, "channels": [4, 4, 4]}
GROUPS = [("cyclic", 4), ("cyclic", 8), ("dihedral", 4)]
OBSERVATION_SPACE = spaces.Dict(
    {
        "heightmap": spaces.Box(0, 0.4, (1, SIZE, SIZE), np.float32),
        "holding": spaces.Box(0, 1, (1,), np.float32),
    }
)
IN_HAND_SPACE = spaces.Dict({**OBSERVATION_SPACE, "in_hand": spaces.Box(0, 0.4, (1, 8, 8), np.float32)})


class NoiseEnv(gym.Env):
    """Random images and rewards."""

    def __init__(self, action_dim=5):
        self.observation_space = copy.deepcopy(OBSERVATION_SPACE)
        self.action_space = spaces.Box(-1, 1, (action_dim,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        self.steps = 0
        return self.observation_space.sample(), {}

    def step(self, action):
        self.steps += 1
        return self.observation_space.sample(), float(action.sum()), False, self.steps == 8, {}


@pytest.fixture(autouse=True)
def _seed():
    th.manual_seed(0)


def make_policy(
    action_dim=5, policy_class=EquivariantPolicy, extractor=SMALL, space=OBSERVATION_SPACE, **kwargs
):
    action_space = spaces.Box(-1, 1, (action_dim,), np.float32)
    return policy_class(
        space, action_space, lambda _: 1e-3, features_extractor_kwargs=dict(extractor), **kwargs
    )


def draw_biases(policy):
    """Biases that differ from zero, so that a small network has no dead features."""
    for parameter in policy.parameters():
        if parameter.dim() == 1:
            nn.init.uniform_(parameter, 0.1, 0.5)
    return policy


def sample(batch=4, space=OBSERVATION_SPACE):
    space.seed(0)
    observations = [space.sample() for _ in range(batch)]
    return {key: th.from_numpy(np.stack([each[key] for each in observations])) for key in space}


def grid_elements(group):
    """(quarter turns, reflected) of the elements that map the grid of pixels to itself."""
    return itertools.product(range(4), (False, True) if group == "dihedral" else (False,))


def turn_observations(observations, turns, mirror):
    image = observations["heightmap"]
    return {**observations, "heightmap": th.rot90(image.flip(-1) if mirror else image, turns, (-2, -1))}


def turn_actions(actions, sequence, turns, mirror):
    """A quarter turn takes (x, y) to (-y, x); the reflection, which comes first, to (x, -y), and r to -r.

    Of three r's, the turns (u, v) about x and y go to (-v, u) by the turn, to (-u, v) by the reflection.
    """
    names = ActionSequence(sequence, len(sequence)).names
    numbers = dict(zip(names, actions.unbind(1), strict=True))
    if mirror:
        for name in "yur":
            if name in numbers:
                numbers[name] = -numbers[name]
    for _ in range(turns):
        numbers["x"], numbers["y"] = -numbers["y"], numbers["x"]
        if "u" in numbers:
            numbers["u"], numbers["v"] = -numbers["v"], numbers["u"]
    return th.stack([numbers[name] for name in names], dim=1)


@pytest.mark.parametrize("group, n", GROUPS)
@pytest.mark.parametrize("sequence", ["pxyzr", "pxyz", "ryzxp", "rpxryzr"])
@pytest.mark.parametrize("hidden", [[], [8]])
@pytest.mark.parametrize("space", [OBSERVATION_SPACE, IN_HAND_SPACE], ids=["scene", "in_hand"])
def test_actor_turns_with_the_scene(group, n, sequence, hidden, space):
    net_arch = {"pi": hidden, "qf": [4]}
    extractor = {**SMALL, "group": group, "n": n}
    policy = make_policy(
        len(sequence), extractor=extractor, action_sequence=sequence, net_arch=net_arch, space=space
    )
    draw_biases(policy)
    observations = sample(space=space)
    with th.no_grad():
        mean, log_std, _ = policy.actor.get_action_dist_params(observations)
        action = policy.actor(observations, deterministic=True)
        assert mean.abs().max(dim=0).values.min() > 100 * EXACT
        for turns, mirror in grid_elements(group):
            turned = turn_observations(observations, turns, mirror)
            turned_mean, turned_log_std, _ = policy.actor.get_action_dist_params(turned)
            rounding = EXACT * max(1.0, mean.abs().max().item())  # of float32, relative to the largest mean
            assert th.allclose(turned_mean, turn_actions(mean, sequence, turns, mirror), atol=rounding)
            assert th.allclose(turned_log_std, log_std, atol=rounding)
            squashed = policy.actor(turned, deterministic=True)
            assert th.allclose(squashed, turn_actions(action, sequence, turns, mirror), atol=rounding)
    names = ActionSequence(sequence, len(sequence)).names
    shared = {second: first for first, second in ("xy", "uv") if second in names}
    for second, first in shared.items():
        assert th.equal(log_std[:, names.index(first)], log_std[:, names.index(second)])
    others = [log_std[:, i] for i, name in enumerate(names) if name not in shared]
    assert all(not th.equal(a, b) for i, a in enumerate(others) for b in others[:i])


@pytest.mark.parametrize("group, n", GROUPS)
@pytest.mark.parametrize("sequence", ["pxyzr", "zyxp", "pxyzrrr"])
@pytest.mark.parametrize("space", [OBSERVATION_SPACE, IN_HAND_SPACE], ids=["scene", "in_hand"])
def test_critic_stays_when_scene_and_action_turn(group, n, sequence, space):
    extractor = {**SMALL, "group": group, "n": n}
    policy = make_policy(len(sequence), extractor=extractor, action_sequence=sequence, space=space)
    draw_biases(policy)
    observations, actions = sample(space=space), th.rand(4, len(sequence)) * 2 - 1
    with th.no_grad():
        values = th.cat(policy.critic(observations, actions), dim=1)
        assert values.shape == (4, 2) and values.std() > 1e-3
        for turns, mirror in grid_elements(group):
            turned = turn_observations(observations, turns, mirror)
            turned_actions = turn_actions(actions, sequence, turns, mirror)
            found = th.cat(policy.critic(turned, turned_actions), dim=1)
            assert th.allclose(found, values, atol=EXACT * max(1.0, values.abs().max().item()))
        assert not th.allclose(th.cat(policy.critic(observations, -actions), dim=1), values, atol=1e-3)


def test_heads_turn_by_every_element_of_the_group():
    """Rotations that pixels cannot follow: the heads behind the encoder are exact under them too."""
    policy = make_policy(extractor={**SMALL, "n": 8})
    fields = policy.actor.features_extractor.out_type
    features, actions = th.randn(4, fields.size), th.rand(4, 5)
    vector = th.tensor(fields.group.irrep(1).matrices).float()
    for element in range(8):
        turned = features @ th.tensor(fields.matrix(element)).float().T
        mean, turned_mean = policy.actor.mu(features), policy.actor.mu(turned)
        assert th.allclose(turned_mean[:, 1:3], mean[:, 1:3] @ vector[element].T, atol=EXACT)
        assert th.allclose(turned_mean[:, [0, 3, 4]], mean[:, [0, 3, 4]], atol=EXACT)
        turned_actions = actions.clone()
        turned_actions[:, 1:3] = actions[:, 1:3] @ vector[element].T
        for q_net in policy.critic.q_networks:
            values = q_net(th.cat([features, actions], dim=1))
            assert th.allclose(q_net(th.cat([turned, turned_actions], dim=1)), values, atol=EXACT)


def test_cnn_policy_is_the_papers():
    policy = make_policy(policy_class=MultiInputPolicy, extractor={})
    assert isinstance(policy.actor.features_extractor, CnnExtractor)
    widths = {}
    for name, network in (("actor", policy.actor), ("critic", policy.critic)):
        layers = [(key, layer) for key, layer in network.named_modules() if isinstance(layer, nn.Linear)]
        widths[name] = [(layer.in_features, layer.out_features) for _, layer in layers]
        for _, layer in layers:
            bound = layer.in_features**-0.5  # PyTorch's initialisation
            assert 0.8 * bound < layer.weight.abs().max() <= bound
    assert widths == {"actor": [(128, 5), (128, 5)], "critic": [(133, 128), (128, 1)] * 2}


@pytest.mark.parametrize("policy_class", [MultiInputPolicy, EquivariantPolicy])
@pytest.mark.parametrize("space", [OBSERVATION_SPACE, IN_HAND_SPACE], ids=["scene", "in_hand"])
def test_heads_of_the_critic_share_an_encoder_of_their_own(policy_class, space):
    extractor = {"channels": [4, 4, 4]}
    policy = draw_biases(make_policy(policy_class=policy_class, extractor=extractor, space=space))
    assert policy.actor.features_extractor is not policy.critic.features_extractor
    th.cat(policy.critic(sample(space=space), th.rand(4, 5)), dim=1).sum().backward()
    for name, parameter in policy.critic.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().sum() > 0, name
    action, log_prob = policy.actor.action_log_prob(sample(space=space))
    (action.square().sum() + log_prob.sum()).backward()
    for name, parameter in policy.actor.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().sum() > 0, name
    assert policy.critic.features_extractor.encoder is not policy.critic_target.features_extractor.encoder


@pytest.mark.parametrize("policy_class", [MultiInputPolicy, EquivariantPolicy])
def test_target_critic_moves_with_its_weights(policy_class):
    policy = draw_biases(make_policy(policy_class=policy_class, extractor={"channels": [4, 4, 4]}))
    observations, actions = sample(), th.rand(4, 5)
    with th.no_grad():
        before = th.cat(policy.critic_target(observations, actions), dim=1)
        for parameter in policy.critic.parameters():
            parameter.add_(0.1)
        polyak_update(policy.critic.parameters(), policy.critic_target.parameters(), tau=1.0)
        after = th.cat(policy.critic_target(observations, actions), dim=1)
        assert not policy.critic_target.training and not th.allclose(after, before, atol=1e-3)
        assert th.equal(after, th.cat(policy.critic(observations, actions), dim=1))


@pytest.mark.parametrize(
    "policy_class, policy_kwargs",
    [
        (MultiInputPolicy, {"features_extractor_kwargs": {"channels": [4, 4, 8]}, "net_arch": [16]}),
        (EquivariantPolicy, {"features_extractor_kwargs": SMALL, "action_sequence": "ryxzp", "n_critics": 3}),
        (EquivariantPolicy, {"features_extractor_kwargs": SMALL, "share_features_extractor": True}),
        (EquivariantPolicy, {"features_extractor_kwargs": SMALL, "net_arch": {"pi": [4], "qf": [8, 4]}}),
    ],
)
def test_stock_sac_trains_saves_and_loads(policy_class, policy_kwargs, tmp_path):
    model = SAC(
        policy_class,
        NoiseEnv(),
        policy_kwargs=policy_kwargs,
        learning_starts=4,
        buffer_size=32,
        batch_size=4,
        seed=0,
        device="cpu",
    )
    before = model.policy.parameters_to_vector()
    model.learn(10)
    assert not np.array_equal(model.policy.parameters_to_vector(), before)
    observation = model.get_env().reset()
    expected, _ = model.predict(observation, deterministic=True)
    model.save(tmp_path / "model")
    loaded = SAC.load(tmp_path / "model", device="cpu")
    model.policy.save(tmp_path / "policy")
    policy = policy_class.load(tmp_path / "policy", device="cpu")
    for other in (loaded, policy, copy.deepcopy(model.policy)):
        np.testing.assert_array_equal(other.predict(observation, deterministic=True)[0], expected)
    for name, value in model.policy.state_dict().items():
        assert th.equal(value, loaded.policy.state_dict()[name]) and th.equal(
            value, policy.state_dict()[name]
        )
    loaded.set_env(NoiseEnv())
    loaded.learn(6)


@pytest.mark.parametrize(
    ("policy_class", "extractor", "hidden"),
    [(EquivariantPolicy, SMALL, [4]), (MultiInputPolicy, {"channels": [4, 4, 4]}, [16])],
)
def test_outputs_of_a_normalised_actor_do_not_grow_with_its_features(policy_class, extractor, hidden):
    net_arch = {"pi": hidden, "qf": hidden}
    policy = make_policy(policy_class=policy_class, extractor=extractor, net_arch=net_arch, normalise=True)
    features = th.rand(8, policy.actor.features_extractor.features_dim)
    small, large = (policy.actor.mu(policy.actor.latent_pi(scale * features)) for scale in (1.0, 1e3))
    assert large.abs().max() < 2.0 * small.abs().max()


def test_same_seed_same_weights_and_actions():
    def run():
        model = SAC(
            EquivariantPolicy,
            NoiseEnv(),
            policy_kwargs={"features_extractor_kwargs": SMALL},
            learning_starts=4,
            buffer_size=32,
            batch_size=4,
            seed=3,
            device="cpu",
        )
        return model.learn(10).policy.parameters_to_vector()

    np.testing.assert_array_equal(run(), run())


def test_predict_takes_one_observation_or_a_batch():
    policy = make_policy()
    batch = {key: value.numpy() for key, value in sample().items()}
    actions, _ = policy.predict(batch, deterministic=True)
    single, _ = policy.predict({key: value[0] for key, value in batch.items()}, deterministic=True)
    assert actions.shape == (4, 5) and single.shape == (5,)
    np.testing.assert_allclose(single, actions[0], atol=1e-6)


@pytest.mark.parametrize(
    "action_dim, sequence", [(4, "pxyzr"), (5, "pxyzq"), (5, "pxxyz"), (6, "pxyzrr"), (4, "pxzr")]
)
def test_action_sequence_must_fit_the_action(action_dim, sequence):
    message = f"action_sequence must have {action_dim} characters.* got '{sequence}'"
    with pytest.raises(ValueError, match=message):
        make_policy(action_dim, action_sequence=sequence)


def test_actions_without_a_vector_or_of_one_alone():
    for sequence in ("pzr", "xy"):
        policy = make_policy(
            len(sequence), action_sequence=sequence, extractor={**SMALL, "group": "dihedral"}
        )
        assert policy.actor(sample()).shape == (4, len(sequence))
        assert policy.critic(sample(), th.rand(4, len(sequence)))[0].shape == (4, 1)


def test_equivariant_policy_refuses_what_breaks_the_symmetry():
    with pytest.raises(ValueError, match="output='regular'"):
        make_policy(extractor={**SMALL, "output": "invariant"})
    with pytest.raises(ValueError, match="features_extractor_class"):
        make_policy(extractor={}, features_extractor_class=CnnExtractor)
    with pytest.raises(ValueError, match="use_sde"):
        make_policy(use_sde=True)
