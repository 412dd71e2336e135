"""What is asked of an environment, in this process or in another."""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium as gym
from stable_baselines3.common.env_util import is_wrapped

AnyEnv = gym.Env[Any, Any]


class Stepped(NamedTuple):
    """
    What a step returned, as Stable-Baselines3's vector environments have it.

    :param observation: the present one, of a new episode if one was over; None where it lies in shared memory
    :param reward: of the step
    :param done: whether an episode was over
    :param info: with ``"TimeLimit.truncated"`` and, at an end, ``"terminal_observation"``
    :param reset_info: of the new episode
    """

    observation: Any
    reward: float
    done: bool
    info: dict[str, Any]
    reset_info: dict[str, Any] | None


def step(env: AnyEnv, action: Any) -> Stepped:
    """
    Step an environment, and begin an episode where one is over.

    :param env: the environment
    :param action: its action
    :return: what it returned
    """
    observation, reward, terminated, truncated, info = env.step(action)
    done, reset_info = bool(terminated or truncated), None
    info["TimeLimit.truncated"] = truncated and not terminated
    if done:
        info["terminal_observation"] = observation
        observation, reset_info = env.reset()
    return Stepped(observation, float(reward), done, info, reset_info)


def reset(env: AnyEnv, seed: int | None, options: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
    """Begin an episode; without options, none are handed on."""
    return env.reset(seed=seed, **({"options": options} if options else {}))


def call(env: AnyEnv, name: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """Call a method of an environment or of one of its wrappers."""
    return env.get_wrapper_attr(name)(*args, **kwargs)


def get(env: AnyEnv, name: str) -> Any:
    """Return an attribute of an environment or of one of its wrappers."""
    return env.get_wrapper_attr(name)


def has(env: AnyEnv, name: str) -> bool:
    """Whether an environment or one of its wrappers has an attribute."""
    return env.has_wrapper_attr(name)


def put(env: AnyEnv, name: str, value: Any) -> None:
    """Set an attribute of the outermost wrapper."""
    setattr(env, name, value)


def wrapped(env: AnyEnv, wrapper: type[gym.Wrapper[Any, Any, Any, Any]]) -> bool:
    """Whether an environment has a wrapper of a kind."""
    return is_wrapped(env, wrapper)


def render(env: AnyEnv) -> Any:
    """Return a picture."""
    return env.render()
