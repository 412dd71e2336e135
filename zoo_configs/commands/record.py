"""``bulletarm-zoo record``: records videos of a trained agent or of the expert."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

from zoo_configs.arguments import Parser, add_agent_flags, positive_int, query_of
from zoo_configs.environments import register_environments
from zoo_configs.files import check_writable, print_written

if TYPE_CHECKING:
    from zoo_configs.recording import Actor

DESCRIPTION = """Record a video of a trained agent, of an agent of the package (--published), or of the expert
of --env (--expert). It shows the rendered scene next to the observed images and, for a policy over pixels,
the value of each pixel and the selected one."""
FORMATS = ("gif", "mp4")


def main(argv: Sequence[str]) -> None:
    """Run the command."""
    args = _parse(argv)
    from zoo_configs.drawing.video import Frame, write_video
    from zoo_configs.recording import record

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
    from zoo_configs.agents import find_agent
    from zoo_configs.recording import agent_actor, expert_actor

    register_environments(args.gym_packages)
    if args.expert:
        return expert_actor(args.env, args.env_kwargs)
    agent = find_agent(query_of(args))
    actor = agent_actor(agent, args.env_kwargs)
    print(f"{agent.label} on {agent.env_id}, model {agent.path}")
    return actor


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = Parser("bulletarm-zoo record", description=DESCRIPTION)
    add_agent_flags(parser)
    add = parser.add_argument
    add("--expert", action="store_true", help="record the expert of --env")
    add("-n", "--episodes", type=positive_int, default=5, help="number of episodes (default: 5)")
    add("--format", choices=FORMATS, default="gif", help="format without --output (default: gif)")
    add("-o", "--output", type=Path, help=".gif or .mp4 file to write (default: in the run folder)")
    args = parser.parse_args(argv)
    if args.output is not None and args.output.suffix[1:] not in FORMATS:
        parser.error(f"--output must end in .gif or .mp4, got {args.output}")
    if args.expert and (args.env is None or args.path is not None or args.published is not None):
        parser.error("--expert records the expert of --env: pass --env, and neither a path nor --published")
    return args
