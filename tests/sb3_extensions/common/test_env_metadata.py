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


def make_sacfd(policy_kwargs: dict[str, Any], **env_kwargs: Any) -> SACfD:
    env = gymnasium.make(PICKING, obs_size=64, **env_kwargs)
    return SACfD("EquivariantPolicy", env, buffer_size=100, policy_kwargs={**SMALL, **policy_kwargs})


def make_dqn(policy_kwargs: dict[str, Any] | None = None, **env_kwargs: Any) -> SpatialDQN:
    env = gymnasium.make(STACKING, obs_size=32, in_hand_size=16, **env_kwargs)
    network = {"channels": [4, 4, 4], "in_hand_channels": [4, 4, 4]}
    kwargs = {"network_kwargs": network, **(policy_kwargs or {})}
    return SpatialDQN("FCNPolicy", env, buffer_size=100, policy_kwargs=kwargs)


@pytest.mark.parametrize("sequence", ["xyzpr", "rzyxp"])
def test_policy_adopts_the_action_sequence_of_the_environment(sequence: str) -> None:
    assert make_sacfd({}, action_sequence=sequence).policy.action_sequence == sequence


def test_policy_kwargs_take_precedence() -> None:
    assert make_sacfd({"action_sequence": "pxyzr"}, action_sequence="xyzpr").policy.action_sequence == "pxyzr"
    codec = make_dqn({"codec_kwargs": {"workspace_size": 0.5}}, workspace=WIDE).codec
    assert codec.workspace_size == 0.5


def test_grid_adopts_the_action_ranges() -> None:
    codec = make_dqn(action_sequence="xypr", workspace=WIDE, half_rotation=False).codec
    assert codec.action_sequence == "xypr"
    assert codec.theta_bounds == (-math.pi, math.pi)
    assert codec.workspace_size == pytest.approx(0.3)
    assert make_dqn().codec.theta_bounds == (0.0, math.pi)


def test_action_sequence_of_another_length_is_not_adopted() -> None:
    env = gymnasium.make(PICKING, obs_size=64)
    shorter = gymnasium.wrappers.TransformAction(
        env, lambda action: [*action, 0.0], gymnasium.spaces.Box(-1.0, 1.0, (4,))
    )
    with pytest.raises(ValueError, match=r"action_sequence must .*, got 'pxyzr'"):
        SACfD("EquivariantPolicy", shorter, buffer_size=100, policy_kwargs=SMALL)
    named = {**SMALL, "action_sequence": "pxyz"}
    assert SACfD("EquivariantPolicy", shorter, buffer_size=100, policy_kwargs=named).action_space.shape == (
        4,
    )
