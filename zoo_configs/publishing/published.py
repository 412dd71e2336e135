"""Agents that come with the package: ``zoo_configs/published/<task>/<baseline>/``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from zoo_configs.cells.rules import task_name
from zoo_configs.errors import CommandError
from zoo_configs.publishing.card import CARD_FILE, Card, read_card

PUBLISHED_FOLDER = Path(__file__).resolve().parents[1] / "published"
SEE = "see bulletarm-zoo list --published"


class Published(NamedTuple):
    """
    An agent to load.

    :param folder: Where it stands
    :param card: What it is and can do
    """

    folder: Path
    card: Card

    @property
    def model_file(self) -> Path:
        """What its algorithm's ``load`` takes."""
        return self.folder / self.card.file


def published_agents(folder: Path = PUBLISHED_FOLDER) -> list[Published]:
    """
    Agents that come with the package.

    :param folder: Where they stand
    :return: The agents, by task and baseline
    :raises CommandError: if a card cannot be read
    """
    return [Published(card.parent, read_card(card.parent)) for card in sorted(_cards(folder))]


def _cards(folder: Path) -> Iterator[Path]:
    return folder.glob(f"*/*/{CARD_FILE}")


def find_published(name: str, baseline: str | None = None) -> Published:
    """
    Find a published agent.

    :param name: Id of an environment, or what it is called without namespace and version; or a folder that
        ``push --folder`` wrote, or that was downloaded from a hub
    :param baseline: Its baseline; None takes the one that succeeded most often
    :return: The agent
    :raises CommandError: if there is none, with those that there are
    """
    if (Path(name) / CARD_FILE).is_file():
        return _of_baseline([Published(Path(name), read_card(Path(name)))], name, baseline)
    agents = published_agents()
    names = {task_name(agent.card.env): agent.card.env for agent in agents}
    env_id = names.get(name, name.rpartition(":")[2])
    of_env = [agent for agent in agents if agent.card.env == env_id]
    if not of_env:
        there = ", ".join(sorted(names)) or "none"
        raise CommandError(f"no published agent on {name!r}, there are: {there}")
    return _of_baseline(of_env, name, baseline)


def _of_baseline(agents: Sequence[Published], name: str, baseline: str | None) -> Published:
    fitting = [agent for agent in agents if baseline in (None, agent.card.label)]
    if not fitting:
        there = ", ".join(agent.card.label for agent in agents)
        raise CommandError(f"no published agent of {baseline!r} on {name}, there is {there}; {SEE}")
    return max(fitting, key=lambda agent: agent.card.success)
