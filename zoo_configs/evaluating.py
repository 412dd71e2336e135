"""Evaluation of agents on scenes that they were not trained on."""

from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, field
from statistics import fmean
from typing import Any, NamedTuple

from scipy.stats import binomtest
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import VecEnv
from tqdm import tqdm

from zoo_configs.agents import Agent
from zoo_configs.environments import SeedStream, stream_seed, tried_env
from zoo_configs.errors import CommandError, refused
from zoo_configs.training.objects import build_vec_env, parsed
from zoo_configs.training.runs import Run


@dataclass(frozen=True)
class EvalOptions:
    """
    Options of an evaluation.

    :param seed: Seed of the test scenes
    :param n_envs: Number of environments; more than one run in processes
    """

    episodes: int = 50
    seed: int = 0
    n_envs: int = 1
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)
    progress: bool = False


class Outcome(NamedTuple):
    """Success, if the environment reports it, and return (sum of rewards) of each episode."""

    successes: list[bool]
    returns: list[float]

    @property
    def success_rate(self) -> float:
        """Fraction of successful episodes in [0, 1]; 0 without episodes."""
        return sum(self.successes) / max(len(self.successes), 1)

    @property
    def summary(self) -> str:
        """Success rate, or the mean return if the environment reports no success."""
        if self.successes:
            return f"success_rate={self.success_rate:.2f}"
        return f"mean_return={fmean(self.returns):.2f}"

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's 95 % interval of the success rate; raise ``CommandError`` without one."""
        if not self.successes:
            raise CommandError("the environment does not report is_success")
        low, high = binomtest(sum(self.successes), len(self.successes)).proportion_ci(method="wilson")
        return float(low), float(high)


def build_test_env(agent: Agent, options: EvalOptions) -> VecEnv:
    """Build the environments of an agent as in its training; raise ``CommandError`` on failure."""
    env_kwargs = {**agent.env_kwargs, **options.env_kwargs}
    with tried_env(agent.env_id, env_kwargs):
        pass
    statistics = None if agent.run is None else agent.run.statistics_file
    if agent.hyperparams.get("normalize") and statistics is not None and not statistics.is_file():
        raise CommandError(f"{statistics} is missing: {agent.path} was trained with it")
    with refused(f"{agent.env_id} cannot be made as in the training of {agent.path}"):
        return build_vec_env(
            agent.env_id,
            {**agent.hyperparams, "env_kwargs": env_kwargs},
            options.n_envs,
            stream_seed(options.seed, SeedStream.TEST),
            vec_env="subproc" if options.n_envs > 1 else "dummy",
            for_evaluation=True,
            statistics=statistics,
        )


def evaluate_agent(agent: Agent, options: EvalOptions) -> Outcome:
    """Evaluate an agent's deterministic policy; raise ``CommandError`` if its environment does not fit it."""
    outcome = Outcome([], [])
    with (
        closing(build_test_env(agent, options)) as env,
        tqdm(total=options.episodes, unit="episode", disable=not options.progress) as bar,
    ):

        def note(local: dict[str, Any], _: dict[str, Any]) -> None:
            if local["done"]:
                if "is_success" in local["info"]:
                    outcome.successes.append(bool(local["info"]["is_success"]))
                outcome.returns.append(float(local["current_rewards"][local["i"]]))
                bar.update()
                bar.set_postfix_str(outcome.summary)

        check_fits(env, agent)
        evaluate_policy(agent.model, env, options.episodes, callback=note)
    return outcome


def check_fits(env: Any, agent: Agent) -> None:
    """Raise ``CommandError`` if an environment or a vector environment has other spaces than an agent."""
    with refused("the agent cannot act here", ValueError):
        check_for_correct_spaces(env, agent.model.observation_space, agent.model.action_space)


def check_unwrapped(run: Run | None, names: tuple[str, ...], reason: str) -> None:
    """Raise ``CommandError``, ending in ``reason``, if one of some hyperparameters of a run is set."""
    hyperparams = {} if run is None else dict(run.experiment.hyperparams)
    normalize = parsed({"normalize": hyperparams.get("normalize")})["normalize"]
    if isinstance(normalize, Mapping) and not normalize.get("norm_obs", True):  # it changes rewards alone
        hyperparams["normalize"] = False
    elif run is not None and run.statistics_file.is_file():  # also of a model that the training started from
        hyperparams["normalize"] = True
    if wrapped := [name for name in names if hyperparams.get(name)]:
        raise CommandError(f"the agent was trained with {', '.join(wrapped)}, {reason}")
