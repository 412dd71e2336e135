"""``bulletarm-zoo push``: uploads a trained agent to the Hugging Face hub, or writes it to a folder."""

from __future__ import annotations

import argparse
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from zoo_configs.arguments import Parser, add_progress, positive_int, seed
from zoo_configs.commands.agent_flags import add_agent_flags, query_of
from zoo_configs.environments import register_environments
from zoo_configs.errors import CommandError
from zoo_configs.files import check_writable, print_written

if TYPE_CHECKING:
    from zoo_configs.agents import Agent

DESCRIPTION = """Upload a trained agent to the Hugging Face hub, or write it to a folder (--folder): a small
model file, tested as it was written, and a card. The token is that of `hf auth login` or HF_TOKEN."""
VIDEO_FILE = "replay.mp4"  # name that the hub shows


def main(argv: Sequence[str]) -> None:
    """
    Run the command.

    :param argv: Its arguments
    :raises CommandError: if no run fits, it cannot be published, or the hub cannot be used
    """
    args = _parse(argv)
    from zoo_configs.agents import agent_of, find_run
    from zoo_configs.publishing.packing import check_publishable

    register_environments(args.gym_packages)
    if args.folder is not None:
        _check_replaceable(args.folder)
    run = find_run(query_of(args))
    check_publishable(run)
    agent = agent_of(run, args.load_best, args.device)
    if args.folder is None:
        _to_hub(agent, args)
    else:
        _to_folder(agent, args)


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = Parser("bulletarm-zoo push", description=DESCRIPTION)
    add_agent_flags(parser, is_run=True)
    add = parser.add_argument
    add("-orga", "--organization", help="organization or user of the repository on the hub")
    add("-name", "--repo-name", help="name of the repository (default: BASELINE-ENV)")
    message = "message of the commit (default: %(default)s)"
    add("-m", "--commit-message", default="Add the agent", help=message)
    add("--no-render", action="store_true", help=f"upload no video ({VIDEO_FILE})")
    add("--folder", type=Path, help="write this folder instead; an existing agent is replaced")
    add("-n", "--episodes", type=positive_int, default=100, help="number of test episodes (default: 100)")
    add("--seed", type=seed, default=0, help="seed of the test scenes (default: 0)")
    add("--full-precision", action="store_true", help="store the weights in float32")
    add_progress(parser)
    args = parser.parse_args(argv)
    if (args.organization is None) == (args.folder is None):
        parser.error("pass either --organization or --folder")
    if args.folder is not None and (args.repo_name is not None or args.no_render):
        parser.error("--repo-name and --no-render need --organization")
    return args


def _to_hub(agent: Agent, args: argparse.Namespace) -> None:
    from zoo_configs.publishing.hub import connect, repository, upload
    from zoo_configs.training.runs import env_folder_name

    name = args.repo_name or f"{agent.label}-{env_folder_name(agent.env_id)}"
    repo_id = repository(args.organization, name)
    hub = connect()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        _pack(agent, folder, args, repo_id)
        if not args.no_render:
            _record(agent, folder / VIDEO_FILE, args)
        print(f"Uploaded to {upload(hub, folder, repo_id, args.commit_message)}")


def _to_folder(agent: Agent, args: argparse.Namespace) -> None:
    with _whole_folder(args.folder) as partial:
        _pack(agent, partial, args, None)
    print_written(*sorted(args.folder.iterdir()))


def _pack(agent: Agent, folder: Path, args: argparse.Namespace, repo_id: str | None) -> None:
    from zoo_configs.evaluating import EvalOptions
    from zoo_configs.publishing.packing import pack

    print(f"{agent.label} on {agent.env_id}, model {agent.path}")
    options = EvalOptions(args.episodes, args.seed, env_kwargs=args.env_kwargs, progress=args.progress)
    full = args.full_precision
    card = pack(agent, folder, options, device=args.device, full_precision=full, repo_id=repo_id)
    print(f"success_rate={card.success:.2f} episodes={card.episodes}")


def _record(agent: Agent, path: Path, args: argparse.Namespace) -> None:
    """Record two episodes."""
    from zoo_configs.drawing.video import write_video
    from zoo_configs.recording import FRAMES_PER_SECOND, agent_actor, record

    actor = agent_actor(agent, args.env_kwargs)
    with closing(actor.env):
        frames = list(record(actor, 2, args.seed, progress=args.progress))
    write_video(frames, path, FRAMES_PER_SECOND)


def _check_replaceable(folder: Path) -> None:
    """Check that a folder can be written: only an empty folder or that of an agent is replaced."""
    from zoo_configs.publishing.published import CARD_FILE

    is_empty = folder.is_dir() and not any(folder.iterdir())
    if folder.exists() and not is_empty and not (folder / CARD_FILE).is_file():
        raise CommandError(f"--folder must be new, empty or an agent's ({CARD_FILE}), got {folder}")
    check_writable(folder / CARD_FILE, "--folder")


@contextmanager
def _whole_folder(folder: Path) -> Iterator[Path]:
    """Provide a temporary folder that replaces ``folder`` if the block succeeds, and is removed otherwise."""
    folder.absolute().parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{folder.name}-", dir=folder.absolute().parent) as scratch:
        partial = Path(scratch) / "new"
        partial.mkdir()
        yield partial
        if folder.exists():
            os.replace(folder, Path(scratch) / "old")
        shutil.move(partial, folder)
