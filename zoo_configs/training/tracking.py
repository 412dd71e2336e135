"""Weights & Biases, as with ``rl_zoo3.train --track``."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import stable_baselines3 as sb3

from zoo_configs.training.runs import Run


@contextmanager
def tracked(run: Run) -> Iterator[Run]:
    """
    Log a run to Weights & Biases while it is trained.

    Its environment variables apply, such as ``WANDB_PROJECT``, ``WANDB_ENTITY`` and ``WANDB_MODE=offline``.

    :param run: The run
    :return: Context manager of the run with a TensorBoard folder, which Weights & Biases reads
    """
    import wandb

    name = f"{run.experiment.env_id}__{run.experiment.label}__{run.seed}__{int(time.time())}"
    session = wandb.init(
        name=name,
        tags=[f"v{sb3.__version__}"],
        config={"seed": run.seed, **run.options.plain(), **run.experiment.hyperparams},
        sync_tensorboard=True,
        save_code=True,
    )
    try:
        yield replace(run, options=replace(run.options, tensorboard_log=f"runs/{name.replace('/', '-')}"))
    finally:
        session.finish()
