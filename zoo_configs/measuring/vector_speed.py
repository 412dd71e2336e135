"""Several environments at once: how many steps a second vector environments make of them."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack, closing
from functools import partial
from statistics import median
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from bulletarm_gym.machine import load_average
from sb3_extensions.vec_env import SplitVecEnv
from zoo_configs.environments import make_env, register_environments
from zoo_configs.errors import CommandError

KINDS: dict[str, Callable[[list[Any]], VecEnv]] = {
    "dummy": DummyVecEnv,
    "subproc": SubprocVecEnv,
    "split": SplitVecEnv,
}
ONE_PROCESS = "dummy"
ROUNDS = 5
LEAST_STEPS = 20

Actions = list[npt.NDArray[np.float32]]


class VectorSpeed(NamedTuple):
    """
    Steps a second of the same environments under the same actions, in rounds in which each kind has its turn.

    :param env_id: Id of the environments
    :param rates: Steps a second over all environments, of each round, by kind of vector environment
    :param load: Load average of the machine when it began
    """

    env_id: str
    rates: Mapping[str, tuple[float, ...]]
    load: float

    def ratios(self, kind: str) -> list[float]:
        """
        How many times as many steps as in one process.

        :param kind: One of ``KINDS``
        :return: The ratio of each round, the least first
        """
        pairs = zip(self.rates[kind], self.rates[ONE_PROCESS], strict=True)
        return sorted(rate / one_process for rate, one_process in pairs)

    def cells(self) -> list[str]:
        """A line of a table: steps a second in one process, and of the others the median ratio and range."""
        cells = [self.env_id, f"{median(self.rates[ONE_PROCESS]):.0f}"]
        for kind in self.rates:
            if kind != ONE_PROCESS:
                ratios = self.ratios(kind)
                cells.append(f"{median(ratios):.2f} ({ratios[0]:.2f} to {ratios[-1]:.2f})")
        return cells


COLUMNS = (
    "environment",
    "dummy steps/s",
    *(f"{kind}, times as many" for kind in KINDS if kind != ONE_PROCESS),
)


def measure_vector(
    env_id: str,
    n_envs: int,
    seconds: float,
    seed: int,
    env_kwargs: Mapping[str, Any],
    on_turn: Callable[[float], Any] = lambda share: None,
) -> VectorSpeed:
    """
    Step some environments along the expert's ways, whose actions were found before: a learner's environments
    wait for no expert. Resets where episodes end count.

    :param env_id: Id of the environments
    :param n_envs: How many
    :param seconds: How long the expert acts in one process; the turns take somewhat less each
    :param seed: Seed of the first environment's first episode
    :param env_kwargs: Parameters of the environments
    :param on_turn: Called after each turn with its share of all
    :return: What was measured
    :raises CommandError: if the environments have no expert
    """
    busy = load_average()
    makers: list[Callable[[], gym.Env[Any, Any]]] = [partial(_make, env_id, dict(env_kwargs))] * n_envs
    rates: dict[str, list[float]] = {kind: [] for kind in KINDS}
    with ExitStack() as stack:
        envs = {kind: stack.enter_context(closing(cls(makers))) for kind, cls in KINDS.items()}
        actions = _expert_actions(envs[ONE_PROCESS], seconds, seed)
        for env in envs.values():
            _rate(env, actions[:LEAST_STEPS], seed)  # compiles, fills caches
        for turn in range(ROUNDS):
            kinds = list(KINDS)[turn % len(KINDS) :] + list(KINDS)[: turn % len(KINDS)]
            for kind in kinds:
                rates[kind].append(_rate(envs[kind], actions, seed))
                on_turn(1 / ROUNDS / len(KINDS))
    return VectorSpeed(env_id, {kind: tuple(values) for kind, values in rates.items()}, busy)


def _make(env_id: str, env_kwargs: Mapping[str, Any]) -> gym.Env[Any, Any]:
    """Make an environment as training does, in any process."""
    register_environments()
    return Monitor(make_env(env_id, env_kwargs))


def _expert_actions(env: VecEnv, seconds: float, seed: int) -> Actions:
    if not env.has_attr("expert_action"):
        raise CommandError("the environment has no expert")
    env.seed(seed)
    env.reset()
    actions: Actions = []
    end = time.perf_counter() + seconds
    while len(actions) < LEAST_STEPS or time.perf_counter() < end:
        actions.append(np.stack(env.env_method("expert_action")))
        env.step(actions[-1])
    return actions


def _rate(env: VecEnv, actions: Actions, seed: int) -> float:
    """Steps a second over all environments."""
    env.seed(seed)
    env.reset()
    begin = time.perf_counter()
    for action in actions:
        env.step(action)
    return env.num_envs * len(actions) / (time.perf_counter() - begin)
