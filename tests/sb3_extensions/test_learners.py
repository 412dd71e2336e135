"""Contract of the closed-loop learners: SACfD, TQCfD and FERM with each of their policies."""

import inspect
import math

import gymnasium
import numpy as np
import pytest
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecNormalize

import bulletarm_gym  # noqa: F401 (registers the environments)
from sb3_extensions.common.env_metadata import constructor_arguments
from sb3_extensions.encoders.extractors import CnnExtractor
from sb3_extensions.ferm import FERM
from sb3_extensions.replay.rotation import Rotation
from sb3_extensions.sacfd import SACfD
from sb3_extensions.sacfd.policies import MultiInputPolicy
from sb3_extensions.spatial_dqn import SDQfD, SpatialDQN
from sb3_extensions.tqcfd import TQCfD

PARAMETERS = inspect.signature(SACfD).parameters
PICKING = "BulletArm/CloseLoopBlockPicking-v0"


def test_environments_by_id_and_normalised_environments(make_toy, make_learner):
    make_learner("ToyReach-v0").learn(3)
    for kwargs in ({"norm_obs": False}, {"norm_obs_keys": ["holding"]}):
        make_learner(VecNormalize(make_toy(), **kwargs)).learn(3)
    with pytest.raises(ValueError, match="heightmap"):
        make_learner(VecNormalize(make_toy())).learn(1)


@pytest.mark.parametrize(
    ("learner", "policy", "kwargs"),
    [
        (TQCfD, "StatePolicy", {}),
        (
            SACfD,
            "EquivariantPolicy",
            {"augmentation": "rotation", "replay_buffer_kwargs": {"sampler": "prioritized"}},
        ),
        (FERM, "MultiInputPolicy", {"contrastive_steps": 50}),
    ],
)
def test_learns_to_reach(learner, policy, kwargs, make_toy, make_learner):
    observation = "state" if policy == "StatePolicy" else "image"
    kwargs = {"learning_rate": 3e-3, "batch_size": 32, "buffer_size": 1500, **kwargs}
    kwargs |= {"expert_episodes": 20, "bc_weight": 10.0, "pretrain_steps": 100}
    if policy == "MultiInputPolicy":
        networks = {"features_extractor_kwargs": {"channels": [8, 16, 32]}, "net_arch": [32]}
        kwargs["policy_kwargs"] = networks
    model = make_learner(make_toy(2, observation=observation), learner, policy, **kwargs)
    test_env = make_toy(seed=9, observation=observation)
    untrained, _ = evaluate_policy(model, test_env, 20)
    model.learn(60)
    trained, _ = evaluate_policy(model, test_env, 20)
    assert untrained < 0.6
    assert trained >= 0.9


@pytest.mark.parametrize("learner", [FERM, TQCfD])
def test_learners_accept_the_arguments_of_sacfd_only(learner, make_learner):
    assert constructor_arguments(learner).keys() >= PARAMETERS.keys()
    model = make_learner(None, learner, gamma=0.5, bc_limit=0.5, augmentation={"rad": {"size": 12}})
    assert (model.gamma, model.bc_limit) == (0.5, 0.5)
    with pytest.raises(TypeError, match="gama"):
        make_learner(None, learner, gama=0.9)


def test_at_most_twelve_additions_and_all_off():
    """Arguments in addition to those of SAC and of the paper's SACfD."""
    papers = {"bc_weight", "expert_episodes", "expert_data", "augmentation"}
    additions = PARAMETERS.keys() - inspect.signature(SAC).parameters.keys() - papers
    assert len(additions) <= 12
    on = {"backup_entropy": True, "bc_limit": 1.0, "expert_q_weight": 1.0}
    for name in additions:
        assert PARAMETERS[name].default == on.get(name, PARAMETERS[name].default)
        assert name in on or not PARAMETERS[name].default


@pytest.mark.parametrize(
    ("kwargs", "named"),
    [
        ({"bc_weight": -1}, "bc_weight .* got -1"),
        ({"expert_episodes": -1}, "expert_episodes .* got -1"),
        ({"batch_size": 0}, "batch_size .* got 0"),
        ({"batch_size": 2.5}, "batch_size .* got 2.5"),
        ({"buffer_size": 1e3}, "buffer_size .* got 1000.0"),
        ({"gamma": 1.5}, "gamma .* got 1.5"),
        ({"tau": -0.1}, "tau .* got -0.1"),
        ({"pretrain_steps": 5, "expert_episodes": 0}, "pretrain_steps"),
        ({"replay_buffer_class": ReplayBuffer}, "replay_buffer_class"),
        ({"replay_buffer_kwargs": {"gamma": 0.9}}, "gamma"),
        ({"replay_buffer_kwargs": {"image_dtype": "uint16"}}, "image_dtype='uint16'.*quantise='uint8'"),
        ({"policy_kwargs": {"features_extractor_kwargs": {"quantise": None}}}, "quantise=None"),
        ({"pretrain_steps": 5, "bc_weight": 0}, "critic_warmup_steps"),
        ({"n_steps": 0}, "n_steps"),
        ({"n_steps": 2.0}, "n_steps .* integer .* got 2.0"),
        ({"pretrain_steps": 2.5}, "pretrain_steps .* integer .* got 2.5"),
        ({"expert_episodes": 2.5}, "expert_episodes .* integer .* got 2.5"),
        ({"critic_warmup_steps": 1.5}, "critic_warmup_steps .* integer .* got 1.5"),
        ({"target_update_interval": 0}, "target_update_interval .* got 0"),
        ({"bc_limit": 1.5}, "bc_limit .* got 1.5"),
        ({"self_imitation_temperature": 0.0}, "self_imitation_temperature"),
        ({"policy_kwargs": {"actor_tau": 1.5}}, "actor_tau .* got 1.5"),
        ({"augmentation": {"rad": {"size": 16}}}, "16 x 16"),
        ({"train_freq": 0}, "train_freq .* n_envs=1"),
        ({"learner": TQCfD, "top_quantiles_to_drop_per_net": 25}, "top_quantiles_to_drop_per_net"),
        ({"learner": FERM, "augmentation": None}, "augmentation .* got None"),
        ({"learner": FERM, "contrastive_steps": 0.5}, "contrastive_steps .* integer .* got 0.5"),
        ({"learner": FERM, "encoder_tau": 0.0}, "encoder_tau .* got 0.0"),
        ({"learner": FERM, "policy": MultiInputPolicy}, "policy must be FERM's MultiInputPolicy"),
        ({"learner": FERM, "policy_kwargs": {"share_features_extractor": True}}, "share_features_extractor"),
        ({"learner": FERM, "policy_kwargs": {"features_extractor_class": CnnExtractor}}, "Contrastive"),
    ],
)
def test_invalid_arguments_are_rejected(kwargs, named, make_learner):
    with pytest.raises(ValueError, match=named):
        make_learner(**kwargs)


@pytest.mark.parametrize("algorithm", [SACfD, SDQfD])
def test_learn_has_the_parameters_of_stable_baselines3(algorithm):
    ours, theirs = (list(inspect.signature(each.learn).parameters) for each in (algorithm, SAC))
    assert ours == theirs


@pytest.mark.parametrize("algorithm", [SACfD, TQCfD, FERM, SDQfD])
def test_an_unknown_policy_is_refused_with_the_known_ones(algorithm, make_toy):
    with pytest.raises(ValueError, match=f"policy .*{', '.join(algorithm.policy_aliases)}, got 'CnnPolicy'"):
        algorithm("CnnPolicy", make_toy())


def test_unfitting_environments_are_refused(monkeypatch, make_toy, make_learner, tmp_path):
    with pytest.raises(ValueError, match=r"train_freq .* n_envs=2"):
        make_learner(make_toy(2), train_freq=(1, "episode"))
    make_learner(train_freq=(1, "episode")).save(tmp_path / "model")
    with pytest.raises(ValueError, match=r"got \(1, 'episode'\) with n_envs=2"):
        SACfD.load(tmp_path / "model", env=make_toy(2))
    env = make_toy()  # in open loop
    monkeypatch.setattr(type(env.envs[0].unwrapped), "action_ranges", {"theta": (0.0, 3.1)}, raising=False)
    with pytest.raises(ValueError, match=r"policy .*got EquivariantPolicy"):
        make_learner(env, policy="EquivariantPolicy")


SMALL_EQUIVARIANT = {"features_extractor_kwargs": {"n": 4, "channels": [4, 4, 4, 4, 4]}}
WIDE = [[0.3, 0.6], [-0.15, 0.15], [0.0, 1.0]]


def make_sacfd(env, augmentation=None, **policy_kwargs):
    policy_kwargs = {**SMALL_EQUIVARIANT, **policy_kwargs}
    kwargs = {"buffer_size": 100, "policy_kwargs": policy_kwargs, "augmentation": augmentation}
    return SACfD("EquivariantPolicy", env, **kwargs)


def make_codec(codec_kwargs=None, **env_kwargs):
    stacking = "BulletArm/OpenLoopBlockStacking-v0"
    env = gymnasium.make(stacking, obs_size=32, in_hand_size=16, **env_kwargs)
    policy_kwargs = {"network_kwargs": {"channels": [4, 4, 4]}, "codec_kwargs": codec_kwargs}
    return SpatialDQN("FCNPolicy", env, buffer_size=100, policy_kwargs=policy_kwargs).codec


def test_policy_and_rotation_adopt_the_action_sequence_of_the_environment():
    env = gymnasium.make(PICKING, obs_size=64, action_sequence="xyzpr")
    model = make_sacfd(env, {"rotation": {}, "rad": {"size": 60}})
    assert model.policy.action_sequence == "xyzpr"
    assert model.augmentation.steps[0] == Rotation(action_sequence="xyzpr")
    assert model.actor.features_extractor.stack.size == 60
    assert make_sacfd(env, action_sequence="pxyzr").policy.action_sequence == "pxyzr"
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (4,))
    shorter = gymnasium.wrappers.TransformAction(env, lambda action: [*action, 0.0], action_space)
    with pytest.raises(ValueError, match=r"action_sequence must .*, got 'pxyzr'"):
        make_sacfd(shorter)
    make_sacfd(shorter, action_sequence="pxyz")


def test_grid_adopts_the_action_ranges():
    codec = make_codec(action_sequence="xypr", workspace=WIDE, half_rotation=False)
    assert codec.action_sequence == "xypr"
    assert codec.theta_bounds == (-math.pi, math.pi) and codec.workspace_size == pytest.approx(0.3)
    assert make_codec().theta_bounds == (0.0, math.pi)
    assert make_codec({"workspace_size": 0.5}, workspace=WIDE).workspace_size == 0.5


COLOURS = ["heightmap", "color", "holding"]
SENSORS = [*COLOURS, "segmentation", {"name": "rgb", "size": 24}, "state"]
CNN = {"features_extractor_kwargs": {"channels": (4, 4, 4, 4, 8)}}


@pytest.mark.parametrize(
    ("policy", "observation", "policy_kwargs", "augmentation"),
    [
        ("MultiInputPolicy", SENSORS, CNN, "drq"),
        ("EquivariantPolicy", COLOURS, SMALL_EQUIVARIANT, {"rad": {"size": 32}}),
    ],
)
def test_sacfd_learns_from_colours_and_keeps_them_exactly(policy, observation, policy_kwargs, augmentation):
    env = gymnasium.make(PICKING, observation=observation, obs_size=48)
    kwargs = {"expert_episodes": 2, "batch_size": 8, "buffer_size": 100, "seed": 0}
    model = SACfD(policy, env, policy_kwargs=policy_kwargs, augmentation=augmentation, **kwargs)
    assert model.learn(4)._n_updates == 4
    table, (seen, _) = model.replay_buffer.table, env.reset(seed=5)
    row = table.heads[:1]
    table.write_observations(row, {name: values[None] for name, values in seen.items()})
    for name, values in table.read_observations(row).items():
        error = 0.2 / 255 if name == "heightmap" else 0
        np.testing.assert_allclose(values[0], seen[name], atol=error)
        assert values.dtype == seen[name].dtype
    assert model.predict(seen)[0].shape == env.action_space.shape
    env.close()
