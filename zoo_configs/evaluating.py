"""Evaluation of an agent on scenes that it was not trained on."""

from __future__ import annotations

import argparse
import contextlib
from typing import TYPE_CHECKING, Any, NamedTuple

from zoo_configs.arguments import hides_progress
from zoo_configs.errors import CommandError, refused
from zoo_configs.training.seeds import SeedStream, stream_seed

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.vec_env import VecEnv

    from zoo_configs.agents import Agent


class Outcome(NamedTuple):
    """
    Result of an evaluation.

    :param successes: Success of each episode
    :param returns: Sum of rewards of each episode
    """

    successes: list[bool]
    returns: list[float]

    @property
    def episodes(self) -> int:
        """Number of episodes."""
        return len(self.successes)

    @property
    def rate(self) -> float:
        """Fraction of successful episodes, 0 without episodes."""
        return sum(self.successes) / max(self.episodes, 1)


def build_test_env(agent: Agent, args: argparse.Namespace) -> VecEnv:
    """
    Build the environments of an agent with the parameters of its training.

    :param agent: The agent
    :param args: Flags: number of environments (in processes of their own if more than one), seed of the test
        scenes, changed parameters, whether to open a window
    :return: The wrapped environments
    :raises CommandError: if the environment rejects its parameters, or there is no display
    """
    from zoo_configs.environments import try_env
    from zoo_configs.training.vec_envs import build_vec_env

    env_kwargs = {**agent.env_kwargs, **args.env_kwargs}
    mode = "human" if args.render else None
    try_env(agent.env_id, env_kwargs, mode)
    rendering = {} if mode is None else {"render_mode": mode}
    hyperparams = {} if agent.run is None else agent.run.cell.hyperparams
    statistics = None if agent.run is None else agent.run.statistics_file
    if hyperparams.get("normalize") and statistics is not None and not statistics.is_file():
        raise CommandError(f"{statistics} is missing, with which {agent.path} was trained")
    with refused(f"{agent.env_id} cannot be made as {agent.path} was trained"):
        return build_vec_env(
            agent.env_id,
            {**hyperparams, "env_kwargs": {**rendering, **env_kwargs}},
            args.n_envs,
            stream_seed(args.seed, SeedStream.TEST),
            vec_env="subproc" if args.n_envs > 1 else "dummy",
            for_evaluation=True,
            statistics=statistics,
        )


def evaluate(model: BaseAlgorithm, env: VecEnv, args: argparse.Namespace) -> Outcome:
    """
    Evaluate an agent with a progress bar. Ctrl-C ends the evaluation after the episodes so far.

    :param model: The agent
    :param env: The environments, whose info has ``is_success`` at the end of an episode
    :param args: Flags: number of episodes, distributed evenly over the environments; whether to sample
        actions; whether to show the bar
    :return: The result
    """
    from stable_baselines3.common.evaluation import evaluate_policy
    from tqdm import tqdm

    episodes, deterministic = args.episodes, not args.stochastic
    outcome = Outcome([], [])
    with tqdm(total=episodes, unit="episode", disable=hides_progress(args.progress)) as bar:

        def note(local: dict[str, Any], _: dict[str, Any]) -> None:
            if local["done"]:
                outcome.successes.append(bool(local["info"].get("is_success", False)))
                outcome.returns.append(float(local["current_rewards"][local["i"]]))
                bar.update()
                bar.set_postfix(success=f"{outcome.rate:.2f}")

        with contextlib.suppress(KeyboardInterrupt):
            evaluate_policy(model, env, episodes, deterministic=deterministic, callback=note)
    return outcome
