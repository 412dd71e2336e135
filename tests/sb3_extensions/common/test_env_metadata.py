"""Metadata of an environment's actions as defaults of policies."""

from __future__ import annotations

import math
from typing import Any

import gymnasium
import pytest

import bulletarm_gym  # noqa: F401 (registers the environments)
from sb3_extensions.sacfd import SACfD
from sb3_extensions.spatial_dqn import SpatialDQN

PICKING, STACKING = "BulletArm/CloseLoopBlockPicking-v0", "BulletArm/OpenLoopBlockStacking-v0"
SMALL = {"features_extractor_kwargs": {"n": 4, "channels": [4, 4, 4, 4, 4]}}
WIDE = [[0.3, 0.6], [-0.15, 0.15], [0.0, 1.0]]


def make_sacfd(env, **policy_kwargs) -> SACfD:
    return SACfD("EquivariantPolicy", env, buffer_size=100, policy_kwargs={**SMALL, **policy_kwargs})


def make_codec(policy_kwargs: dict[str, Any] | None = None, **env_kwargs):
    env = gymnasium.make(STACKING, obs_size=32, in_hand_size=16, **env_kwargs)
    network = {"channels": [4, 4, 4], "in_hand_channels": [4, 4, 4]}
    kwargs = {"network_kwargs": network, **(policy_kwargs or {})}
    return SpatialDQN("FCNPolicy", env, buffer_size=100, policy_kwargs=kwargs).codec


def test_policy_adopts_the_action_sequence_of_the_environment():
    env = gymnasium.make(PICKING, obs_size=64, action_sequence="xyzpr")
    assert make_sacfd(env).policy.action_sequence == "xyzpr"
    assert make_sacfd(env, action_sequence="pxyzr").policy.action_sequence == "pxyzr"
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (4,))
    shorter = gymnasium.wrappers.TransformAction(env, lambda action: [*action, 0.0], action_space)
    with pytest.raises(ValueError, match=r"action_sequence must .*, got 'pxyzr'"):
        make_sacfd(shorter)
    make_sacfd(shorter, action_sequence="pxyz")


def test_grid_adopts_the_action_ranges():
    codec = make_codec(action_sequence="xypr", workspace=WIDE, half_rotation=False)
    assert codec.action_sequence == "xypr"
    assert codec.theta_bounds == (-math.pi, math.pi)
    assert codec.workspace_size == pytest.approx(0.3)
    assert make_codec().theta_bounds == (0.0, math.pi)
    assert make_codec({"codec_kwargs": {"workspace_size": 0.5}}, workspace=WIDE).workspace_size == 0.5
