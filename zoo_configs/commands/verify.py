"""``bulletarm-zoo verify``: trains the first updates of an agent again and compares checksums."""

import argparse
import contextlib
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from zoo_configs.agents import register_run
from zoo_configs.cards import find_published
from zoo_configs.errors import CommandError
from zoo_configs.experiments.config import ExperimentConfig
from zoo_configs.provenance import arithmetic
from zoo_configs.training.certificate import (
    CHECKSUMS,
    Certificate,
    FirstUpdatesDone,
    Row,
    certificate_of,
    first_difference,
)
from zoo_configs.training.runs import Run, load_run
from zoo_configs.training.train import train_run


def main(args: argparse.Namespace) -> None:
    """Run the command."""
    if args.published is not None:
        run, certificate = _of_published(args)
    else:
        run = load_run(args.path)
        certificate = certificate_of(run)
    options = replace(run.options, **certificate["options"])
    run = replace(run, device=certificate["device"], options=options)
    register_run(run)
    recorded = [row for row in certificate[CHECKSUMS] if row["updates"] <= args.updates]
    last = recorded[-1]["updates"]
    print(f"{run.experiment.env_id}, {run.experiment.label}, seed {run.seed}: {last} updates")
    found = _repeat(run, last, args.progress)
    if difference := first_difference(recorded, found):
        updates, quantity = difference
        others = {name: certificate[name] for name, here in arithmetic().items() if certificate[name] != here}
        reason = f"; it was trained with {others}" if others else ""
        raise CommandError(f"{quantity} differ after {updates} updates{reason}")
    quantities = ", ".join(name for name in recorded[-1] if name != "updates")
    print(f"equal after {', '.join(str(row['updates']) for row in recorded)} updates: {quantities}")


def _of_published(args: argparse.Namespace) -> tuple[Run, dict[str, Any]]:
    card = find_published(args.published, args.baseline)
    if not card.certificate:
        raise CommandError(f"{card.folder} has no certificate")
    experiment = ExperimentConfig(card.algo, card.env, dict(card.hyperparams), baseline=card.baseline)
    run = Run(card.folder, experiment, card.seed, gym_packages=card.gym_packages)
    return run, dict(card.certificate)


def _repeat(run: Run, updates: int, progress: bool) -> Sequence[Row]:
    """Train the first updates of a run again, and return their checksums."""
    options = replace(run.options, eval_freq=0, save_freq=0, tensorboard_log="", track=False, verbose=0)
    with tempfile.TemporaryDirectory() as folder:
        again = replace(run, folder=Path(folder) / "run", options=options)
        with contextlib.suppress(FirstUpdatesDone):
            train_run(again, [Certificate(again, updates)], progress, allow_mismatched_demos=True)
        rows: Sequence[Row] = certificate_of(again)[CHECKSUMS]
        return rows
