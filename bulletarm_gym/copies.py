"""Pickles and copies of an environment."""

from collections.abc import Callable, Mapping
from copy import deepcopy
from typing import Any

import gymnasium
from gymnasium.envs.registration import EnvSpec

from bulletarm_gym.state import EnvState

Env = gymnasium.Env[Any, Any]

KEPT = ("action_space", "observation_space", "_np_random", "_np_random_seed")
"""Attributes with generators or seeds, which copies of an environment keep."""


def reduce_env(env: Env, arguments: Mapping[str, Any], state: EnvState | None) -> tuple[Any, ...]:
    """Return what ``__reduce__()`` returns for an environment.

    :param arguments: of the constructor
    :param state: state within an episode, None before the first
    """
    kept = {name: vars(env)[name] for name in KEPT if name in vars(env)}
    return _restore, (type(env), arguments, env.spec, state, kept)


def _restore(
    kind: Callable[..., Any],
    arguments: Mapping[str, Any],
    spec: EnvSpec | None,
    state: EnvState | None,
    kept: Mapping[str, Any],
) -> Any:
    env = kind(**arguments)
    env.spec = spec
    if state is not None:
        env.set_state(state)
    vars(env).update(deepcopy(dict(kept)))  # copy.copy() hands over the original's generators
    return env
