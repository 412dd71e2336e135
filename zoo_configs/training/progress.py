"""Progress bar of a training."""

from __future__ import annotations

import sys

from rich.console import Console
from stable_baselines3.common.callbacks import ProgressBarCallback
from tqdm.rich import tqdm


class TrainingBar(ProgressBarCallback):
    """Stable-Baselines3's progress bar on the standard error."""

    def _on_training_start(self) -> None:
        # On a terminal, printed lines appear above the bar.
        options = {"console": Console(stderr=True), "redirect_stdout": sys.stdout.isatty()}
        left = self.locals["total_timesteps"] - self.model.num_timesteps
        self.pbar = tqdm(total=left, options=options)

    def close(self) -> None:
        """Remove the bar after an interruption."""
        if hasattr(self, "pbar"):
            self.pbar.close()
