"""Metadata of an environment's actions: defaults for the arguments of policies, buffers and augmentations."""

import inspect
from collections.abc import Mapping
from typing import Any

from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.vec_env import VecEnv

SEQUENCE, RANGES = "action_sequence", "action_ranges"
"""Attributes of environments: a character for each number of an action, physical values of -1 and 1."""
GRID = "codec_kwargs"
"""Argument of policies with a grid of actions: arguments of a SpatialActionCodec."""


def constructor_arguments(cls: type[Any]) -> dict[str, inspect.Parameter]:
    """Return the keyword arguments of a constructor by name, and of its parent if it has ``**kwargs``."""
    found: dict[str, inspect.Parameter] = {}
    for parent in cls.__mro__:
        if "__init__" not in vars(parent):
            continue
        parameters = list(inspect.signature(vars(parent)["__init__"]).parameters.values())[1:]
        own = {p.name: p for p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)}
        found = {**own, **found}
        if all(p.kind is not p.VAR_KEYWORD for p in parameters):
            break
    return found


def env_attribute(env: VecEnv | None, name: str) -> Any:
    """Return an attribute of the first environment, None if it does not exist."""
    return env.get_attr(name, 0)[0] if env is not None and env.has_attr(name) else None


def action_sequence(env: VecEnv | None, action_space: spaces.Space[Any]) -> str | None:
    """Return the environment's ``action_sequence``, None if it does not describe the action space."""
    sequence = env_attribute(env, SEQUENCE)
    is_valid = isinstance(sequence, str) and len(sequence) == get_action_dim(action_space)
    return sequence if is_valid else None


def has_absolute_yaw(env: VecEnv | None) -> bool:
    """
    Return True if actions have a yaw in the world, the theta of open-loop actions.

    It changes when the scene is rotated. The r of a closed-loop action is relative to the gripper.
    """
    return "theta" in _ranges(env)


def _ranges(env: VecEnv | None) -> Mapping[str, Any]:
    attribute = env_attribute(env, RANGES)
    return attribute if isinstance(attribute, Mapping) else {}


def with_action_metadata(
    policy_class: type[Any], kwargs: Mapping[str, Any] | None, env: VecEnv | None, space: spaces.Space[Any]
) -> dict[str, Any]:
    """
    Add metadata of the environment's actions to the arguments of a policy that lack them.

    These are ``action_sequence`` and, for a policy with a grid of actions, the side of the workspace (m) and
    the bounds of theta and of the tilt (rad). The arguments of the user take precedence.

    :raises ValueError: if the policy rotates actions with the scene, but the actions have an absolute yaw
    """
    keys, passed, ranges = constructor_arguments(policy_class), dict(kwargs or {}), _ranges(env)
    if SEQUENCE in keys and GRID not in keys and has_absolute_yaw(env):
        raise ValueError(
            "policy must be 'MultiInputPolicy' for open-loop actions with a yaw, got "
            f"{policy_class.__name__}. Use SDQfD('EquivariantASRPolicy', ...) for an equivariant network"
        )
    if SEQUENCE in keys and (sequence := action_sequence(env, space)) is not None:
        passed.setdefault(SEQUENCE, sequence)
    if GRID in keys and ranges:
        grid: dict[str, Any] = {}
        if "x" in ranges:
            grid["workspace_size"] = ranges["x"][1] - ranges["x"][0]
        if "theta" in ranges:
            grid["theta_bounds"] = tuple(ranges["theta"])
        if "phi" in ranges:
            grid["tilt_bound"] = ranges["phi"][1]
        passed[GRID] = {**grid, **(passed.get(GRID) or {})}
    return passed
