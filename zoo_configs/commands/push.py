"""``bulletarm-zoo push``: uploads a trained agent to the Hugging Face hub, or writes it to a folder."""

import argparse
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from zoo_configs.agents import Agent, agent_of, find_run, query_of
from zoo_configs.arguments import check_device
from zoo_configs.cards import CARD_FILE, PAGE_FILE
from zoo_configs.drawing.video import write_video
from zoo_configs.environments import register_environments
from zoo_configs.errors import CommandError, refused
from zoo_configs.evaluating import EvalOptions
from zoo_configs.files import check_writable, made_folder, print_written
from zoo_configs.publishing.packing import check_publishable, pack
from zoo_configs.recording import agent_actor, record
from zoo_configs.training.runs import env_folder_name


def main(args: argparse.Namespace) -> None:
    """Run the command."""
    register_environments(args.gym_packages)
    check_device(args.device)
    if args.folder is not None:
        args.folder = args.folder.resolve()  # a link stays
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


def _to_hub(agent: Agent, args: argparse.Namespace) -> None:
    from huggingface_hub import HfApi
    from huggingface_hub.utils import validate_repo_id  # type: ignore[attr-defined]

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
    print(f"{agent.label} on {agent.env_id}, model {agent.path}")
    options = EvalOptions(args.episodes, args.seed, env_kwargs=args.env_kwargs, progress=args.progress)
    card = pack(agent, folder, options, args.device, repo_id)
    print(f"success_rate={card.success:.2f} episodes={card.episodes}")


def _check_replaceable(folder: Path) -> None:
    """Check that a folder can be written: only an empty folder or one with an agent alone is replaced."""
    if folder in (Path.cwd(), *Path.cwd().parents):
        raise CommandError(f"--folder must not contain the working directory, got {folder}")
    names = [path.name for path in folder.iterdir()] if folder.is_dir() else []
    others = [name for name in names if name not in (CARD_FILE, PAGE_FILE) and not name.endswith(".zip")]
    if folder.is_file() or others or (names and CARD_FILE not in names):
        found = f"{folder} with {', '.join(sorted(others or names)[:3])}" if names else folder
        raise CommandError(f"--folder must be new, empty or have an agent and nothing else, got {found}")
    check_writable(folder / CARD_FILE, "--folder")


@contextmanager
def _whole_folder(folder: Path) -> Iterator[Path]:
    """Provide a temporary folder that replaces ``folder`` if the block succeeds, and is removed otherwise."""
    prefix, parent = f".{folder.name}-", folder.parent
    with made_folder(parent), tempfile.TemporaryDirectory(prefix=prefix, dir=parent) as scratch:
        partial = Path(scratch) / "new"
        partial.mkdir()
        yield partial
        if folder.exists():
            folder.rename(Path(scratch) / "old")
        partial.rename(folder)
