"""The Hugging Face hub: putting a folder into a repository of its own."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from zoo_configs.errors import CommandError, refused

if TYPE_CHECKING:
    from huggingface_hub import HfApi


def connect() -> HfApi:
    """
    Log in, before the work whose result is to be uploaded.

    :return: The hub
    :raises CommandError: if there is no token, or the hub does not answer to it
    """
    from huggingface_hub import HfApi, get_token

    token = get_token()
    if not token:
        raise CommandError(
            "no token of the Hugging Face hub: run `hf auth login`, set HF_TOKEN, or write a --folder"
        )
    hub = HfApi(token=token)
    with refused("the Hugging Face hub cannot be used"):
        hub.whoami()
    return hub


def repository(organization: str, name: str) -> str:
    """
    The id of a repository.

    :param organization: Organisation, or user
    :param name: Its name
    :return: Both
    :raises CommandError: if the hub takes no such names
    """
    from huggingface_hub.utils import validate_repo_id  # type: ignore[attr-defined]

    repo_id = f"{organization}/{name}"
    with refused(f"--organization, --repo-name: {repo_id} is no repository"):
        validate_repo_id(repo_id)
    return repo_id


def upload(hub: HfApi, folder: Path, repo_id: str, message: str) -> str:
    """
    Put what is in a folder into a repository, which is made if it is not there.

    :param hub: The hub
    :param folder: The folder
    :param repo_id: The repository
    :param message: Of the commit
    :return: The repository's address
    :raises CommandError: if the hub refuses it, or cannot be reached any more
    """
    with refused(f"{repo_id} cannot be written"):
        url = hub.create_repo(repo_id=repo_id, exist_ok=True)
        hub.upload_folder(repo_id=repo_id, folder_path=folder, commit_message=message)
    return str(url)
