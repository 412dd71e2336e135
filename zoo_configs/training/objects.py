"""Python objects for YAML hyperparameters: schedules, classes, wrappers, callbacks, noise, environments."""

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecFrameStack, VecNormalize

from zoo_configs.algorithms import callable_from_path, class_from_path

TRAINER_KEYS = (
    *("env_kwargs", "env_wrapper", "frame_stack", "monitor_kwargs", "normalize", "vec_env_wrapper"),
    *("callback", "n_envs", "n_timesteps", "noise_std", "noise_type"),
)
"""Hyperparameters that are not constructor arguments of an algorithm, with rl_zoo3's names."""
SCHEDULES = ("learning_rate", "clip_range", "clip_range_vf", "delta_std")
SCHEDULE = re.compile(r"(lin_)(.+)")
"""Value that falls linearly to zero, with rl_zoo3's spelling."""
EVALUATED = (
    *("monitor_kwargs", "normalize", "policy_kwargs", "replay_buffer_class", "replay_buffer_kwargs"),
    *("rollout_buffer_class", "rollout_buffer_kwargs"),
)
"""Hyperparameters that rl_zoo3's files write as Python expressions, such as ``dict(net_arch=[64])``."""
NAMES: dict[str, Any] = {"__builtins__": {}, "dict": dict, "nn": th.nn, "th": th}
NAMES |= {"HerReplayBuffer": HerReplayBuffer, "RMSpropTFLike": RMSpropTFLike}
"""Names that such an expression can use."""
DOTTED_PATH = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)+")
NOISES: dict[str, Any] = {"normal": NormalActionNoise, "ornstein-uhlenbeck": OrnsteinUhlenbeckActionNoise}
VEC_ENVS: dict[str, type[DummyVecEnv | SubprocVecEnv]] = {"dummy": DummyVecEnv, "subproc": SubprocVecEnv}


class LinearSchedule:
    """Schedule that falls linearly from an initial value to zero."""

    def __init__(self, initial_value: float) -> None:
        self.initial_value = float(initial_value)

    def __call__(self, progress_remaining: float) -> float:
        """Return the value at a fraction of the training that remains."""
        return progress_remaining * self.initial_value


def parsed(hyperparams: Mapping[str, Any]) -> dict[str, Any]:
    """Return a copy of YAML hyperparameters with schedules, classes and tuples for their descriptions."""
    evaluated = {key: _evaluate(value) for key, value in hyperparams.items() if key in EVALUATED}
    values = {**hyperparams, **import_classes(evaluated)}
    if "." in (policy := values.get("policy", "")):
        values["policy"] = class_from_path(policy)
    for key in SCHEDULES:
        if isinstance(value := values.get(key), str) and (schedule := SCHEDULE.fullmatch(value)):
            values[key] = LinearSchedule(float(schedule[2]))
    if isinstance(values.get("train_freq"), list):
        values["train_freq"] = tuple(values["train_freq"])
    return values


def _evaluate(value: Any) -> Any:
    """Evaluate a Python expression as rl_zoo3 does; leave import paths and other values as they are."""
    if not isinstance(value, str) or DOTTED_PATH.fullmatch(value):
        return value
    return eval(value, dict(NAMES))


def import_classes(value: Any, is_class: bool = False) -> Any:
    """Return a YAML value with classes instead of import paths wherever a key ends in ``_class``."""
    if isinstance(value, dict):
        return {key: import_classes(item, str(key).endswith("_class")) for key, item in value.items()}
    if is_class and isinstance(value, str) and DOTTED_PATH.fullmatch(value):
        return class_from_path(value)
    return value


def wrapped(env: Any, description: Any) -> Any:
    """Return an environment in the wrappers of a description, as for :func:`described_callables`."""
    for wrapper, kwargs in described_callables(description):
        env = wrapper(env, **kwargs)
    return env


def described_callables(description: Any) -> list[tuple[Callable[..., Any], dict[str, Any]]]:
    """
    Return the classes or functions of a description, and their arguments.

    :param description: None, an import path, a mapping from one path to arguments, or a list of these
    """
    if description is None:
        return []
    entries = description if isinstance(description, list) else [description]
    if wrong := [entry for entry in entries if isinstance(entry, dict) and len(entry) != 1]:
        raise ValueError(f"an entry must be one class or function, or one with arguments, got {wrong[0]}")
    pairs = [next(iter(entry.items())) if isinstance(entry, dict) else (entry, {}) for entry in entries]
    return [(callable_from_path(path), dict(kwargs or {})) for path, kwargs in pairs]


def build_vec_env(
    env_id: str,
    hyperparams: Mapping[str, Any],
    n_envs: int,
    seed: int,
    *,
    vec_env: str = "dummy",
    for_evaluation: bool = False,
    monitor_dir: Path | None = None,
    override_existing: bool = True,
    statistics: Path | None = None,
) -> VecEnv:
    """
    Build and wrap the environments of an experiment.

    :param seed: Seed of the first environment
    :param vec_env: ``"dummy"`` or ``"subproc"``
    :param for_evaluation: Whether normalisation keeps its statistics and leaves rewards as they are
    :param override_existing: Whether new monitor files replace existing ones
    """
    values = parsed(hyperparams)
    monitor_kwargs = {**(values.get("monitor_kwargs") or {}), "override_existing": override_existing}
    if "info_keywords" in monitor_kwargs:  # Monitor requires a tuple
        monitor_kwargs["info_keywords"] = tuple(monitor_kwargs["info_keywords"])
    # Worker processes need not have registered the id.
    spec, wrappers = gym.spec(env_id), values.get("env_wrapper")

    def make(**kwargs: Any) -> Any:
        # Below the monitor, which otherwise does not count episodes that a wrapper ends.
        return wrapped(spec.make(**kwargs), wrappers)

    env = make_vec_env(
        make,
        n_envs=n_envs,
        seed=seed,
        monitor_dir=None if monitor_dir is None else str(monitor_dir),
        env_kwargs=dict(values.get("env_kwargs", {})),
        vec_env_cls=VEC_ENVS[vec_env],
        monitor_kwargs=monitor_kwargs,
    )
    env = wrapped(env, values.get("vec_env_wrapper"))
    env = _normalized(env, values, for_evaluation, statistics)
    if values.get("frame_stack"):
        env = VecFrameStack(env, values["frame_stack"], _channels_order(env.observation_space))
    return BaseAlgorithm._wrap_env(env, verbose=0, monitor_wrapper=False)  # images with the channels first


def _channels_order(space: Any) -> Any:
    """Return the ``channels_order`` of ``VecFrameStack``, which recognises images of uint8 only."""
    if isinstance(space, gym.spaces.Dict):
        return {name: _channels_order(part) for name, part in space.items()}
    return "first" if len(space.shape) == 3 and space.dtype != np.uint8 else None


def _normalized(
    env: VecEnv, values: Mapping[str, Any], for_evaluation: bool, statistics: Path | None
) -> VecEnv:
    """Wrap the environments in ``VecNormalize`` with ``normalize`` or a file of statistics."""
    if statistics is not None and statistics.is_file():
        normalized = VecNormalize.load(str(statistics), env)
    elif normalize := values.get("normalize"):
        kwargs = dict(normalize) if isinstance(normalize, dict) else {}
        kwargs.update({"gamma": values["gamma"]} if "gamma" in values else {})
        normalized = VecNormalize(env, **kwargs)
    else:
        return env
    if for_evaluation:
        normalized.training = normalized.norm_reward = False
    return normalized
