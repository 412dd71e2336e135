"""What the benchmarks of the paper say of a task: its action sequence, its demonstrations, its in-hand
image.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from zoo_configs.errors import CommandError, unknown_name


def choose_benchmark(
    served: Mapping[str, Sequence[str]], env_id: str, network: str, wanted: str | None
) -> str | None:
    """
    The benchmark whose parameters a task is trained with.

    :param served: From benchmark to the networks that serve it
    :param env_id: Id of the environment
    :param network: The network
    :param wanted: Name of a benchmark, None takes the first that has the task
    :return: Its name, None for a task of no benchmark
    :raises CommandError: if there is no such benchmark, or it does not have the task or the network
    """
    from bulletarm_gym.benchmarks import BENCHMARKS

    having = _having(served, env_id)
    if wanted is not None and wanted not in BENCHMARKS:
        raise unknown_name("benchmark", wanted, BENCHMARKS)
    if wanted is not None and wanted not in having:
        raise CommandError(f"{env_id} is not in the benchmark {wanted}, but in {', '.join(having) or 'none'}")
    fitting = [name for name in having if network in served[name] and wanted in (None, name)]
    if having and not fitting:
        networks = {name: list(served[name]) for name in having if wanted in (None, name)}
        raise CommandError(
            f"network {network!r} does not fit {env_id}; those that do, by benchmark: {networks}"
        )
    return fitting[0] if fitting else None


def serves(served: Mapping[str, Sequence[str]], env_id: str, network: str, wanted: str | None) -> bool:
    """
    Whether a network serves a task; every one serves a task of no benchmark.

    :param served: As for :func:`choose_benchmark`
    :param env_id: Id of the environment
    :param network: The network
    :param wanted: Name of a benchmark, None for any
    :return: Whether it does
    """
    having = _having(served, env_id)
    return not having or any(network in served[name] for name in having if wanted in (None, name))


def task_parameters(benchmark: str, env_id: str) -> dict[str, Any]:
    """
    Hyperparameters that a benchmark sets for a task.

    :param benchmark: Its name
    :param env_id: Id of one of its environments
    :return: The environment's parameters and the number of demonstrations
    """
    from bulletarm_gym.benchmarks import BENCHMARKS

    table = BENCHMARKS[benchmark]
    [row] = (environment for environment in table.environments if environment.env_id == env_id)
    return {"env_kwargs": table.make_kwargs(row), "expert_episodes": row.expert_episodes}


def _having(served: Mapping[str, Sequence[str]], env_id: str) -> list[str]:
    """The benchmarks that have a task."""
    from bulletarm_gym.benchmarks import BENCHMARKS

    return [name for name in served if env_id in _ids(BENCHMARKS[name])]


def _ids(benchmark: Any) -> set[str]:
    return {environment.env_id for environment in benchmark.environments}
