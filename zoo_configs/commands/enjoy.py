"""``bulletarm-zoo enjoy``: evaluates a trained agent on new scenes."""

import argparse

from zoo_configs.agents import find_agent, query_of
from zoo_configs.evaluating import EvalOptions, evaluate_agent


def main(args: argparse.Namespace) -> None:
    """Run the command."""
    agent = find_agent(query_of(args))
    options = EvalOptions(args.episodes, args.seed, args.n_envs, args.env_kwargs, args.progress)
    print(f"{agent.label} on {agent.env_id}, model {agent.path}")
    outcome = evaluate_agent(agent, options)
    print(f"{outcome.summary} episodes={args.episodes}")
