"""Certificate of a run: checksums of its first updates, with which a repeated training can be compared."""

import hashlib
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from sb3_extensions.replay.buffer import ExpertReplayBuffer
from zoo_configs.errors import CommandError, refused
from zoo_configs.files import read_yaml, write_yaml
from zoo_configs.provenance import arithmetic
from zoo_configs.training.runs import Run

UPDATES = (0, 1, 2, 5, 10, 20, 50, 100, 200)
"""Numbers of updates after which the checksums are recorded."""
CHECKSUMS = "checksums"
OPTIONS = ("n_timesteps", "vec_env", "num_threads")
"""Options of a training on which the checksums depend."""

Row = Mapping[str, Any]
"""Number of ``updates``, and the checksum of each quantity after them."""


class FirstUpdatesDone(Exception):
    """End of a training after its first updates."""


class Certificate(BaseCallback):
    """
    Callback that writes checksums of a model after its first updates.

    Off-policy algorithms are recorded at the first rollout after each number in ``UPDATES``. A resumed run
    keeps the checksums before its checkpoint, and adds none if it resumes under other conditions.

    :param stop_after: Updates after which :class:`FirstUpdatesDone` is raised, None to continue
    """

    def __init__(self, run: Run, stop_after: int | None = None) -> None:
        super().__init__()
        self.run, self.stop_after = run, stop_after
        self._conditions = {**arithmetic(), **_conditions(run)}
        self._rows: list[Row] = []
        self._is_repeatable = True

    def _init_callback(self) -> None:
        if self.run.certificate.is_file():
            known = certificate_of(self.run)
            self._rows = [row for row in known[CHECKSUMS] if row["updates"] <= self._updates]
            self._is_repeatable = self._conditions.items() <= known.items()

    @property
    def _updates(self) -> int:
        return int(getattr(self.model, "_n_updates", 0))

    def _on_rollout_start(self) -> None:
        recorded = self._rows[-1]["updates"] if self._rows else -1
        if self._is_repeatable and any(recorded < number <= self._updates for number in UPDATES):
            self._rows.append({"updates": self._updates, **checksums(self.model)})
            write_yaml(self.run.certificate, {**self._conditions, CHECKSUMS: self._rows})
        if self.stop_after is not None and self._updates >= self.stop_after:
            raise FirstUpdatesDone

    def _on_step(self) -> bool:
        return True


def checksums(model: BaseAlgorithm) -> dict[str, str]:
    """Return the checksums of a model's next observations, replay buffer of ours, and parameters."""
    quantities: dict[str, Any] = {"observations": model._last_obs}
    quantities["parameters"] = model.policy.state_dict()
    if isinstance(buffer := getattr(model, "replay_buffer", None), ExpertReplayBuffer):
        stored = buffer.table.__getstate__()  # only rows that are used
        quantities["replay_buffer"] = [stored["observations"], stored["columns"]]
    return {name: _checksum(quantities[name]) for name in sorted(quantities)}


def _checksum(content: Any) -> str:
    found = hashlib.sha256()
    for part in _parts(content):
        found.update(part)
    return found.hexdigest()[:16]


def _parts(content: Any) -> Iterator[bytes]:
    """Yield the arrays of nested containers as bytes, sorted by their names."""
    if isinstance(content, Mapping):
        for name in sorted(content):
            yield name.encode()
            yield from _parts(content[name])
    elif isinstance(content, list | tuple):
        for item in content:
            yield from _parts(item)
    else:
        array = content.detach().cpu().numpy() if isinstance(content, th.Tensor) else np.asarray(content)
        yield f"{array.dtype} {array.shape}".encode()
        yield array.tobytes()


def _conditions(run: Run) -> dict[str, Any]:
    return {"device": run.device, "options": {name: getattr(run.options, name) for name in OPTIONS}}


def certificate_of(run: Run) -> dict[str, Any]:
    """
    Return the checksums of a run, and the device and the options with which they were computed.

    :raises CommandError: if the certificate is missing or damaged
    """
    path = run.certificate
    if not path.is_file():
        raise CommandError(f"{path} does not exist: this run has no certificate")
    content: dict[str, Any] = read_yaml(path)
    with refused(f"{path} cannot be read"):
        assert all(isinstance(row["updates"], int) for row in content[CHECKSUMS]), "updates must be numbers"
        assert content.keys() >= _conditions(run).keys(), "it must have a device and options"
    return content


def first_difference(recorded: Iterable[Row], found: Iterable[Row]) -> tuple[int, str] | None:
    """Return the number of updates and the name of the first quantity that differs, None if all are equal."""
    for one, other in zip(recorded, found, strict=False):
        for name, value in one.items():
            if other.get(name) != value:
                return one["updates"], name
    return None
