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

from zoo_configs.arguments import Parser, add_agent_flags, check_device, positive_int, query_of
from zoo_configs.environments import register_environments
from zoo_configs.errors import CommandError, refused
from zoo_configs.files import check_writable, print_written

if TYPE_CHECKING:
    from zoo_configs.agents import Agent

DESCRIPTION = """Upload a trained agent to the Hugging Face hub, or write it to a folder (--folder): a small
model file, tested as it was written, and a card. The token is that of `hf auth login` or HF_TOKEN."""


def main(argv: Sequence[str]) -> None:
    """Run the command."""
    args = _parse(argv)
    from zoo_configs.agents import agent_of, find_run
    from zoo_configs.publishing.packing import check_publishable

    register_environments(args.gym_packages)
    check_device(args.device)
    if args.folder is not None:
        _check_replaceable(args.folder)
    run = find_run(query_of(args))
    check_publishable(run)
    agent = agent_of(run, args.load_best, args.device)
    if args.folder is None:
        _to_hub(agent, args)
        return
    with _whole_folder(args.folder) as partial:
        _pack(agent, partial, args, None)
    print_written(*sorted(args.folder.iterdir()))


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = Parser("bulletarm-zoo push", description=DESCRIPTION)
    add_agent_flags(parser, is_run=True)
    add = parser.add_argument
    add("-orga", "--organization", help="organization or user of the repository on the hub")
    add("-name", "--repo-name", help="name of the repository (default: BASELINE-ENV)")
    add("--folder", type=Path, help="write this folder instead; an existing agent is replaced")
    add("-n", "--episodes", type=positive_int, default=100, help="number of test episodes (default: 100)")
    args = parser.parse_args(argv)
    if (args.organization is None) == (args.folder is None):
        parser.error("pass either --organization or --folder")
    if args.folder is not None and args.repo_name is not None:
        parser.error("--repo-name needs --organization")
    return args


def _to_hub(agent: Agent, args: argparse.Namespace) -> None:
    from huggingface_hub import HfApi
    from huggingface_hub.utils import validate_repo_id  # type: ignore[attr-defined]

    from zoo_configs.drawing.video import write_video
    from zoo_configs.recording import agent_actor, record
    from zoo_configs.training.runs import env_folder_name

    name = args.repo_name or f"{agent.label}-{env_folder_name(agent.env_id)}"
    repo_id = f"{args.organization}/{name}"
    with refused("--organization and --repo-name must be names of the hub"):
        validate_repo_id(repo_id)
    hub = HfApi()
    with refused("the Hugging Face hub cannot be used"):
        hub.whoami()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        _pack(agent, folder, args, repo_id)
        actor = agent_actor(agent, args.env_kwargs)
        with closing(actor.env):
            frames = list(record(actor, 2, args.seed, args.progress))
        write_video(frames, folder / "replay.mp4")  # the hub shows a file of this name
        with refused(f"{repo_id} cannot be written"):
            url = hub.create_repo(repo_id=repo_id, exist_ok=True)
            hub.upload_folder(repo_id=repo_id, folder_path=folder, commit_message="Add the agent")
    print(f"Uploaded to {url}")


def _pack(agent: Agent, folder: Path, args: argparse.Namespace, repo_id: str | None) -> None:
    from zoo_configs.evaluating import EvalOptions
    from zoo_configs.publishing.packing import pack

    print(f"{agent.label} on {agent.env_id}, model {agent.path}")
    options = EvalOptions(args.episodes, args.seed, env_kwargs=args.env_kwargs, progress=args.progress)
    card = pack(agent, folder, options, device=args.device, repo_id=repo_id)
    print(f"success_rate={card.success:.2f} episodes={card.episodes}")


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
