"""The card of an agent: what it is, what it can do, and what made it, in JSON."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from zoo_configs.errors import CommandError, refused
from zoo_configs.files import whole_file

CARD_FILE = "card.json"
SUCCEEDED, FAILED = "1", "0"


@dataclass(frozen=True)
class Card:
    """
    What an agent is and can do.

    :param env: Id of the environment
    :param env_kwargs: Its parameters
    :param algo: Algorithm, by its name on the command line
    :param baseline: Row of a benchmark; None for an algorithm with hyperparameters of one's own
    :param preset: Size of the run
    :param benchmark: Benchmark whose parameters the task has
    :param seed: Of the training
    :param model: ``"best"`` of the run's own evaluations, or ``"last"``
    :param timesteps: How many time steps it was trained for
    :param file: Name of its file
    :param weights: What they are stored as
    :param success: Share of successful episodes of the agent in that file, its deterministic policy, on
        scenes unseen in training
    :param episodes: How many they were
    :param interval: Wilson's 95 % interval of the success
    :param mean_return: Mean of the episodes' sums of rewards
    :param std_return: Its standard deviation over the episodes
    :param test_seed: Seed of these scenes, ``enjoy --seed``
    :param outcomes: Of each episode, in order, 1 for success and 0
    :param evaluations: The run's own evaluations: lists ``timesteps`` and ``success``
    :param minutes: Of training; None if the run does not say
    :param command: Trains it again
    :param commit: It was trained with; empty if the run does not say
    :param date: Of the end of the training
    :param machine: It was trained on
    :param versions: It was trained with
    :param measured: ``date``, ``commit``, ``machine``, ``arithmetic`` and ``versions`` of the evaluation;
        with the last two the same, the outcomes are the same
    :param hyperparams: As resolved
    :param gym_packages: Packages that register the environment, besides our own
    """

    env: str
    env_kwargs: Mapping[str, Any]
    algo: str
    baseline: str | None
    preset: str | None
    benchmark: str | None
    seed: int
    model: str
    timesteps: int
    file: str
    weights: str
    success: float
    episodes: int
    interval: tuple[float, float]
    mean_return: float
    std_return: float
    test_seed: int
    outcomes: str
    evaluations: Mapping[str, Any]
    minutes: float | None
    command: str
    commit: str
    date: str
    machine: str
    versions: Mapping[str, str]
    measured: Mapping[str, Any]
    hyperparams: Mapping[str, Any]
    gym_packages: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """The baseline, or else the algorithm."""
        return self.baseline or self.algo

    def write(self, folder: Path) -> None:
        """
        Write the card.

        :param folder: Folder of the agent
        """
        with whole_file(folder / CARD_FILE) as partial:
            partial.write_text(json.dumps(dataclasses.asdict(self), indent=1) + "\n", encoding="utf-8")


def read_card(folder: Path) -> Card:
    """
    Read a card.

    :param folder: Folder of the agent
    :return: The card
    :raises CommandError: if there is none, or it lacks something
    """
    path = folder / CARD_FILE
    if not path.is_file():
        raise CommandError(f"{folder} is no folder of an agent: it has no {CARD_FILE}")
    with refused(f"{path} cannot be read"):
        content = json.loads(path.read_text(encoding="utf-8"))
        content["gym_packages"] = tuple(content.get("gym_packages", ()))
        return Card(**{**content, "interval": tuple(content["interval"])})
