"""Metadata of an environment's actions: defaults for the arguments of policies, buffers and augmentations."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any

from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.vec_env import VecEnv

SEQUENCE, RANGES = "action_sequence", "action_ranges"
"""Attributes of environments: a character for each number of an action, physical values of -1 and 1."""
GRID = "codec_kwargs"
"""Argument of policies: arguments of a SpatialActionCodec."""


def constructor_keys(cls: type[Any]) -> set[str]:
    """
    Return the keyword arguments of a constructor, with those of its parents as long as it passes ``**kwargs``
    on.

    :param cls: the class
    :return: names
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


def env_attribute(env: VecEnv | None, name: str) -> Any:
    """
    Return an attribute of the first environment.

    :param env: vector environment, or None
    :param name: name of the attribute
    :return: its value, None if there is no such attribute
    """
    return env.get_attr(name, 0)[0] if env is not None and env.has_attr(name) else None


def action_sequence(env: VecEnv | None, action_space: spaces.Space[Any]) -> str | None:
    """
    Return the environment's ``action_sequence`` if it describes the action space.

    :param env: vector environment, or None
    :param action_space: action space, which a wrapper may have changed
    :return: one character for each number of an action, or None
    """
    sequence = env_attribute(env, SEQUENCE)
    fits = isinstance(sequence, str) and len(sequence) == get_action_dim(action_space)
    return sequence if fits else None


def with_action_sequence(
    cls: type[Any], kwargs: Mapping[str, Any] | None, env: VecEnv | None, action_space: spaces.Space[Any]
) -> dict[str, Any]:
    """
    Add the environment's ``action_sequence`` to arguments that lack it.

    :param cls: class with the arguments
    :param kwargs: arguments of the user
    :param env: vector environment, or None
    :param action_space: action space
    :return: a copy of the arguments
    """
    passed = dict(kwargs or {})
    sequence = action_sequence(env, action_space)
    if SEQUENCE in passed or sequence is None or SEQUENCE not in constructor_keys(cls):
        return passed
    return {**passed, SEQUENCE: sequence}


def check_rotation(policy_class: type[Any], env: VecEnv | None) -> None:
    """
    Check that a policy that rotates actions with the scene suits the environment.

    The theta of an open-loop action is the yaw in the world, which changes when the scene is rotated. The r
    of a closed-loop action is relative to the gripper and does not change.

    :param policy_class: class of the policy
    :param env: vector environment, or None
    :raises ValueError: if the actions are open-loop ones with a yaw
    """
    keys = constructor_keys(policy_class)
    ranges = env_attribute(env, RANGES)
    if SEQUENCE in keys and GRID not in keys and isinstance(ranges, Mapping) and "theta" in ranges:
        raise ValueError(
            "policy must be 'MultiInputPolicy' for open-loop actions with a yaw, got "
            f"{policy_class.__name__}. Use SDQfD('EquivariantASRPolicy', ...) for an equivariant network"
        )


def with_action_grid(cls: type[Any], kwargs: Mapping[str, Any] | None, env: VecEnv | None) -> dict[str, Any]:
    """
    Add the environment's ``action_ranges`` to the arguments of a policy with a grid of actions.

    :param cls: class of the policy
    :param kwargs: arguments of the user; their ``codec_kwargs`` take precedence
    :param env: vector environment, or None
    :return: a copy with the side of the workspace (m), the bounds of theta and of the tilt (rad)
    """
    passed = dict(kwargs or {})
    ranges = env_attribute(env, RANGES) if GRID in constructor_keys(cls) else None
    if not isinstance(ranges, Mapping):
        return passed
    grid: dict[str, Any] = {}
    if "x" in ranges:
        grid["workspace_size"] = ranges["x"][1] - ranges["x"][0]
    if "theta" in ranges:
        grid["theta_bounds"] = tuple(ranges["theta"])
    if "phi" in ranges:
        grid["tilt_bound"] = ranges["phi"][1]
    return {**passed, GRID: {**grid, **(passed.get(GRID) or {})}}
