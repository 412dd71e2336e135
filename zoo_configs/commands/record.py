"""``bulletarm-zoo record``: records videos of a trained agent or of the expert."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

from zoo_configs.arguments import Parser, add_progress, positive_int, seed
from zoo_configs.commands.agent_flags import add_agent_flags, query_of
from zoo_configs.environments import register_environments
from zoo_configs.errors import CommandError
from zoo_configs.files import check_writable, print_written

if TYPE_CHECKING:
    from zoo_configs.recording import Actor

DESCRIPTION = """Record a video of a trained agent, of an agent of the package (--published), or of the expert
of --env (--expert). It shows the rendered scene next to the observed images and, for a policy over pixels,
the value of each pixel and the selected one."""
FORMATS = ("gif", "mp4")
FRAMES_PER_SECOND = 5.0


def main(argv: Sequence[str]) -> None:
    """
    Run the command.

    :param argv: Its arguments
    :raises CommandError: if no agent fits, or the environment has no expert
    """
    args = _parse(argv)
    from zoo_configs.drawing.video import Frame, write_video
    from zoo_configs.recording import record

    actor = _actor(args)
    path = args.output or actor.folder / f"{actor.task}-{actor.name}.{args.format}"
    check_writable(path, "--output")
    frames: list[Frame] = []
    with closing(actor.env):
        try:
            frames.extend(record(actor, args.episodes, args.seed, args.fps, args.progress))
        finally:  # after Ctrl-C, too
            if frames:
                write_video(frames, path, args.fps)
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
    add("--seed", type=seed, default=0, help="seed of the scenes (default: 0, as in enjoy)")
    add("--format", choices=FORMATS, help="format of the video (default: gif, or that of --output)")
    add("-o", "--output", type=Path, help="file to write (default: in the run folder)")
    fps = f"steps per second (default: {FRAMES_PER_SECOND:g})"
    add("--fps", type=float, default=FRAMES_PER_SECOND, help=fps)
    add_progress(parser)
    args = parser.parse_args(argv)
    suffix = None if args.output is None else args.output.suffix[1:]
    if suffix is not None and suffix not in FORMATS:
        parser.error(f"--output must end in .gif or .mp4, got {args.output}")
    if None not in (suffix, args.format) and suffix != args.format:
        parser.error(f"--output must end in .{args.format} with --format {args.format}, got {args.output}")
    if not 0 < args.fps < math.inf:
        parser.error(f"--fps must be positive, got {args.fps}")
    if args.expert and args.env is None:
        parser.error("--expert needs --env")
    if args.expert and (args.path is not None or args.published is not None):
        raise CommandError("--expert records the expert: pass neither a path nor --published")
    args.format = args.format or "gif"
    return args
