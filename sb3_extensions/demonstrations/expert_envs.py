"""Demonstrations of the expert in copies of the training environments."""

import contextlib
import copy
import dataclasses
from collections.abc import Iterator
from itertools import product
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecCheckNan,
    VecEnv,
    VecEnvWrapper,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
    VecTransposeImage,
    VecVideoRecorder,
)

from sb3_extensions.demonstrations.collection import ActionTransform, collect_episodes
from sb3_extensions.demonstrations.episodes import Episode

AnyEnv = gym.Env[Any, Any]

RECORDERS = {"Monitor", "RecordVideo", "RecordDemonstrations", "DataCollector"}
"""Wrappers that write files of the training and are left out of a copy; the last is of Minari."""
TRANSPARENT = (VecCheckNan, VecMonitor, VecNormalize, VecVideoRecorder)
"""Vector wrappers without an effect on the contents of the replay buffer."""
INSTEAD = "Pass expert_data=collect_episodes(env, n), with env wrapped as the training environment."


def collect_from_copies(
    vec_env: VecEnv,
    episodes: int,
    seed: int | None,
    progress_bar: bool | None = None,
    action_transform: ActionTransform | None = None,
) -> Iterator[Episode]:
    """
    Collect successful episodes of the expert in copies of training environments, one at a time.

    Different environments contribute in proportion. See
    :func:`~sb3_extensions.demonstrations.collection.collect_episodes` for the other parameters and errors.

    :param vec_env: training environments
    """
    if not episodes:
        return
    expert_envs = make_expert_envs(vec_env)
    ends = np.cumsum([count for _, count in expert_envs]) * episodes / vec_env.num_envs
    shares = np.diff(ends.round().astype(int), prepend=0).tolist()
    for index, ((env, _), share) in enumerate(zip(expert_envs, shares, strict=True)):
        env_seed = None if seed is None else seed + index
        with contextlib.closing(env):
            yield from collect_episodes(env, share, env_seed, progress_bar, action_transform)


def make_expert_envs(vec_env: VecEnv) -> list[tuple[VecEnv, int]]:
    """
    Create a vector environment with a copy of each different training environment.

    Environments in this process are copied with all their wrappers except :data:`RECORDERS`.
    Environments in other processes are created from their spec.

    :return: vector environments with one environment each, wrapped as ``vec_env``, and the number of training
        environments that each of them represents
    :raises ValueError: if an environment cannot be copied or created
    """
    base, specs = vec_env.unwrapped, vec_env.get_attr("spec")
    counts = _count_specs(specs)
    envs = [
        _copy(base.envs[index]) if isinstance(base, DummyVecEnv) else _from_spec(specs[index])
        for index in counts
    ]
    wrapped = [_wrap(env, vec_env) for env in envs]
    for env, name in product(wrapped, ("observation_space", "action_space")):
        theirs, ours = getattr(env, name), getattr(vec_env, name)
        if theirs != ours:
            raise ValueError(
                f"env must have {name}={ours} after it was created again, got {theirs}. {INSTEAD}"
            )
    return list(zip(wrapped, counts.values(), strict=True))


def _count_specs(specs: list[Any]) -> dict[int, int]:
    """Return the number of environments of each spec, by its first index. Missing specs count separately."""
    counts: dict[int, int] = {}
    for index, spec in enumerate(specs):
        first = next((other for other in counts if spec is not None and _is_same(specs[other], spec)), index)
        counts[first] = counts.get(first, 0) + 1
    return counts


def _is_same(spec: Any, other: Any) -> bool:
    try:
        return bool(spec == other)
    except ValueError:  # of arrays in the arguments
        return False


def _copy(env: AnyEnv) -> AnyEnv:
    """Return a copy of an environment without recorders."""
    open_files: dict[int, Any] = {}  # of monitors; deepcopy() replaces them by None
    wrapper = env
    while isinstance(wrapper, gym.Wrapper):
        if isinstance(wrapper, Monitor):
            open_files[id(wrapper.results_writer)] = None
        wrapper = wrapper.env
    try:
        return _without_recorders(copy.deepcopy(env, open_files))
    except (TypeError, ValueError, RuntimeError, NotImplementedError) as error:
        if env.spec is None:
            raise ValueError(f"env must be copyable or have a spec, got {env}: {error}. {INSTEAD}") from error
    return _from_spec(env.spec)


def _without_recorders(env: AnyEnv) -> AnyEnv:
    if not isinstance(env, gym.Wrapper):
        return env
    inner = _without_recorders(env.env)
    if RECORDERS & {kind.__name__ for kind in type(env).__mro__}:
        return inner
    env.env = inner
    return env


def _from_spec(spec: Any) -> AnyEnv:
    """Create an environment with the wrappers of its spec."""
    if spec is None:
        raise ValueError(f"env must have a spec if it runs in another process, got None. {INSTEAD}")
    wrappers = tuple(entry for entry in spec.additional_wrappers if entry.name not in RECORDERS)
    kwargs = {name: value for name, value in spec.kwargs.items() if name != "render_mode"}
    try:
        return gym.make(dataclasses.replace(spec, kwargs=kwargs, additional_wrappers=wrappers))
    except ValueError as error:
        raise ValueError(
            f"env must have a spec that can be created, got {spec.id}: {error}. {INSTEAD}"
        ) from error


def _wrap(env: AnyEnv, vec_env: VecEnv) -> VecEnv:
    """Wrap an environment in the vector wrappers of ``vec_env`` that change observations."""
    if not isinstance(vec_env, VecEnvWrapper):
        return DummyVecEnv([lambda: env])
    wrapped = _wrap(env, vec_env.venv)
    if isinstance(vec_env, VecTransposeImage):
        return VecTransposeImage(wrapped)
    if isinstance(vec_env, VecFrameStack):
        stacked = vec_env.stacked_obs
        return VecFrameStack(wrapped, stacked.n_stack, _channels_order(stacked))
    if not isinstance(vec_env, TRANSPARENT):
        raise ValueError(f"env must have known vector wrappers, got {type(vec_env).__name__}. {INSTEAD}")
    return wrapped


def _channels_order(stacked: Any) -> Any:
    """Return the order with which a VecFrameStack was created."""
    if isinstance(stacked.observation_space, spaces.Dict):
        return {key: _channels_order(part) for key, part in stacked.sub_stacked_observations.items()}
    return "first" if stacked.channels_first else "last"
