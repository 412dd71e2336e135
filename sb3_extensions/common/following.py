"""What an environment tells of its actions, for policies and buffers that are told nothing else."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any

from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.vec_env import VecEnv

SEQUENCE, RANGES = "action_sequence", "action_ranges"
"""Attributes of environments: a character for each number of an action, and what -1 and 1 of it stand for."""
GRID = "codec_kwargs"  # of policies: arguments of a SpatialActionCodec


def constructor_keys(cls: type[Any]) -> set[str]:
    """
    Names that a constructor takes, up through its parents as long as it passes ``**kwargs`` on.

    :param cls: the class
    :return: names of its keyword arguments
    """
    keys: set[str] = set()
    for parent in cls.__mro__:
        if "__init__" not in vars(parent):
            continue
        parameters = list(inspect.signature(vars(parent)["__init__"]).parameters.values())[1:]
        keys |= {p.name for p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)}
        if all(p.kind is not p.VAR_KEYWORD for p in parameters):
            break
    return keys


def follow_sequence(
    cls: type[Any], kwargs: Mapping[str, Any] | None, env: VecEnv | None, action_space: spaces.Space[Any]
) -> dict[str, Any]:
    """
    Arguments of a policy or a replay buffer with the environment's ``action_sequence``: which numbers turn
    with the scene.

    :param cls: whose arguments
    :param kwargs: as they were given; an ``action_sequence`` among them stays
    :param env: the environments, if there are any
    :param action_space: one that a wrapper has made smaller or larger is not the sequence's
    :return: a copy, with the sequence if the class takes one and the environments have it
    """
    given = dict(kwargs or {})
    if SEQUENCE in given or SEQUENCE not in constructor_keys(cls):
        return given
    sequence = _told(env, SEQUENCE)
    fits = isinstance(sequence, str) and len(sequence) == get_action_dim(action_space)
    return {**given, SEQUENCE: sequence} if fits else given


def check_rotation(policy_class: type[Any], env: VecEnv | None) -> None:
    """
    Check that a policy which rotates its actions with the scene suits the environment.

    The theta of an open-loop action is the yaw in the world: it changes when the scene is rotated. The r of a
    closed-loop action is a rotation relative to the gripper, which does not.

    :param policy_class: class of the policy
    :param env: environments, if there are any
    :raises ValueError: the actions are open-loop ones with a yaw
    """
    keys = constructor_keys(policy_class)
    ranges = _told(env, RANGES)
    if SEQUENCE in keys and GRID not in keys and isinstance(ranges, Mapping) and "theta" in ranges:
        raise ValueError(
            "policy must be 'MultiInputPolicy' for open-loop actions with a yaw, got "
            f"{policy_class.__name__}. Use SDQfD('EquivariantASRPolicy', ...) for an equivariant network"
        )


def follow_ranges(cls: type[Any], kwargs: Mapping[str, Any] | None, env: VecEnv | None) -> dict[str, Any]:
    """
    Arguments of a policy with a grid over the environment's ``action_ranges``: from names (x, theta, phi)
    to what -1 and 1 stand for, m and rad.

    :param cls: the policy's class
    :param kwargs: as they were given; what ``codec_kwargs`` say stays
    :param env: the environments, if there are any
    :return: a copy, with the side of the workspace, yaws and tilt if there is a grid and they are told
    """
    given = dict(kwargs or {})
    ranges = _told(env, RANGES) if GRID in constructor_keys(cls) else None
    if not isinstance(ranges, Mapping):
        return given
    told: dict[str, Any] = {}
    if "x" in ranges:
        told["workspace_size"] = ranges["x"][1] - ranges["x"][0]
    if "theta" in ranges:
        told["theta_bounds"] = tuple(ranges["theta"])
    if "phi" in ranges:
        told["tilt_bound"] = ranges["phi"][1]
    return {**given, GRID: {**told, **(given.get(GRID) or {})}}


def _told(env: VecEnv | None, name: str) -> Any:
    """An attribute of the first environment, None where it has none."""
    return env.get_attr(name, 0)[0] if env is not None and env.has_attr(name) else None
