"""``bulletarm-zoo enjoy``: evaluates a trained agent on scenes it has never met."""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Sequence
from contextlib import closing
from typing import TYPE_CHECKING, Any

from zoo_configs.arguments import Parser, add_progress, add_run_arguments, hides_progress, positive_int, seed
from zoo_configs.errors import CommandError, reason, refused
from zoo_configs.training.seeds import SeedStream, stream_seed

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.vec_env import VecEnv

    from zoo_configs.training.runs import Run

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
    from zoo_configs.environments import check_alike, register_environments

    register_environments(args.gym_packages)
    run = run_from_arguments(args)
    model, path = load_agent(run, args.load_best, args.device)
    env = build_test_env(run, args)
    with closing(env):
        check_alike(env, model, "the agent cannot act here")
        print(f"{run.cell.label} on {run.cell.env_id}, model {path}")
        rate, episodes = evaluate(model, env, args)
    _name_files(run)
    print(f"success_rate={rate:.2f} episodes={episodes}")


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = Parser("bulletarm-zoo enjoy", description=DESCRIPTION)
    add_run_arguments(parser)
    add = parser.add_argument
    add("-n", "--episodes", type=positive_int, default=50, help="how many episodes (default: 50)")
    add("--seed", type=seed, default=0, help="seed of the test scenes (default: 0)")
    add("--n-envs", type=positive_int, default=1, help="environments in parallel processes (default: 1)")
    add("--stochastic", action="store_true", help="sample actions instead of taking the policy's mean")
    add("--render", action="store_true", help="open a window")
    add_progress(parser)
    return parser.parse_args(argv)


def build_test_env(run: Run, args: argparse.Namespace) -> VecEnv:
    """
    Rebuild the environment of a run, with the parameters it was trained with.

    :param run: The run
    :param args: Flags: how many copies, in processes of their own if more than one, seed of the test scenes,
        parameters that are to differ, whether to open a window
    :return: The wrapped environments
    :raises CommandError: if it refuses its parameters, or there is no screen
    """
    from rl_zoo3.utils import create_test_env

    from zoo_configs.environments import try_env

    hyperparams, stats_path = run.saved_hyperparams()
    trained_with = dict(run.cell.hyperparams.get("env_kwargs", {}))
    trained_with.pop("render_mode", None)
    env_kwargs = {**trained_with, **args.env_kwargs}
    try_env(run.cell.env_id, env_kwargs, "human" if args.render else None)
    with refused(f"{run.cell.env_id} cannot be made as in {run.folder}"):
        return create_test_env(
            run.cell.env_id,
            n_envs=args.n_envs,
            stats_path=stats_path,
            seed=stream_seed(args.seed, SeedStream.TEST),
            should_render=args.render,
            hyperparams=hyperparams,
            env_kwargs=env_kwargs,
        )


def evaluate(model: BaseAlgorithm, env: VecEnv, args: argparse.Namespace) -> tuple[float, int]:
    """
    Let an agent act under a progress bar; Ctrl-C ends the evaluation with the episodes so far.

    :param model: The agent
    :param env: The environments; their info reports ``is_success`` at the end of an episode
    :param args: Flags: how many episodes, spread evenly over the environments, whether to sample actions
        instead of taking the policy's mean, whether to show the bar
    :return: Share of successful episodes, in [0, 1] (0 without any), and the number of episodes
    """
    from stable_baselines3.common.evaluation import evaluate_policy
    from tqdm import tqdm

    episodes, deterministic = args.episodes, not args.stochastic
    successes: list[bool] = []
    with tqdm(total=episodes, unit="episode", disable=hides_progress(args.progress)) as bar:

        def note(local: dict[str, Any], _: dict[str, Any]) -> None:
            if local["done"]:
                successes.append(bool(local["info"].get("is_success", False)))
                bar.update()
                bar.set_postfix(success=f"{sum(successes) / len(successes):.2f}")

        with contextlib.suppress(KeyboardInterrupt):
            evaluate_policy(model, env, episodes, deterministic=deterministic, callback=note)
    return sum(successes) / max(len(successes), 1), len(successes)


def _name_files(run: Run) -> None:
    from zoo_configs.drawing.curves import draw_run

    if run.evaluations_file.is_file():
        try:
            print(f"Written:\n  {draw_run(run)}")
        except (CommandError, OSError) as error:  # another user's run
            print(f"learning curve not drawn: {reason(error)}", file=sys.stderr)
