"""One limit on the length of episodes: the environment's own.

``gymnasium.make(id, max_episode_steps=n)`` wraps an environment in ``TimeLimit``, which can shorten the limit
that the environment has, but not extend it; which calls a success at the limit truncated, too; and whose
count of steps does not follow ``set_state()``. So the first wrapper that each id names takes ``TimeLimit``
away again and tells the environment; nothing of it stays but its name in the spec.

``max_episode_steps=-1`` removes the limit.
"""

import sys
from dataclasses import replace
from typing import Any

import gymnasium
from gymnasium.envs.registration import WrapperSpec
from gymnasium.wrappers import TimeLimit

UNLIMITED = 2**31 - 1
"""Limit (steps) of an environment made with ``max_episode_steps=-1``."""


def wrapper_spec(known: int | None = None) -> WrapperSpec:
    """Return what an environment's spec says of :func:`own_time_limit`."""
    return WrapperSpec("own_time_limit", f"{__name__}:own_time_limit", {"known": known})


def own_time_limit(env: gymnasium.Env[Any, Any], known: int | None) -> gymnasium.Env[Any, Any]:
    """Return an environment without its ``TimeLimit``, whose limit becomes that of the environment itself.

    :param known: the limit that the spec of another environment says; that spec made anew,
        ``max_episode_steps`` is the same unless it is given, and ``max_steps`` may be given instead
    """
    core: Any = env.unwrapped
    spec = core.spec
    limit = known
    if isinstance(env, TimeLimit):
        limit, env = env._max_episode_steps, env.env
    elif sys._getframe(1).f_locals.get("max_episode_steps") == -1:  # make() leaves no other trace of it
        limit = UNLIMITED
    if limit is not None and limit != known:
        core.limit_steps(limit)
        spec = replace(spec, kwargs={**spec.kwargs, "max_steps": limit})
    if env is not core:
        # LeRobot looks for it with hasattr(), which does not look inside wrappers, and else passes no task.
        env.task_description = core.task_description  # type: ignore[attr-defined]
    core.spec = replace(spec, additional_wrappers=(wrapper_spec(core.config.max_steps),))
    return env
