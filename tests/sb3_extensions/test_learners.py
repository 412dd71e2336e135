"""Contract of the learners, and invalid arguments of components, refused with their name and value."""

import inspect
import math
from functools import partial

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecNormalize

import bulletarm_gym  # noqa: F401 (registers the environments)
from sb3_extensions.common.env_metadata import constructor_arguments
from sb3_extensions.encoders.extractors import CnnExtractor, EquivariantExtractor
from sb3_extensions.encoders.mlp_extractor import MlpExtractor
from sb3_extensions.encoders.observation import SceneView
from sb3_extensions.equivariant.groups import FieldType, Group
from sb3_extensions.equivariant.layers import EquivariantConv2d, EquivariantLinear, GroupMaxPool
from sb3_extensions.ferm import FERM
from sb3_extensions.replay.augmentation import RAD, Compose, DrQ
from sb3_extensions.replay.buffer import ExpertReplayBuffer
from sb3_extensions.replay.quantisation import Quantiser
from sb3_extensions.replay.rotation import Rotation, make_augmentation
from sb3_extensions.replay.sampling import PrioritizedSampler, ShareSampler
from sb3_extensions.sacfd import SACfD
from sb3_extensions.sacfd.policies import MultiInputPolicy
from sb3_extensions.spatial_dqn import SDQfD, SpatialDQN
from sb3_extensions.spatial_dqn.codec import SpatialActionCodec
from sb3_extensions.spatial_dqn.pixel_maps import EquivariantPixelMaps, PlainPixelMaps
from sb3_extensions.tqcfd import TQCfD

PARAMETERS = inspect.signature(SACfD).parameters
PICKING = "BulletArm/CloseLoopBlockPicking-v0"


def test_environments_by_id_and_normalised_environments(make_toy, make_learner):
    make_learner("ToyReach-v0").learn(3)
    for kwargs in ({"norm_obs": False}, {"norm_obs_keys": ["holding"]}):
        env = VecNormalize(make_toy(), **kwargs)
        buffer = make_learner(env).learn(3).replay_buffer
    # Statistics of five demonstrations, the reset and three steps
    assert env.obs_rms["holding"].count == pytest.approx(buffer.expert_size + 5 + 1 + 3, abs=0.01)
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
    model = make_learner(None, learner, gamma=0.5, bc_weight=0.5, augmentation={"rad": {"size": 12}})
    assert (model.gamma, model.bc_weight) == (0.5, 0.5)
    with pytest.raises(TypeError, match="gama"):
        make_learner(None, learner, gama=0.9)


def test_all_additions_are_off_by_default():
    """Arguments in addition to those of SAC and of the paper's SACfD."""
    papers = {"bc_weight", "expert_episodes", "expert_data", "augmentation"}
    additions = PARAMETERS.keys() - inspect.signature(SAC).parameters.keys() - papers
    assert additions == {"expert_noise", "pretrain_steps", "critic_warmup_steps"}
    assert not any(PARAMETERS[name].default for name in additions)


@pytest.mark.parametrize(
    ("kwargs", "named"),
    [
        ({"bc_weight": -1}, "bc_weight .* got -1"),
        ({"expert_episodes": -1}, "expert_episodes .* got -1"),
        ({"batch_size": 0}, "batch_size .* got 0"),
        ({"buffer_size": 1e3}, "buffer_size .* got 1000.0"),
        ({"gamma": 1.5}, "gamma .* got 1.5"),
        ({"tau": -0.1}, "tau .* got -0.1"),
        ({"ent_coef": "auto-0.1"}, "ent_coef .* got 'auto-0.1'"),
        ({"ent_coef": -0.1}, "ent_coef .* got -0.1"),
        ({"target_entropy": "low"}, "target_entropy .* got 'low'"),
        ({"pretrain_steps": 5, "expert_episodes": 0}, "pretrain_steps"),
        ({"learning_starts": -1}, "learning_starts .* got -1"),
        ({"gradient_steps": 1.5}, "gradient_steps .* integer .* got 1.5"),
        ({"replay_buffer_class": ReplayBuffer}, "replay_buffer_class"),
        ({"replay_buffer_class": "uniform"}, "replay_buffer_class .* got 'uniform'"),
        ({"replay_buffer_kwargs": {"gamma": 0.9}}, "gamma"),
        ({"replay_buffer_kwargs": {"image_dtype": "uint16"}}, "image_dtype='uint16'.*quantise='uint8'"),
        ({"pretrain_steps": 5, "bc_weight": 0}, "critic_warmup_steps"),
        ({"n_steps": 2.0}, "n_steps .* integer .* got 2.0"),
        ({"pretrain_steps": 2.5}, "pretrain_steps .* integer .* got 2.5"),
        ({"critic_warmup_steps": 1.5}, "critic_warmup_steps .* integer .* got 1.5"),
        ({"target_update_interval": 0}, "target_update_interval .* got 0"),
        ({"policy_kwargs": {"actor_tau": 1.5}}, "actor_tau .* got 1.5"),
        ({"augmentation": {"rad": {"size": 16}}}, "16 x 16"),
        ({"expert_noise": -0.1}, "expert_noise .* got -0.1"),
        ({"train_freq": 0}, "train_freq .* n_envs=1"),
        ({"learner": TQCfD, "top_quantiles_to_drop_per_net": 25}, "top_quantiles_to_drop_per_net"),
        ({"learner": TQCfD, "policy": SAC.policy_aliases["MultiInputPolicy"]}, "n_quantiles=1, got 2"),
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


def test_learn_has_the_parameters_of_stable_baselines3():
    ours, theirs = (list(inspect.signature(each.learn).parameters) for each in (SACfD, SAC))
    assert ours == theirs


@pytest.mark.parametrize("algorithm", [SACfD, SDQfD])
def test_an_unknown_policy_is_refused_with_the_known_ones(algorithm, make_toy):
    with pytest.raises(ValueError, match=f"policy .*{', '.join(algorithm.policy_aliases)}, got 'CnnPolicy'"):
        algorithm("CnnPolicy", make_toy())


@pytest.mark.parametrize("high", [0.4, np.inf])
def test_images_are_stored_exactly_without_quantisation(high, make_toy, make_learner):
    env = make_toy()
    env.observation_space["heightmap"] = spaces.Box(0.0, high, (1, 16, 16), np.float32)
    extractor = {"features_extractor_kwargs": {"channels": [4, 8, 8], "quantise": None}}
    model = make_learner(VecNormalize(env), policy_kwargs=extractor, expert_episodes=0)
    seen = [env.reset()["heightmap"][0]]
    model.learn(3, callback=lambda local, _: seen.append(env.buf_obs["heightmap"][0].copy()) or True)
    assert seen[1].any()
    np.testing.assert_array_equal(model.replay_buffer.table.observations["heightmap"][1:2], seen[1][None])


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
    with pytest.raises(ValueError, match=r"augmentation .*yaw, got Rotation"):
        make_learner(env, augmentation="rotation")


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


C4, C8, D4 = Group("cyclic", 4), Group("cyclic", 8), Group("dihedral", 4)


def box(*shape, low=0.0, high=0.4):
    return spaces.Box(low, high, shape, np.float32)


def scene(**others):
    return spaces.Dict({"heightmap": box(1, 16, 16), "holding": box(1), **others})


def fields(*entries):
    return FieldType.of(*((representation, 1) for representation in entries))


def numbers(space=None, **kwargs):
    return MlpExtractor(space or spaces.Dict({"state": box(7), "holding": box(1)}), **kwargs)


def buffer(size=50, space=None, **kwargs):
    return ExpertReplayBuffer(size, space or scene(), box(3, low=-1.0, high=1.0), **kwargs)


extractor = partial(EquivariantExtractor, scene())
codec = partial(SpatialActionCodec, 32)
plain_maps = partial(PlainPixelMaps, 32, (1, 12))
maps = partial(EquivariantPixelMaps, 32, None, C4)
MIXED = fields(D4.regular, D4.sign)
COLOUR = spaces.Box(0, 255, (3, 16, 16), np.uint8)
UNBOUNDED = box(1, 8, 8, high=np.inf)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: EquivariantExtractor(box(16, 16)), "must have images"),
        (lambda: EquivariantExtractor(spaces.Dict({"holding": box(1)})), "must have images StatePolicy"),
        (lambda: EquivariantExtractor(scene(in_hand=box(1, 8, 10))), "must have images"),
        (lambda: EquivariantExtractor(scene(points=box(100, 3))), "points"),
        (lambda: EquivariantExtractor(COLOUR, above_ground=(0.1, 0.1)), "above_ground 0.1"),
        (lambda: extractor(small_image_features=0), "small_image_features 0"),
        (lambda: extractor(quantise="int4"), "'int4'"),
        (lambda: extractor(channels=[4]), "channels 1"),
        (lambda: extractor(strided=3), "strided 3"),
        (lambda: extractor(autocast="fp16"), "autocast 'fp16'"),
        (lambda: extractor(group="square"), "group 'square'"),
        (lambda: extractor(n=0), "n 0"),
        (lambda: extractor(output="both"), "output 'both'"),
        (lambda: extractor(crop=20), "crop 20"),
        (lambda: extractor(standardise=(0.1, 0.0)), "standardise (0.1, 0.0)"),
        (lambda: extractor(above_ground=[0.1]), "above_ground [0.1]"),
        (lambda: extractor(compile=True), "compile no-such-compiler"),
        (lambda: numbers(scene()), "'heightmap'"),
        (lambda: numbers(spaces.Dict({"kind": spaces.Discrete(3)})), "'kind' Discrete"),
        (lambda: numbers(layers=[64, 0]), "layers [64, 0]"),
        (lambda: numbers(standardise=[0.0, 0.0]), "standardise [0.0, 0.0]"),
        (lambda: FieldType.of((C4.regular, 1), (C8.regular, 1)), "same group"),
        (lambda: FieldType.of((C4.regular, 0)), "at least one field"),
        (lambda: D4.quotient(3), "m 3"),
        (lambda: GroupMaxPool(MIXED), "regular fields"),
        (lambda: EquivariantLinear(fields(C4.regular), fields(C8.regular)), "group"),
        (lambda: EquivariantLinear(fields(D4.trivial), fields(D4.sign)), "commutes"),
        (lambda: EquivariantConv2d(MIXED, MIXED, 0), "kernel_size 0"),
        (
            lambda: RAD(12).with_crop({"features_extractor_class": MlpExtractor}),
            "features_extractor_class crop 12 MlpExtractor",
        ),
        (lambda: Rotation().check(spaces.Dict({"image": box(1, 4, 5)})), "observation_space images"),
        (lambda: DrQ().check(box(1, 4, 5)), "observation_space images (1, 4, 5)"),
        (lambda: make_augmentation("rda"), "augmentation rotation, rad, drq, 'rda'"),
        (lambda: make_augmentation({"rad": {"sise": 3}}), "augmentation sise"),
        (lambda: make_augmentation({"rad": {"size": 0}}), "size 0"),
        (lambda: make_augmentation({"rad": {"size": 12}, "drq": {}}), "augmentation RAD DrQ"),
        (lambda: Compose((DrQ(), Rotation())), "augmentation DrQ Rotation"),
        (lambda: make_augmentation({"drq": {"pad": 1.5}}), "pad integer 1.5"),
        (lambda: Rotation(probability=1.5), "probability 1.5"),
        (lambda: Rotation(action_sequence="pz"), "action_sequence 'pz'"),
        (lambda: buffer(n_steps=0), "n_steps 0"),
        (lambda: buffer(n_steps=3), "gamma None"),
        (lambda: buffer(optimize_memory_usage=True), "optimize_memory_usage True"),
        (lambda: buffer(sampler={"shares": {"expert_fraction": 1.5}}), "expert_fraction 1.5"),
        (lambda: buffer(sampler="best"), "sampler uniform, shares, prioritized, 'best'"),
        (lambda: buffer(image_dtype="float32"), "dtype 'float32'"),
        (lambda: buffer(size=1), "buffer_size 1"),
        (lambda: buffer(space=spaces.Discrete(3)), "Box Discrete"),
        (lambda: Quantiser(UNBOUNDED), "finite bounds"),
        (lambda: Quantiser(box(1, 4, 4, low=-3e38, high=3e38)), "finite bounds"),
        (lambda: Quantiser(box(1, 4, 4, low=1.0, high=1.0)), "low < high"),
        (lambda: Quantiser(box(1, 4, 4, low=1000.0, high=1000.01), "uint16"), "too narrow"),
        (lambda: ShareSampler(balanced_from=1.5), "balanced_from integer 1.5"),
        (lambda: PrioritizedSampler(exponent=1.5), "exponent 1.5"),
        (lambda: PrioritizedSampler(expert_bonus=-1.0), "expert_bonus -1"),
        (lambda: codec(num_tilts=0), "num_tilts 0"),
        (lambda: codec(num_rotations=4.0), "num_rotations integer 4.0"),
        (lambda: codec(workspace_size=0.0), "workspace_size 0"),
        (lambda: codec(heights=(0.1, 0.05)), "heights 0.05"),
        (lambda: codec(tilt=1.0), "tilt 1.0"),
        (lambda: codec(theta_bounds=(0.0, 1.0)), "theta_bounds 1.0"),
        (lambda: codec("pxr"), "action_sequence 'pxr'"),
        (lambda: codec("xyrrrr"), "action_sequence 'xyrrrr'"),
        (lambda: plain_maps([8]), "two levels, [8]"),
        (lambda: plain_maps([4, 6, 8], [4, 4]), "in_hand_channels 3 [4, 4]"),
        (lambda: maps([4, 4, 6], rotations=4), "group 8 rotations"),
        (lambda: maps([4, 4, 6], dynamic_fields=0), "dynamic_fields 0"),
        (lambda: SceneView(box(1, 16, 16)), "'heightmap' Box"),
        (lambda: SceneView(scene(), image_key="depth"), "'depth'"),
        (lambda: SceneView(scene(heightmap=box(3, 16, 16))), "heightmap"),
        (lambda: SceneView(scene(in_hand=box(12))), "must have images, in_hand"),
    ],
)
def test_invalid_arguments_are_refused(make, words, monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler")
    with pytest.raises(ValueError) as refusal:
        make()
    assert all(word in str(refusal.value) for word in words.split()), refusal.value


@pytest.mark.parametrize("saved", [0.5, "auto"])
@pytest.mark.parametrize("ent_coef", [0.1, "auto_0.1"])
def test_load_replaces_the_entropy_coefficient(saved, ent_coef, make_learner, make_toy, tmp_path):
    make_learner(ent_coef=saved).save(tmp_path / "model")
    loaded = SACfD.load(tmp_path / "model", env=make_toy(), device="cpu", ent_coef=ent_coef)
    is_learned = loaded.ent_coef_optimizer is not None
    value = loaded.log_ent_coef.exp() if is_learned else loaded.ent_coef_tensor
    assert is_learned == (ent_coef == "auto_0.1") and value.item() == pytest.approx(0.1)
    loaded.learn(1)
