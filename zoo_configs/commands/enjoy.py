"""``bulletarm-zoo enjoy``: evaluates a trained agent on new scenes."""

import argparse
from collections.abc import Sequence

from zoo_configs.arguments import Parser, add_agent_flags, positive_int, query_of

DESCRIPTION = """Evaluate a trained agent with its deterministic policy: the agent of a run, a model that
save() wrote, or, with --published, an agent of the package.
The last line is, for example, "success_rate=0.98 episodes=50"."""


def main(argv: Sequence[str]) -> None:
    """Run the command."""
    args = _parse(argv)
    from zoo_configs.agents import find_agent
    from zoo_configs.evaluating import EvalOptions, evaluate_agent

    agent = find_agent(query_of(args))
    options = EvalOptions(args.episodes, args.seed, args.n_envs, args.env_kwargs, args.progress)
    print(f"{agent.label} on {agent.env_id}, model {agent.path}")
    outcome = evaluate_agent(agent, options)
    print(f"success_rate={outcome.success_rate:.2f} episodes={outcome.episodes}")


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = Parser("bulletarm-zoo enjoy", description=DESCRIPTION)
    add_agent_flags(parser)
    add = parser.add_argument
    add("-n", "--episodes", type=positive_int, default=50, help="number of episodes (default: 50)")
    add("--n-envs", type=positive_int, default=1, help="number of environments in processes (default: 1)")
    return parser.parse_args(argv)
