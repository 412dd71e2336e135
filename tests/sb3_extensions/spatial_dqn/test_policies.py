"""Policies of spatial Q algorithms: actions on the grid, files, exported programs, untrained values."""

import functools

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces

import bulletarm_gym  # noqa: F401  registers the environments
from sb3_extensions.spatial_dqn import EquivariantASRPolicy, FCNPolicy, SpatialDQN


def test_predicted_actions_are_on_the_grid(case, make_picking, make_policy):
    """In an action space from 2 to 5."""
    env = make_picking(4, action_sequence=case[1], low=2.0, high=5.0)
    policy = make_policy(*case, env)
    observation = env.reset()
    observation["holding"][1::2] = 1.0
    actions, _ = policy.predict(observation)
    assert actions.dtype == np.float32 and actions.shape == (4, len(case[1]))
    assert all(env.action_space.contains(action) for action in actions)
    scaled = 2 * (actions - 2.0) / 3.0 - 1
    np.testing.assert_allclose(policy.codec.snap(scaled), scaled, atol=1e-6)
    assert policy.codec.places(scaled).tolist() == [False, True, False, True]
    indices, _ = policy.q_net.greedy(policy.obs_to_tensor(observation)[0])
    np.testing.assert_array_equal(policy.codec.encode(scaled), indices)
    alone, _ = policy.predict({key: value[1] for key, value in observation.items()})
    np.testing.assert_array_equal(alone, actions[1])
    np.testing.assert_array_equal(policy.predict(observation, deterministic=False)[0], actions)


def test_saved_policy_has_the_same_actions(policy, scenes, tmp_path):
    """Its target network is a frozen copy, and its weights are also restored from a vector."""
    policy.save(str(tmp_path / "policy"))
    loaded = type(policy).load(str(tmp_path / "policy"), device="cpu")
    assert th.equal(policy(scenes), loaded(scenes))
    for name, value in policy._get_constructor_parameters().items():
        assert name == "lr_schedule" or loaded._get_constructor_parameters()[name] == value, name
    vector = policy.parameters_to_vector()
    loaded.load_from_vector(np.zeros(len(vector), np.float32))
    loaded.load_from_vector(vector)
    assert th.equal(policy(scenes), loaded(scenes))
    for parameter in loaded.parameters():
        assert parameter.dim() != 4 or parameter.is_contiguous(memory_format=th.channels_last)
    pairs = zip(policy.q_net.parameters(), policy.q_net_target.parameters(), strict=True)
    assert all(th.equal(own, copy) and own is not copy and not copy.requires_grad for own, copy in pairs)
    policy.set_training_mode(True)
    assert policy.q_net.training and not policy.q_net_target.training


@pytest.mark.parametrize(
    "case",
    [
        ("EquivariantFCNPolicy", "pxyr"),
        ("ASRPolicy", "pxyr"),
        pytest.param(("RotFCNPolicy", "pxyr"), marks=pytest.mark.slow),
        pytest.param(("ASRPolicy", "pxyzrrr"), marks=pytest.mark.slow),
        pytest.param(("EquivariantASRPolicy", "pxyzrrr"), marks=pytest.mark.slow),
    ],
    indirect=True,
    ids=str,
)
@pytest.mark.filterwarnings("ignore")
def test_exported_programs_have_the_actions_of_the_policy(policy, scenes, tmp_path):
    """With torch.export, torch.jit, and, if it is installed, ONNX Runtime."""
    policy.set_training_mode(False)
    first, *others = ({name: part[[k]] for name, part in sorted(scenes.items())} for k in range(10))
    with th.no_grad():
        program = th.export.export(policy, (first,))
        traced = th.jit.trace(policy, (first,), check_trace=False, strict=False)
        actions = [policy(scene) for scene in (first, *others)]
        for exported in (program.module(), traced):
            found = [exported(scene) for scene in (first, *others)]
            th.testing.assert_close(th.cat(found), th.cat(actions))
    assert len(th.cat(actions).unique(dim=0)) > 1
    pytest.importorskip("onnxscript")
    onnxruntime = pytest.importorskip("onnxruntime")
    th.onnx.export(program, f=tmp_path / "policy.onnx", verbose=False)
    session = onnxruntime.InferenceSession(str(tmp_path / "policy.onnx"))
    names = [node.name for node in session.get_inputs()]
    for scene, action in zip((first, *others), actions, strict=True):
        inputs = dict(zip(names, (value.numpy() for value in scene.values()), strict=True))
        np.testing.assert_allclose(session.run(None, inputs)[0], action, atol=1e-6)


@functools.cache
def real_observations(sequence):
    """Return the environment and observations before and after a pick of the expert."""
    env_id = f"BulletArm/OpenLoop{'Ramp' if 'rrr' in sequence else ''}BlockStacking-v0"
    env = gym.make(env_id, obs_size=48, in_hand_size=12, action_sequence=sequence)
    seen = []
    for seed in range(3):
        seen.append(env.reset(seed=seed)[0])
        seen.append(env.step(env.unwrapped.expert_action())[0])
    env.close()
    assert any(observation["holding"][0] for observation in seen)
    return env, {key: th.as_tensor(np.stack([one[key] for one in seen])) for key in seen[0]}


def test_untrained_values_are_small_and_not_rounded_to_bfloat16(case, make_policy, monkeypatch):
    """Values rounded to bfloat16 are equal at several pixels, so that the best one is arbitrary."""
    monkeypatch.setattr("sb3_extensions.encoders.cnn.has_bf16", lambda device_type: True)
    env, observations = real_observations(case[1])
    policies = [make_policy(*case, env, standardise=(0.05, 0.01), autocast=dtype) for dtype in (None, "bf16")]
    exact, rounded = (policy.q_net for policy in policies)
    with th.no_grad():
        indices, _ = exact.greedy(observations)
        pairs = zip(exact.values(observations, indices), rounded.values(observations, indices), strict=True)
    for level, rounded_level in pairs:
        assert level.abs().max() < 1.0 and level.std() > 0.0 and rounded_level.dtype == th.float32
        assert (rounded_level - level).abs().max() < 0.1 * level.abs().max()
        values = rounded_level[rounded_level != 0.0]  # narrow layers may be silent
        assert (values != values.bfloat16().float()).float().mean() > 0.5


@pytest.mark.parametrize("side", [6, 20, 41])
def test_in_hand_images_of_any_size(side, make_picking, make_policy):
    env = make_picking(2, in_hand_size=side)
    for name in SpatialDQN.policy_aliases:
        networks = {"patch_fields": [4, 4, 8, 8, 4]} if name == "EquivariantASRPolicy" and side > 12 else {}
        assert make_policy(name, "pxyr", env, networks).predict(env.reset())[0].shape == (2, 4)


@pytest.mark.parametrize(
    ("name", "changes", "named"),
    [
        ("FCNPolicy", {"action_sequence": "pxy"}, "3 numbers for action_sequence='pxy'"),
        ("FCNPolicy", {"action_sequence": "pxrr"}, "got 'pxrr'"),
        ("FCNPolicy", {"action_space": spaces.Box(-np.inf, 1.0, (4,))}, "bounded Box of 4 numbers"),
        ("FCNPolicy", {"observation_space": spaces.Box(-1.0, 1.0, (4,))}, "a Dict with a heightmap"),
        ("EquivariantASRPolicy", {"in_hand_size": 24}, "patch_fields .* 5 entries .* 24"),
        ("FCNPolicy", {"sequence": "pxyzrrr"}, r"got levels for \['theta'\]"),
        ("RotFCNPolicy", {"sequence": "pxyz"}, r"\['z'\] .* got levels for \[\]"),
    ],
)
def test_invalid_arguments_are_rejected(name, changes, named, make_picking, make_policy):
    changes = dict(changes)
    sequence = changes.pop("sequence", "pxyr")
    env = make_picking(action_sequence=sequence, in_hand_size=changes.pop("in_hand_size", 12))
    with pytest.raises(ValueError, match=named):
        make_policy(name, sequence, env, **changes)


def test_patches_and_projections_are_in_the_units_of_the_authors(make_picking, make_policy):
    """In 6D in 1/300 m, like voxels of 3 mm."""
    scaled, metres = (
        make_policy("ASRPolicy", "pxyzrrr", standardise=(0.0, 1.0), patch_scale=scale)
        for scale in (None, 1.0)
    )
    scenes, _ = metres.obs_to_tensor(make_picking(2, action_sequence="pxyzrrr").reset())
    indices, _ = metres.q_net.greedy(scenes)
    for level, plain in zip(scaled.q_net.levels, metres.q_net.levels, strict=True):
        images = level.inputs(scaled.q_net.scene_view(scenes), indices)
        th.testing.assert_close(images, 300.0 * plain.inputs(metres.q_net.scene_view(scenes), indices))
    assert make_policy("ASRPolicy", "pxyr", patch_scale=None).q_net.scene_view.patch_scale == 1.0


def test_default_arguments_are_the_authors():
    """The first layers of each network; the others follow from them."""
    shapes = {"heightmap": (1, 32, 32), "in_hand": (1, 24, 24), "holding": (1,)}
    space = spaces.Dict({name: spaces.Box(0.0, 0.4, shape, np.float32) for name, shape in shapes.items()})
    actions = spaces.Box(-1.0, 1.0, (3,), np.float32)
    plain = FCNPolicy(space, actions, lambda _: 1e-4, action_sequence="pxy")
    layers = [layer for layer in plain.q_net.modules() if isinstance(layer, th.nn.Conv2d)]
    sizes = [tuple(layer.weight.shape[:2]) for layer in layers]
    assert sizes[:3] == [(64, 1), (128, 64), (256, 128)] and sizes[-1] == (2, 32)
    steerable = EquivariantASRPolicy(space, actions, lambda _: 1e-4, action_sequence="pxy")
    maps = steerable.q_net.pixel_maps
    assert maps.encoding_shape == (128, 2, 2)
    assert maps.unet.downs[1].skip.kernel_size == 3
    bound = (6.0 / (2 + 32)) ** 0.5
    assert 0.8 * bound < plain.q_net.pixel_maps.head.weight.abs().max() <= bound
    assert plain.optimizer.defaults["weight_decay"] == 1e-5
    other = FCNPolicy(space, actions, lambda _: 1e-4, action_sequence="pxy", optimizer_class=th.optim.Rprop)
    assert "weight_decay" not in other.optimizer.defaults
