"""``bulletarm-zoo enjoy``: evaluates a trained agent on scenes it has never met."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from zoo_configs.arguments import add_run_arguments, positive_int
from zoo_configs.seeds import SeedStream, stream_seed

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.vec_env import VecEnv

    from zoo_configs.runs import Run

DESCRIPTION = """Evaluate a trained agent with its deterministic policy, and draw its learning curve.
The last line reads like "success_rate=0.98 episodes=50"."""


def main(argv: Sequence[str]) -> None:
    """
    Run the command.

    :param argv: Its arguments
    :raises CommandError: if there is no such agent
    """
    args = _parse(argv)
    from zoo_configs.agents import load_agent, run_from_arguments
    from zoo_configs.environments import register_environments

    register_environments(args.gym_packages)
    run = run_from_arguments(args)
    model, path = load_agent(run, args.load_best, args.device)
    print(f"{run.cell.label} on {run.cell.env_id}, model {path}")
    env = build_test_env(run, args.n_envs, args.seed, args.render)
    try:
        rate, episodes = evaluate(model, env, args.episodes, not args.stochastic)
    finally:
        env.close()
    _name_files(run)
    print(f"success_rate={rate:.2f} episodes={episodes}")


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser("bulletarm-zoo enjoy", description=DESCRIPTION)
    add_run_arguments(parser)
    add = parser.add_argument
    add("-n", "--episodes", type=positive_int, default=50, help="how many episodes (default: 50)")
    add("--seed", type=int, default=0, help="seed of the test scenes (default: 0)")
    add("--n-envs", type=positive_int, default=1, help="environments in parallel processes (default: 1)")
    add("--stochastic", action="store_true", help="sample actions instead of taking the policy's mean")
    add("--render", action="store_true", help="open a window")
    return parser.parse_args(argv)


def build_test_env(run: Run, n_envs: int, seed: int, render: bool) -> VecEnv:
    """
    Rebuild the environment of a run, with the parameters it was trained with.

    :param run: The run
    :param n_envs: How many copies, in processes of their own if more than one
    :param seed: Seed of the test scenes
    :param render: Whether to open a window
    :return: The wrapped environments
    """
    from rl_zoo3.utils import create_test_env

    hyperparams, stats_path = run.saved_hyperparams()
    return create_test_env(
        run.cell.env_id,
        n_envs=n_envs,
        stats_path=stats_path,
        seed=stream_seed(seed, SeedStream.TEST),
        should_render=render,
        hyperparams=hyperparams,
        env_kwargs=hyperparams.get("env_kwargs"),
    )


def evaluate(model: BaseAlgorithm, env: VecEnv, episodes: int, deterministic: bool) -> tuple[float, int]:
    """
    Let an agent act under a progress bar; Ctrl-C ends the evaluation with the episodes so far.

    :param model: The agent
    :param env: The environments; their info reports ``is_success`` at the end of an episode
    :param episodes: How many episodes, spread evenly over the environments
    :param deterministic: Whether to take the policy's mean
    :return: Share of successful episodes, in [0, 1] (0 without any), and the number of episodes
    """
    from stable_baselines3.common.evaluation import evaluate_policy
    from tqdm import tqdm

    successes: list[bool] = []
    with tqdm(total=episodes, unit="episode", disable=None) as bar:

        def note(local: dict[str, Any], _: dict[str, Any]) -> None:
            if local["done"]:
                successes.append(bool(local["info"].get("is_success", False)))
                bar.update()
                bar.set_postfix(success=f"{sum(successes) / len(successes):.2f}")

        with contextlib.suppress(KeyboardInterrupt):
            evaluate_policy(model, env, episodes, deterministic=deterministic, callback=note)
    return sum(successes) / max(len(successes), 1), len(successes)


def _name_files(run: Run) -> None:
    from zoo_configs.curves import draw_run

    if run.evaluations_file.is_file():
        print(f"Written:\n  {draw_run(run)}")
