"""``bulletarm-zoo list``: environments, the parameters of one, baselines and presets, agents, or runs."""

import argparse
from collections import defaultdict
from contextlib import closing
from typing import Any

import gymnasium as gym

from zoo_configs.cards import published_agents
from zoo_configs.drawing.tables import print_table
from zoo_configs.environments import known_env_id, make_env, our_env_ids, register_environments
from zoo_configs.experiments.families import families, task_name


def main(args: argparse.Namespace) -> None:
    """Run the command."""
    register_environments(args.gym_packages)
    if args.log_folder is not None:
        _list_runs(args)
    elif args.published:
        _list_published()
    elif args.baselines:
        _list_baselines()
    elif args.env is not None:
        _list_parameters(known_env_id(args.env))
    else:
        _list_environments()


def _list_environments() -> None:
    """Print the ids by control and surface, without making an environment."""
    groups: defaultdict[str, list[str]] = defaultdict(list)
    for env_id in our_env_ids():
        parts = gym.spec(env_id).kwargs
        groups[f"control {parts.get('control')}, surface {parts.get('surface')}"].append(env_id)
    for group, ids in groups.items():
        print(group, *ids, sep="\n  ", end="\n\n")
    print("bulletarm-zoo list --env ID lists the spaces and parameters of one environment.")


def _list_parameters(env_id: str) -> None:
    with closing(make_env(env_id, {})) as env:
        print(f"{env_id}\nobservation: {env.observation_space}\naction: {env.action_space}\n")
        config: Any = getattr(env.unwrapped, "config", None)
    if config is not None:  # an environment of this package
        recipe = {name: gym.spec(env_id).kwargs.get(name) for name in ("control", "surface")}
        rows = [[name, repr(value)] for name, value in {**recipe, **config.parameters()}.items()]
        print_table(["parameter", "default"], rows, wrap=True)


def _list_baselines() -> None:
    for family in families():
        print(f"{family.envs}, presets {', '.join(family.presets)}\n")
        baselines = family.baselines.items()
        rows = [[name, row.learner, row.network, ", ".join(row.additions)] for name, row in baselines]
        print_table(["baseline", "learner", "network", "additions"], rows, wrap=True)
        print()


def _list_runs(args: argparse.Namespace) -> None:
    """Print the runs of a folder with their last evaluations."""
    from zoo_configs.results import read_experiments  # imports pandas and SciPy

    env_ids = None if args.env is None else [known_env_id(args.env)]
    rows = []
    for experiment in read_experiments(args.log_folder, env_ids, None, args.seed, args.device):
        for seed, result in experiment.results.items():
            state = "done" if result.is_done else "not done"
            figures = [str(seed), f"{result.success:.2f}", str(result.steps), state, result.run.device]
            folder = result.run.folder.relative_to(args.log_folder)
            rows.append([task_name(experiment.env_id), experiment.label, *figures, str(folder)])
    heads = ["task", "baseline", "seed", "success", "steps", "state", "device", "folder"]
    print_table(heads, rows)


def _list_published() -> None:
    """Print the published agents with the success on their cards."""
    rows = []
    for card in published_agents():
        low, high = card.interval
        parameters = ", ".join(f"{name}={value!r}" for name, value in card.env_kwargs.items())
        figures = [f"{card.success:.2f}", f"{low:.2f} to {high:.2f}", str(card.episodes)]
        rows.append([card.env, card.label, card.preset or "", *figures, parameters])
    heads = ["environment", "baseline", "preset", "success", "95 % interval", "episodes", "parameters"]
    print_table(heads, rows)
