"""Policies of spatial Q algorithms: actions on the grid, saved alone, quiet before they are trained."""

import functools
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces

import bulletarm_gym  # noqa: F401  registers the environments
from sb3_extensions.spatial_dqn import (
    EquivariantASRPolicy,
    FCNPolicy,
    SpatialDQN,
)
from sb3_extensions.spatial_dqn.policies import SpatialPolicy

REAL = {
    "pxy": "BulletArm/OpenLoopBlockStacking-v0",
    "pxyr": "BulletArm/OpenLoopBlockStacking-v0",
    "pxyzrrr": "BulletArm/OpenLoopRampBlockStacking-v0",
}


def make_policy(env: Any, name: str, **kwargs: Any) -> SpatialPolicy:
    th.manual_seed(0)
    policy = SpatialDQN.policy_aliases[name](
        env.observation_space, env.action_space, lambda _: 1e-3, **kwargs
    )
    assert isinstance(policy, SpatialPolicy)
    return policy


@pytest.mark.parametrize("units", [(-1.0, 1.0), (2.0, 5.0)])
def test_predicted_actions_are_on_the_grid(
    case: Any, units: tuple[float, float], make_picking: Any, make_policy_kwargs: Any
) -> None:
    low, high = units
    env = make_picking(4, action_sequence=case[1], low=low, high=high)
    policy = make_policy(env, case[0], **make_policy_kwargs(*case))
    observation = env.reset()
    observation["holding"][1::2] = 1.0
    actions, _ = policy.predict(observation)
    assert actions.dtype == np.float32 and actions.shape == (4, len(case[1]))
    assert all(env.action_space.contains(action) for action in actions)
    scaled = 2 * (actions - low) / (high - low) - 1
    np.testing.assert_allclose(policy.codec.snap(scaled), scaled, atol=1e-6)
    assert policy.codec.places(scaled).tolist() == [False, True, False, True]
    # Compare with the actions that the environment decodes.
    indices, _ = policy.q_net.greedy(policy.obs_to_tensor(observation)[0])
    for action, (row, column, *others) in zip(actions, indices.numpy(), strict=True):
        [to] = env.env_method("decode_action", action, indices=0)
        np.testing.assert_allclose([to["x"], to["y"]], (np.array([row, column]) + 0.5) * 0.4 / 32, atol=1e-6)
        for (name, grid), index in zip(policy.codec.grids.items(), others, strict=True):
            np.testing.assert_allclose(to[name], grid[index], atol=1e-6)
    alone, _ = policy.predict({key: value[1] for key, value in observation.items()})
    np.testing.assert_array_equal(alone, actions[1])
    np.testing.assert_array_equal(policy.predict(observation, deterministic=False)[0], actions)


def test_saved_policy_has_the_same_actions(
    case: Any, make_picking: Any, make_policy_kwargs: Any, tmp_path: Path
) -> None:
    env = make_picking(3, action_sequence=case[1])
    policy = make_policy(env, case[0], **make_policy_kwargs(*case))
    policy.save(str(tmp_path / "policy"))
    th.manual_seed(1)
    loaded = type(policy).load(str(tmp_path / "policy"), device="cpu")
    observation = env.reset()
    np.testing.assert_array_equal(policy.predict(observation)[0], loaded.predict(observation)[0])
    for name, value in policy.state_dict().items():
        assert th.equal(value, loaded.state_dict()[name]), name
    for name, value in policy._get_constructor_parameters().items():
        if name != "lr_schedule":
            assert loaded._get_constructor_parameters()[name] == value, name


def test_target_network_is_a_frozen_copy(case: Any, make_picking: Any, make_policy_kwargs: Any) -> None:
    policy = make_policy(make_picking(action_sequence=case[1]), case[0], **make_policy_kwargs(*case))
    state, target = policy.q_net.state_dict(), policy.q_net_target.state_dict()
    assert state.keys() == target.keys()
    for name, value in state.items():
        assert th.equal(value, target[name])
        assert value.numel() == 0 or value.data_ptr() != target[name].data_ptr()
    assert not any(parameter.requires_grad for parameter in policy.q_net_target.parameters())
    [group] = policy.optimizer.param_groups
    assert [id(p) for p in group["params"]] == [id(p) for p in policy.q_net.parameters()]
    policy.set_training_mode(True)
    assert policy.q_net.training and not policy.q_net_target.training


@functools.cache
def real_observations(sequence: str) -> tuple[Any, dict[str, th.Tensor]]:
    """Return the environment and observations before and after a pick of the expert."""
    env = gym.make(REAL[sequence], obs_size=48, in_hand_size=12, action_sequence=sequence)
    seen = []
    for seed in range(3):
        seen.append(env.reset(seed=seed)[0])
        seen.append(env.step(env.unwrapped.expert_action())[0])  # type: ignore[attr-defined]
    env.close()
    assert any(observation["holding"][0] for observation in seen)
    return env, {key: th.as_tensor(np.stack([one[key] for one in seen])) for key in seen[0]}


@pytest.mark.parametrize("standardise", [(0.0, 1.0), (0.05, 0.01)])
def test_untrained_values_are_small(case: Any, standardise: Any, make_policy_kwargs: Any) -> None:
    env, observations = real_observations(case[1])
    policy = make_policy(env, case[0], **make_policy_kwargs(*case, standardise=standardise))
    indices, _ = policy.q_net.greedy(observations)
    for level in policy.q_net.values(observations, indices):
        assert level.abs().max() < 1.0
        assert level.std() > 0.0


def test_values_of_yaws_differ_before_training(make_policy_kwargs: Any) -> None:
    """A filter made of an encoding of centimetres must not silence the level behind it."""
    env, observations = real_observations("pxyr")
    kwargs = make_policy_kwargs("EquivariantASRPolicy", standardise=(0.0, 1.0))
    policy = make_policy(env, "EquivariantASRPolicy", **kwargs)
    highest = observations["heightmap"].flatten(1).argmax(dim=1)
    indices = th.stack([highest // 48, highest % 48, th.zeros_like(highest)], dim=1)
    with th.no_grad():
        pixels, yaws = policy.q_net.values(observations, indices)
    assert yaws.std(dim=1).mean() > 0.01 * pixels.std(dim=1).mean()


def test_values_are_not_rounded_to_bfloat16(
    case: Any, make_policy_kwargs: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Values rounded to bfloat16 are equal at several pixels, so that the best one is arbitrary."""
    monkeypatch.setattr("sb3_extensions.encoders.cnn.has_bf16", lambda device_type: True)
    env, observations = real_observations(case[1])
    policy = make_policy(env, case[0], **make_policy_kwargs(*case, autocast="bf16"))
    with th.no_grad():
        indices, _ = policy.q_net.greedy(observations)
        for level in policy.q_net.values(observations, indices):
            assert level.dtype == th.float32
            values = level[level != 0.0]  # narrow layers may be silent
            assert (values != values.bfloat16().float()).float().mean() > 0.5


@pytest.mark.parametrize("side", [6, 11, 20, 41])
def test_in_hand_images_of_any_size(side: int, make_picking: Any, make_policy_kwargs: Any) -> None:
    env = make_picking(2, in_hand_size=side)
    for name in SpatialDQN.policy_aliases:
        kwargs = make_policy_kwargs(name)
        if name == "EquivariantASRPolicy" and side > 12:
            kwargs["network_kwargs"] = {**kwargs["network_kwargs"], "patch_fields": [4, 4, 8, 8, 4]}
        policy = make_policy(env, name, **kwargs)
        assert policy.predict(env.reset())[0].shape == (2, 4)


@pytest.mark.parametrize("sequence", ["pxy", "pxyz", "yxzr"])
def test_levels_follow_the_action_sequence(sequence: str, make_picking: Any, make_policy_kwargs: Any) -> None:
    """Also of others than the paper's."""
    env = make_picking(2, action_sequence=sequence)
    for name in ("ASRPolicy", "EquivariantASRPolicy"):
        policy = make_policy(env, name, **make_policy_kwargs(name, sequence))
        assert [level.name for level in policy.q_net.levels] == list(policy.codec.grids)
        assert policy.predict(env.reset())[0].shape == (2, len(sequence))


BOX = spaces.Box(-1.0, 1.0, (4,), np.float32)


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        (
            "FCNPolicy",
            {"action_sequence": "pxy"},
            r"bounded Box of 3 numbers for action_sequence='pxy', got",
        ),
        ("FCNPolicy", {"action_sequence": "pxrr"}, "action_sequence must .*, got 'pxrr'"),
        ("FCNPolicy", {"action_space": spaces.Box(-np.inf, 1.0, (4,))}, "must be a bounded Box of 4 numbers"),
        ("FCNPolicy", {"action_space": spaces.Box(-1.0, 1.0, (2, 2))}, "must be a bounded Box of 4 numbers"),
        ("FCNPolicy", {"observation_space": BOX}, r"a Dict with a heightmap \(1, size, size\)"),
        ("FCNPolicy", {"image_key": "depth"}, "under 'depth'"),
        ("FCNPolicy", {"autocast": "fp16"}, "autocast must be None or"),
        ("FCNPolicy", {"codec_kwargs": {"num_tilts": 0}}, "num_tilts must be positive"),
        ("EquivariantASRPolicy", {"in_hand_size": 20}, "patch_fields must have 5 entries .* 20 pixels"),
        ("FCNPolicy", {"sequence": "pxyzrrr"}, r"got levels for \['theta'\]"),
        (
            "RotFCNPolicy",
            {"sequence": "pxyz"},
            r"needs levels for \['z'\] after the pixel, got levels for \[\]",
        ),
    ],
)
def test_invalid_arguments_are_rejected(
    name: str, changes: dict[str, Any], message: str, make_picking: Any, make_policy_kwargs: Any
) -> None:
    changes = dict(changes)
    sequence, side = changes.pop("sequence", "pxyr"), changes.pop("in_hand_size", 12)
    env = make_picking(action_sequence=sequence, in_hand_size=side)
    env_spaces = {"observation_space": env.observation_space, "action_space": env.action_space}
    kwargs = {**env_spaces, **make_policy_kwargs(name, sequence), **changes}
    with pytest.raises(ValueError, match=message):
        SpatialDQN.policy_aliases[name](lr_schedule=lambda _: 1e-3, **kwargs)


def test_default_widths_are_the_authors() -> None:
    """The first layers of each network; the others follow from them."""
    space = spaces.Dict({name: spaces.Box(0.0, 0.4, shape, np.float32) for name, shape in SHAPES.items()})
    actions = spaces.Box(-1.0, 1.0, (3,), np.float32)
    plain = FCNPolicy(space, actions, lambda _: 1e-4, action_sequence="pxy")
    sizes = [
        tuple(layer.weight.shape[:2]) for layer in plain.q_net.modules() if isinstance(layer, th.nn.Conv2d)
    ]
    assert sizes[:3] == [(64, 1), (128, 64), (256, 128)] and sizes[-1] == (2, 32)
    steerable = EquivariantASRPolicy(space, actions, lambda _: 1e-4, action_sequence="pxy")
    assert steerable.q_net.pixel_maps.encoding_shape == (128, 2, 2)


SHAPES = {"heightmap": (1, 32, 32), "in_hand": (1, 24, 24), "holding": (1,)}
