"""``bulletarm-zoo push``: puts a trained agent on the Hugging Face hub, or into a folder to load it from."""

from __future__ import annotations

import argparse
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from zoo_configs.arguments import Parser, add_progress, add_run_arguments, positive_int, seed
from zoo_configs.errors import CommandError

if TYPE_CHECKING:
    from huggingface_hub import HfApi

    from zoo_configs.agents import Agent

DESCRIPTION = """Put a trained agent on the Hugging Face hub, or with --folder into a folder: a small file
that its algorithm's load reads, evaluated as it was written, and a card of what it is and can do. The file
holds what acts, not what training would go on from. A token comes from `hf auth login` or HF_TOKEN."""
FILM_FILE = "replay.mp4"  # what the hub shows on the page of an agent
SHORT = 24  # frames of an episode, up to which a film shows two


def main(argv: Sequence[str]) -> None:
    """
    Run the command.

    :param argv: Its arguments
    :raises CommandError: if there is no such agent, no token, no network, or it cannot be published
    """
    args = _parse(argv)
    from zoo_configs.agents import agent_of, run_from_arguments
    from zoo_configs.environments import register_environments
    from zoo_configs.publishing.packing import check_publishable

    register_environments(args.gym_packages)
    if args.folder is not None:
        _check_replaceable(args.folder)
    run = run_from_arguments(args)
    check_publishable(run)
    agent = agent_of(run, args.load_best, args.device)
    if args.folder is None:
        _to_hub(agent, args)
    else:
        _to_folder(agent, args)
    if args.pictures is not None:
        _draw(agent, args)


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = Parser("bulletarm-zoo push", description=DESCRIPTION)
    add_run_arguments(parser)
    add = parser.add_argument
    add("-orga", "--organization", help="organisation or user of the hub whose repository it becomes")
    add("-name", "--repo-name", help="name of the repository (default: BASELINE-ENV)")
    add(
        "-m", "--commit-message", default="Add the agent", help="message of the commit (default: %(default)s)"
    )
    add("--no-render", action="store_true", help=f"upload no film ({FILM_FILE})")
    add("--folder", type=Path, help="write this folder instead; an agent that is there is replaced")
    add("-n", "--episodes", type=positive_int, default=100, help="how many episodes (default: 100)")
    add("--seed", type=seed, default=0, help="seed of the test scenes (default: 0)")
    add("--full-precision", action="store_true", help="do not halve the weights")
    add("--pictures", type=Path, help="folder for a film (GIF) and the learning curve as well")
    add("--commit", default="", help="commit that the agent was trained with (default: what the run says)")
    add_progress(parser)
    args = parser.parse_args(argv)
    if (args.organization is None) == (args.folder is None):
        parser.error("say where it goes: --organization (of the hub), or --folder")
    if args.folder is not None and (args.repo_name is not None or args.no_render):
        parser.error("--repo-name and --no-render are for the hub, not for --folder")
    args.n_envs, args.render, args.stochastic = 1, False, False  # as evaluations take them
    return args


def _to_hub(agent: Agent, args: argparse.Namespace) -> None:
    from zoo_configs.publishing.hub import connect, repository, upload
    from zoo_configs.training.runs import env_folder_name

    name = args.repo_name or f"{agent.label}-{env_folder_name(agent.env_id)}"
    repo_id = repository(args.organization, name)
    hub: HfApi = connect()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        _pack(agent, folder, args, repo_id)
        if not args.no_render:
            _film(agent, folder / FILM_FILE, args)
        print(f"Uploaded to {upload(hub, folder, repo_id, args.commit_message)}")


def _to_folder(agent: Agent, args: argparse.Namespace) -> None:
    with _whole_folder(args.folder) as partial:
        _pack(agent, partial, args, None)
    print("Written:")
    for path in sorted(args.folder.iterdir()):
        print(f"  {path}  {path.stat().st_size / 1000:.0f} kB")


def _pack(agent: Agent, folder: Path, args: argparse.Namespace, repo_id: str | None) -> None:
    from zoo_configs.publishing.packing import pack

    print(f"{agent.label} on {agent.env_id}, model {agent.path}")
    card = pack(agent, folder, args, repo_id)
    print(f"success_rate={card.success:.2f} episodes={card.episodes}")


def _draw(agent: Agent, args: argparse.Namespace) -> None:
    """For a page about the agent: a film, and how it was learned."""
    from zoo_configs.cells.rules import task_name
    from zoo_configs.drawing.curves import draw_curves, load_curve

    name = f"{task_name(agent.env_id)}-{agent.label}"
    written = [args.pictures / f"{name}.gif"]
    _film(agent, written[0], args)
    if agent.run is not None and agent.run.evaluations_file.is_file():
        written.append(args.pictures / f"{name}-curve.png")
        draw_curves({agent.env_id: {agent.label: load_curve(agent.run.evaluations_file)}}, written[1])
    print("\n".join(["Drawn:", *(f"  {path}" for path in written)]))


def _film(agent: Agent, path: Path, args: argparse.Namespace) -> None:
    """Film two episodes, of a long task one."""
    from zoo_configs.commands.record import FRAMES_PER_SECOND, acting, film
    from zoo_configs.drawing.video import write_video

    actor = acting(agent, args.env_kwargs)
    with closing(actor.env):
        frames = list(film(actor, 1, args.seed, progress=args.progress))
        if len(frames) <= SHORT:
            frames = list(film(actor, 2, args.seed, progress=args.progress))
    write_video(frames, path, FRAMES_PER_SECOND)


def _check_replaceable(folder: Path) -> None:
    """Only an agent's folder is replaced."""
    from zoo_configs.publishing.card import CARD_FILE

    if folder.exists() and not (folder / CARD_FILE).is_file() and not _is_empty(folder):
        raise CommandError(f"--folder: {folder} is there and holds no agent (it has no {CARD_FILE})")
    above = next(parent for parent in folder.absolute().parents if parent.exists())
    if not above.is_dir() or not os.access(above, os.W_OK):
        raise CommandError(f"--folder: {folder} cannot be written")


def _is_empty(folder: Path) -> bool:
    return folder.is_dir() and not any(folder.iterdir())


@contextmanager
def _whole_folder(folder: Path) -> Iterator[Path]:
    """Give a temporary folder that takes the place of another if the block succeeds, else it goes."""
    folder.absolute().parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{folder.name}-", dir=folder.absolute().parent) as scratch:
        partial = Path(scratch) / "new"
        partial.mkdir()
        yield partial
        if folder.exists():
            os.replace(folder, Path(scratch) / "old")
        shutil.move(partial, folder)
