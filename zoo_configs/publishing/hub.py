"""Upload of a folder to the Hugging Face hub."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from zoo_configs.errors import CommandError, refused

if TYPE_CHECKING:
    from huggingface_hub import HfApi


def connect() -> HfApi:
    """Log in to the hub; raise ``CommandError`` without a token that the hub accepts."""
    from huggingface_hub import HfApi, get_token

    token = get_token()
    if not token:
        raise CommandError(
            "no token of the Hugging Face hub. Run `hf auth login`, set HF_TOKEN, or pass --folder"
        )
    hub = HfApi(token=token)
    with refused("the Hugging Face hub cannot be used"):
        hub.whoami()
    return hub


def repository(organization: str, name: str) -> str:
    """Return the id of a repository; raise ``CommandError`` if the hub does not allow the names."""
    from huggingface_hub.utils import validate_repo_id  # type: ignore[attr-defined]

    repo_id = f"{organization}/{name}"
    with refused("--organization and --repo-name must be names of the hub"):
        validate_repo_id(repo_id)
    return repo_id


def upload(hub: HfApi, folder: Path, repo_id: str, message: str) -> str:
    """Upload the files of a folder to a repository, which is created if needed, and return its address."""
    with refused(f"{repo_id} cannot be written"):
        url = hub.create_repo(repo_id=repo_id, exist_ok=True)
        hub.upload_folder(repo_id=repo_id, folder_path=folder, commit_message=message)
    return str(url)
