"""Table of the values that an algorithm logs with its updates."""

from collections import defaultdict
from pathlib import Path

import pandas as pd
from stable_baselines3.common.callbacks import BaseCallback

from zoo_configs.drawing.curves import TIMESTEPS, read_training_log
from zoo_configs.files import whole_file

PREFIX = "train/"


class TrainingLog(BaseCallback):
    """
    Callback that writes the means of all values logged under ``train/``.

    Rows with a negative time step belong to the pretraining. The file is written atomically. A resumed run
    keeps the rows before its checkpoint.

    :param path: The CSV file
    :param freq: Time steps of all environments between two rows
    """

    def __init__(self, path: Path, freq: int) -> None:
        super().__init__()
        self.path, self.freq = path, freq
        self._rows: list[dict[str, float]] = []
        self._values: defaultdict[str, list[float]] = defaultdict(list)
        self._last: int | None = None

    def _init_callback(self) -> None:
        if self.path.is_file():
            known = read_training_log(self.path)
            rows = known[known[TIMESTEPS] <= training_time(self)].to_dict("records")
            self._rows = [{str(name): value for name, value in row.items()} for row in rows]

    def _on_rollout_start(self) -> None:
        # Between two rollouts, the logger still has the values of the latest updates.
        for name, value in self.logger.name_to_value.items():
            if name.startswith(PREFIX):
                self._values[name.removeprefix(PREFIX)].append(float(value))
        now = training_time(self)
        if self._last is None:  # only now the model has its number of pretraining steps
            self._last = now
        if now // self.freq > self._last // self.freq:
            self._write()

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        self._write()

    def _write(self) -> None:
        if not self._values:
            return
        now = self._last = training_time(self)
        means = {name: sum(values) / len(values) for name, values in self._values.items()}
        self._rows.append({TIMESTEPS: now, **means})
        self._values.clear()
        with whole_file(self.path) as partial:
            pd.DataFrame(self._rows).to_csv(partial, index=False)


def training_time(callback: BaseCallback) -> int:
    """Return the time steps so far, minus the remaining gradient steps of the pretraining."""
    left: int = getattr(callback.model, "pretraining_left", 0)
    return callback.model.num_timesteps - left
