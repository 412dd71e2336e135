"""Hooks of MkDocs: pages of the tasks, the version, and the address of the repository."""

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import tomllib
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
sys.path.insert(0, str(HERE.parent))

from website import agents, gallery, task_page  # noqa: E402
from website.catalogue import SHOWN, grouped  # noqa: E402

FOLDER = "tasks"
EXAMPLES = ROOT / "examples"
SSH = re.compile(r"^(?:ssh://)?git@([\w.-]+)[:/](.+)$")


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Add the version, the repository and the navigation of the tasks."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    config.extra["version_name"] = project["version"]
    config.copyright = f"BulletArm Gym {project['version']}, MIT licence"
    config.repo_url = config.repo_url or repository(project)
    config.repo_name = config.repo_name or ("Repository" if config.repo_url else None)
    for item in config.nav or []:
        if "Tasks" in item:
            item["Tasks"] = navigation()
    return config


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Add the generated pages of the environments and the notebooks."""
    pages = {"index": gallery.page(), **{one.name: task_page.page(one) for one in SHOWN}}
    for name, content in pages.items():
        files.append(File.generated(config, f"{FOLDER}/{name}.md", content=content))
    for path in sorted(EXAMPLES.glob("tutorials/*.ipynb")):
        name = path.relative_to(EXAMPLES).as_posix()
        files.append(File(name, str(EXAMPLES), config.site_dir, config.use_directory_urls))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Insert the tables of trained agents, and point links to notebooks at their copies in the site."""
    return agents.filled(markdown).replace("](../examples/tutorials/", "](tutorials/")


def navigation() -> list[Any]:
    """Return the gallery and the tasks of each group."""
    groups = {
        heading: [{f"{one.title}, {one.setting}": f"{FOLDER}/{one.name}.md"} for one in members]
        for heading, members in grouped().items()
    }
    return [f"{FOLDER}/index.md", *({heading: members} for heading, members in groups.items())]


def repository(project: dict[str, Any]) -> str | None:
    """Return the address of the repository from pyproject.toml, else that of a public remote.

    :param project: table ``project`` of pyproject.toml
    """
    urls: dict[str, str] = project.get("urls", {})
    named = next((urls[name] for name in urls if name.lower() in ("repository", "source")), None)
    return named or _origin()


def _origin() -> str | None:
    command = ["git", "-C", str(ROOT), "remote", "get-url", "origin"]
    try:
        url = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None
    url = SSH.sub(r"https://\1/\2", url).removesuffix(".git")
    return url if url.startswith("https://") and "@" not in url else None
