"""The progress bar of a training."""

from __future__ import annotations

import sys

from rich.console import Console
from stable_baselines3.common.callbacks import ProgressBarCallback
from tqdm.rich import tqdm


class TrainingBar(ProgressBarCallback):
    """Stable-Baselines3's bar on the error output, as all other bars: the output may be a file."""

    def _on_training_start(self) -> None:
        # Above the bar is what is printed meanwhile, where both are on one terminal.
        options = {"console": Console(stderr=True), "redirect_stdout": sys.stdout.isatty()}
        left = self.locals["total_timesteps"] - self.model.num_timesteps
        self.pbar = tqdm(total=left, options=options)
