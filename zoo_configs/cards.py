"""Published agents and their cards, in ``zoo_configs/published/<task>/<baseline>/`` or another folder."""

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from zoo_configs.errors import CommandError, check_names, refused, unknown_name
from zoo_configs.experiments.families import task_name
from zoo_configs.files import whole_file
from zoo_configs.training.runs import Origin

PUBLISHED_FOLDER = Path(__file__).resolve().parent / "published"
CARD_FILE, PAGE_FILE = "card.json", "README.md"
SUCCEEDED, FAILED = "1", "0"


@dataclass(frozen=True)
class Card(Origin):
    """
    Description of an agent, and of the experiment and the origin of its run.

    :param model: ``"best"`` (by the evaluations of the run) or ``"last"``
    :param file: Name of the model file
    :param weights: Data type of the stored weights
    :param success: Success rate of the stored agent with its deterministic policy on test scenes
    :param interval: Wilson's 95 % interval of the success rate
    :param test_seed: Seed of the test scenes (``enjoy --seed``)
    :param outcomes: One character for each test episode: 1 for success, 0 for failure
    :param evaluations: Evaluations of the run: ``episodes`` and lists ``timesteps`` and ``success``
    :param measured: ``date``, ``commit``, ``machine``, ``arithmetic`` and ``versions`` of the test; if
        ``arithmetic`` and ``versions`` are equal, so are the outcomes
    :param certificate: Checksums of the first updates (:mod:`zoo_configs.training.certificate`)
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
    measured: Mapping[str, Any]
    hyperparams: Mapping[str, Any]
    gym_packages: tuple[str, ...] = ()
    certificate: Mapping[str, Any] = field(default_factory=dict)
    folder: Path = Path()

    @property
    def label(self) -> str:
        """Baseline or, without one, algorithm."""
        return self.baseline or self.algo

    @property
    def model_file(self) -> Path:
        """Model file that ``load()`` of the algorithm reads."""
        return self.folder / self.file

    def write(self) -> None:
        """Write the card atomically to its folder, which it does not name."""
        content = {name: value for name, value in dataclasses.asdict(self).items() if name != "folder"}
        with whole_file(self.folder / CARD_FILE) as partial:
            partial.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def read_card(folder: Path) -> Card:
    """Read the card in a folder; raise ``CommandError`` if it is missing or incomplete."""
    path = folder / CARD_FILE
    if not path.is_file():
        raise CommandError(f"{folder} is not a folder of an agent: {CARD_FILE} is missing")
    with refused(f"{path} cannot be read"):
        content = json.loads(path.read_text(encoding="utf-8"))
        content["gym_packages"] = tuple(content.get("gym_packages", ()))
        return Card(**{**content, "interval": tuple(content["interval"]), "folder": folder})


def published_agents() -> list[Card]:
    """Return the cards of the agents of the package, sorted by task and baseline."""
    return [read_card(path.parent) for path in sorted(PUBLISHED_FOLDER.glob(f"*/*/{CARD_FILE}"))]


def find_published(name: str, baseline: str | None = None) -> Card:
    """
    Return the card of a published agent.

    :param name: Id of an environment, also without namespace and version; or a folder that ``push --folder``
        wrote or that was downloaded from the hub
    :param baseline: Its baseline; None selects the agent with the highest success rate
    :raises CommandError: for an unknown name; suggests the nearest one
    """
    if (Path(name) / CARD_FILE).is_file():
        cards = [read_card(Path(name))]
    else:
        env_ids = {task_name(card.env): card.env for card in published_agents()}
        env_id = env_ids.get(name, name.rpartition(":")[2])
        cards = [card for card in published_agents() if card.env == env_id]
        if not cards:
            raise unknown_name("published agent", name, env_ids)
    labels = [card.label for card in cards]
    check_names(f"baseline of the published agents on {name}:", filter(None, [baseline]), labels)
    fitting = [card for card in cards if baseline in (None, card.label)]
    return max(fitting, key=lambda card: card.success)
