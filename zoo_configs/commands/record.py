"""``bulletarm-zoo record``: records videos of a trained agent or of the expert."""

import argparse
from contextlib import closing

from zoo_configs.agents import find_agent, query_of
from zoo_configs.arguments import check_device
from zoo_configs.drawing.video import Frame, write_video
from zoo_configs.environments import register_environments
from zoo_configs.files import check_writable, print_written
from zoo_configs.recording import Actor, agent_actor, expert_actor, record


def main(args: argparse.Namespace) -> None:
    """Run the command."""
    actor = _actor(args)
    path = args.output or actor.folder / f"{actor.task}-{actor.name}.{args.format}"
    check_writable(path, "--output")
    frames: list[Frame] = []
    with closing(actor.env):
        try:
            frames.extend(record(actor, args.episodes, args.seed, args.progress))
        finally:  # after Ctrl-C, too
            if frames:
                write_video(frames, path)
                print_written(path)


def _actor(args: argparse.Namespace) -> Actor:
    register_environments(args.gym_packages)
    if args.expert:
        check_device(args.device)
        return expert_actor(args.env, args.env_kwargs)
    agent = find_agent(query_of(args))
    actor = agent_actor(agent, args.env_kwargs)
    print(f"{agent.label} on {agent.env_id}, model {agent.path}")
    return actor
