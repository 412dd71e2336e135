"""Parameters of the paper's benchmarks for a task: action sequence, demonstrations, in-hand image."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from bulletarm_gym.benchmarks import BENCHMARKS
from zoo_configs.errors import CommandError, unknown_name


def choose_benchmark(
    serves: Mapping[str, Sequence[str]], env_id: str, network: str, wanted: str | None
) -> str | None:
    """
    Return the benchmark that defines a task's parameters.

    :param serves: Networks by benchmark
    :param env_id: Id of the environment
    :param network: The network
    :param wanted: Name of a benchmark, None for the first that fits
    :return: Its name, None for a task of no benchmark
    :raises CommandError: for an unknown benchmark, or one without the task or the network
    """
    with_task = _with_task(serves, env_id)
    if wanted is not None and wanted not in BENCHMARKS:
        raise unknown_name("benchmark", wanted, BENCHMARKS)
    if wanted is not None and wanted not in with_task:
        names = ", ".join(with_task) or "none"
        raise CommandError(f"benchmark must be one of those with {env_id} ({names}), got {wanted!r}")
    candidates = [name for name in with_task if wanted in (None, name)]
    fitting = [name for name in candidates if network in serves[name]]
    if with_task and not fitting:
        networks = {name: list(serves[name]) for name in candidates}
        raise CommandError(f"network {network!r} does not fit {env_id}. Networks by benchmark: {networks}")
    return fitting[0] if fitting else None


def is_served(serves: Mapping[str, Sequence[str]], env_id: str, network: str, wanted: str | None) -> bool:
    """
    Return True if a network serves a task. Every network serves a task of no benchmark.

    :param serves: Networks by benchmark
    :param env_id: Id of the environment
    :param network: The network
    :param wanted: Name of a benchmark, None for any
    """
    with_task = _with_task(serves, env_id)
    return not with_task or any(network in serves[name] for name in with_task if wanted in (None, name))


def task_parameters(benchmark: str, env_id: str) -> dict[str, Any]:
    """
    Return the hyperparameters that a benchmark defines for a task.

    :param benchmark: Its name
    :param env_id: Id of one of its environments
    :return: The environment's parameters and the number of demonstrations
    """
    table = BENCHMARKS[benchmark]
    [row] = (environment for environment in table.environments if environment.env_id == env_id)
    return {"env_kwargs": table.make_kwargs(row), "expert_episodes": row.expert_episodes}


def _with_task(serves: Mapping[str, Sequence[str]], env_id: str) -> list[str]:
    return [name for name in serves if env_id in {row.env_id for row in BENCHMARKS[name].environments}]
