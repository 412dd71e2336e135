"""Vector environments with the wrappers of an experiment, for training and evaluation."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.preprocessing import is_image_space, is_image_space_channels_first
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecEnv,
    VecFrameStack,
    VecNormalize,
    VecTransposeImage,
)

from zoo_configs.training.objects import parsed, wrapper

VEC_ENVS: dict[str, type[DummyVecEnv | SubprocVecEnv]] = {"dummy": DummyVecEnv, "subproc": SubprocVecEnv}


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
    Build the environments of an experiment.

    :param env_id: Id of the environment
    :param hyperparams: Hyperparameters of the experiment, of which those of the environments count
    :param n_envs: Number of environments
    :param seed: Seed of the first environment
    :param vec_env: ``"dummy"`` or ``"subproc"``
    :param for_evaluation: Whether normalisation keeps its statistics and leaves rewards as they are
    :param monitor_dir: Folder of monitor files
    :param override_existing: Whether new monitor files replace existing ones
    :param statistics: File with normalisation statistics to load
    :return: The wrapped environments
    """
    values = parsed(hyperparams)
    monitor_kwargs = {**values.get("monitor_kwargs", {}), "override_existing": override_existing}
    if "info_keywords" in monitor_kwargs:  # Monitor requires a tuple
        monitor_kwargs["info_keywords"] = tuple(monitor_kwargs["info_keywords"])
    env = make_vec_env(
        gym.spec(env_id).make,  # worker processes need not have registered the id
        n_envs=n_envs,
        seed=seed,
        monitor_dir=None if monitor_dir is None else str(monitor_dir),
        wrapper_class=wrapper(values.get("env_wrapper")),
        env_kwargs=dict(values.get("env_kwargs", {})),
        vec_env_cls=VEC_ENVS[vec_env],
        monitor_kwargs=monitor_kwargs,
    )
    if (wrap := wrapper(values.get("vec_env_wrapper"))) is not None:
        env = wrap(env)
    env = _normalized(env, values, for_evaluation, statistics)
    if values.get("frame_stack"):
        env = VecFrameStack(env, values["frame_stack"])
    return VecTransposeImage(env) if _has_channels_last(env.observation_space) else env


def _normalized(
    env: VecEnv, values: Mapping[str, Any], for_evaluation: bool, statistics: Path | None
) -> VecEnv:
    """Wrap the environments in ``VecNormalize`` with ``normalize`` or a file of statistics."""
    normalize = values.get("normalize")
    if statistics is not None and statistics.is_file():
        normalized = VecNormalize.load(str(statistics), env)
    elif normalize:
        gamma = {"gamma": values["gamma"]} if "gamma" in values else {}
        normalized = VecNormalize(env, **{**(normalize if isinstance(normalize, dict) else {}), **gamma})
    else:
        return env
    if for_evaluation:
        normalized.training = normalized.norm_reward = False
    return normalized


def _has_channels_last(space: spaces.Space[Any]) -> bool:
    parts = space.spaces.values() if isinstance(space, spaces.Dict) else [space]
    return any(is_image_space(part) and not is_image_space_channels_first(part) for part in parts)  # type: ignore[arg-type]
