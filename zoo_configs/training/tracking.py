"""Weights & Biases, as ``rl_zoo3.train --track`` uses it."""

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
    Log a run to Weights & Biases while it is trained; its own settings hold (``WANDB_MODE=offline``).

    :param run: The run
    :return: Context manager of the run, which logs to TensorBoard, from where the package takes it
    """
    import wandb  # type: ignore[import-not-found]

    options = run.options
    name = f"{run.cell.env_id}__{run.cell.label}__{run.seed}__{int(time.time())}"
    session = wandb.init(
        name=name,
        project=options.wandb_project_name,
        entity=options.wandb_entity,
        group=options.wandb_group,
        tags=[*options.wandb_tags, f"v{sb3.__version__}"],
        config={"seed": run.seed, **options.plain(), **run.cell.hyperparams},
        sync_tensorboard=True,
        save_code=True,
    )
    try:
        yield replace(run, options=replace(options, tensorboard_log=f"runs/{name.replace('/', '-')}"))
    finally:
        session.finish()
