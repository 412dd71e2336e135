"""``bulletarm-zoo enjoy``: evaluates a trained agent on scenes it has never met."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from contextlib import closing
from typing import TYPE_CHECKING

from zoo_configs.arguments import (
    Parser,
    add_progress,
    add_published,
    add_run_arguments,
    positive_int,
    seed,
)
from zoo_configs.errors import CommandError, reason

if TYPE_CHECKING:
    from zoo_configs.training.runs import Run

DESCRIPTION = """Evaluate a trained agent with its deterministic policy, and draw its learning curve; or, with
--published, an agent that comes with the package.
The last line reads like "success_rate=0.98 episodes=50"."""


def main(argv: Sequence[str]) -> None:
    """
    Run the command.

    :param argv: Its arguments
    :raises CommandError: if there is no such agent
    """
    args = _parse(argv)
    from zoo_configs.agents import agent_from_arguments
    from zoo_configs.environments import check_alike, register_environments
    from zoo_configs.evaluating import build_test_env, evaluate

    register_environments(args.gym_packages)
    agent = agent_from_arguments(args)
    with closing(build_test_env(agent, args)) as env:
        check_alike(env, agent.model, "the agent cannot act here")
        print(f"{agent.label} on {agent.env_id}, model {agent.path}")
        outcome = evaluate(agent.model, env, args)
    if agent.run is not None:
        _name_files(agent.run)
    print(f"success_rate={outcome.rate:.2f} episodes={outcome.episodes}")


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = Parser("bulletarm-zoo enjoy", description=DESCRIPTION)
    add_run_arguments(parser)
    add_published(parser)
    add = parser.add_argument
    add("-n", "--episodes", type=positive_int, default=50, help="how many episodes (default: 50)")
    add("--seed", type=seed, default=0, help="seed of the test scenes (default: 0)")
    add("--n-envs", type=positive_int, default=1, help="environments in parallel processes (default: 1)")
    add("--stochastic", action="store_true", help="sample actions instead of taking the policy's mean")
    add("--render", action="store_true", help="open a window")
    add_progress(parser)
    return parser.parse_args(argv)


def _name_files(run: Run) -> None:
    from zoo_configs.drawing.curves import draw_run

    if run.evaluations_file.is_file():
        try:
            print(f"Written:\n  {draw_run(run)}")
        except (CommandError, OSError) as error:  # another user's run
            print(f"learning curve not drawn: {reason(error)}", file=sys.stderr)
