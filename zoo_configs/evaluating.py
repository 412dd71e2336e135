"""Evaluating an agent on scenes that it has never met."""

from __future__ import annotations

import argparse
import contextlib
from typing import TYPE_CHECKING, Any, NamedTuple

from zoo_configs.arguments import hides_progress
from zoo_configs.errors import refused
from zoo_configs.training.seeds import SeedStream, stream_seed

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.vec_env import VecEnv

    from zoo_configs.agents import Agent


class Outcome(NamedTuple):
    """
    What came of an evaluation.

    :param successes: Of each episode whether it succeeded
    :param returns: Of each episode the sum of its rewards
    """

    successes: list[bool]
    returns: list[float]

    @property
    def episodes(self) -> int:
        """How many there were."""
        return len(self.successes)

    @property
    def rate(self) -> float:
        """Share that succeeded, in [0, 1]; 0 without any."""
        return sum(self.successes) / max(self.episodes, 1)


def build_test_env(agent: Agent, args: argparse.Namespace) -> VecEnv:
    """
    Rebuild the environment of an agent, with the parameters it was trained with.

    :param agent: The agent
    :param args: Flags: how many copies, in processes of their own if more than one, seed of the test scenes,
        parameters that are to differ, whether to open a window
    :return: The wrapped environments
    :raises CommandError: if it refuses its parameters, or there is no screen
    """
    from rl_zoo3.utils import create_test_env

    from zoo_configs.environments import try_env

    hyperparams, stats_path = agent.env_hyperparams()
    env_kwargs = {**agent.env_kwargs, **args.env_kwargs}
    try_env(agent.env_id, env_kwargs, "human" if args.render else None)
    with refused(f"{agent.env_id} cannot be made as {agent.path} was trained"):
        return create_test_env(
            agent.env_id,
            n_envs=args.n_envs,
            stats_path=stats_path,
            seed=stream_seed(args.seed, SeedStream.TEST),
            should_render=args.render,
            hyperparams=hyperparams,
            env_kwargs=env_kwargs,
        )


def evaluate(model: BaseAlgorithm, env: VecEnv, args: argparse.Namespace) -> Outcome:
    """
    Let an agent act under a progress bar; Ctrl-C ends the evaluation with the episodes so far.

    :param model: The agent
    :param env: The environments; their info reports ``is_success`` at the end of an episode
    :param args: Flags: how many episodes, spread evenly over the environments, whether to sample actions
        instead of taking the policy's mean, whether to show the bar
    :return: What came of it
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
