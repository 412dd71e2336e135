"""``bulletarm-zoo demos``: collects demonstrations of an expert."""

import argparse
from statistics import fmean

from bulletarm_gym.demonstrations import collect
from zoo_configs.arguments import check_device
from zoo_configs.environments import known_env_id, register_environments, tried_env
from zoo_configs.errors import CommandError, refused
from zoo_configs.files import check_writable, print_written


def main(args: argparse.Namespace) -> None:
    """Run the command."""
    check_device(args.device)
    register_environments(args.gym_packages)
    env_id = known_env_id(args.env)
    path = args.output or args.log_folder / f"{env_id.rpartition('/')[2]}-{args.planner}.h5"
    check_writable(path, "--output")
    if path.exists():
        raise CommandError(f"--output must be a new file, got {path}, which exists")
    with tried_env(env_id, args.env_kwargs):
        pass
    settings = {"seed": args.seed, "env_kwargs": args.env_kwargs, "path": path, "progress": args.progress}
    with refused(f"{env_id}: no demonstrations", (RuntimeError, ValueError)):
        found = collect(env_id, args.episodes, args.planner, **settings)
    length = fmean(len(episode) for episode in found)
    print(f"{env_id}: {len(found)} of {found.attempts} attempts succeeded, mean_length={length:.2f}")
    print_written(path)
