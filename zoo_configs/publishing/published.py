"""Agents of the package: ``zoo_configs/published/<task>/<baseline>/``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from zoo_configs.cells.rules import task_name
from zoo_configs.environments import id_core
from zoo_configs.errors import unknown_name
from zoo_configs.publishing.card import CARD_FILE, Card, read_card

PUBLISHED_FOLDER = Path(__file__).resolve().parents[1] / "published"


class Published(NamedTuple):
    """Folder and card of a published agent."""

    folder: Path
    card: Card

    @property
    def model_file(self) -> Path:
        """Model file that ``load()`` of the algorithm reads."""
        return self.folder / self.card.file


def published_agents(folder: Path = PUBLISHED_FOLDER) -> list[Published]:
    """Return the published agents in a folder, sorted by task and baseline."""
    cards = sorted(folder.glob(f"*/*/{CARD_FILE}"))
    return [Published(card.parent, read_card(card.parent)) for card in cards]


def find_published(name: str, baseline: str | None = None) -> Published:
    """
    Find a published agent.

    :param name: Id of an environment, also without namespace and version; or a folder that ``push --folder``
        wrote or that was downloaded from the hub
    :param baseline: Its baseline; None selects the agent with the highest success rate
    :return: The agent
    :raises CommandError: for an unknown name; suggests the nearest one
    """
    if (Path(name) / CARD_FILE).is_file():
        return _of_baseline([Published(Path(name), read_card(Path(name)))], name, baseline)
    agents = published_agents()
    names = {task_name(agent.card.env): agent.card.env for agent in agents}
    env_id = names.get(name, name.rpartition(":")[2])
    of_env = [agent for agent in agents if agent.card.env == env_id]
    if not of_env:
        raise unknown_name("published agent", name, names, id_core)
    return _of_baseline(of_env, name, baseline)


def _of_baseline(agents: Sequence[Published], name: str, baseline: str | None) -> Published:
    fitting = [agent for agent in agents if baseline in (None, agent.card.label)]
    if not fitting:
        labels = [agent.card.label for agent in agents]
        raise unknown_name(f"baseline of the published agents on {name}:", str(baseline), labels)
    return max(fitting, key=lambda agent: agent.card.success)
