"""One way to train: ``train``, a trial of ``tune`` and a cell of ``benchmark`` all come through here."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from uuid import uuid4

import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import set_random_seed

from sb3_extensions.common.checkpoint import CheckpointError, latest_checkpoint, latest_valid_checkpoint
from zoo_configs.algorithms import register_algorithms
from zoo_configs.arguments import check_device
from zoo_configs.cells.cell import Cell
from zoo_configs.cells.validation import check_cell, check_expert_data
from zoo_configs.environments import check_alike, known_env_id, make_env, register_environments, try_env
from zoo_configs.errors import CommandError
from zoo_configs.files import missing_folders
from zoo_configs.training.manager import ZooManager
from zoo_configs.training.options import TrainingOptions
from zoo_configs.training.runs import (
    Run,
    claim_run_folder,
    clear,
    discard_if_fruitless,
    load_run,
    write_resolved,
)
from zoo_configs.training.state import State, held
from zoo_configs.training.tracking import tracked


class TrainingInterrupted(KeyboardInterrupt):
    """
    Ctrl-C has ended a training, whose model is saved.

    :param run: The run, which can go on
    """

    def __init__(self, run: Run) -> None:
        super().__init__()
        self.run = run


def train_cell(
    cell: Cell,
    seed: int,
    device: str = "auto",
    folder: str | Path = "logs",
    *,
    options: TrainingOptions | None = None,
    at: str | Path | None = None,
    gym_packages: Sequence[str] = (),
    any_demonstrations: bool = False,
    callbacks: Sequence[BaseCallback] = (),
    progress: bool = False,
) -> Run:
    """
    Train one cell in a run folder.

    With ``at`` the run folder is chosen, and calling again goes on: what is done there is returned, what was
    killed goes on from its last checkpoint or begins anew. Without it a new folder is claimed, of which
    nothing is left if the run fails before it has a model or a checkpoint.

    :param cell: The cell, as from :func:`zoo_configs.cells.cell.resolve`
    :param seed: Seed of model and environments
    :param device: PyTorch device
    :param folder: Log folder
    :param options: How it is trained, default what the cell says
    :param at: Run folder
    :param gym_packages: Packages that register the environment, besides our own
    :param any_demonstrations: Whether a file of demonstrations may be of another environment
    :param callbacks: At work beside checkpoints and evaluation
    :param progress: Whether to show a progress bar
    :return: The run, trained
    :raises CommandError: for what cannot be trained; nothing is changed then
    :raises KeyboardInterrupt: after Ctrl-C, once the model is saved
    """
    register_environments(gym_packages)
    run = Run(Path(), cell, seed, device, options or TrainingOptions.of(cell), tuple(gym_packages))
    check_run(run, any_demonstrations)
    if at is not None:
        return _train_at(replace(run, folder=Path(at)), callbacks, progress)
    logs = Path(folder) / cell.algo
    made = missing_folders(logs)
    claimed = claim_run_folder(logs, cell.env_id, f"_{uuid4()}" if run.options.uuid else "")
    run = replace(run, folder=claimed)
    try:
        write_resolved(run)
        return _train(run, None, callbacks, progress)
    except BaseException:
        discard_if_fruitless(run, made)
        raise


def resume_run(run: Run, callbacks: Sequence[BaseCallback] = (), progress: bool = False) -> Run:
    """
    Go on with a run from its newest whole checkpoint.

    :param run: The run; its options and device may differ from those that it was begun with
    :param callbacks: At work beside checkpoints and evaluation
    :param progress: Whether to show a progress bar
    :return: The run, trained
    :raises CommandError: if there is no whole checkpoint, or the run is done
    :raises KeyboardInterrupt: after Ctrl-C, once the model is saved
    """
    register_environments(run.gym_packages)
    known_env_id(run.cell.env_id)
    check_run(run, resumed=True)
    return _train(run, _newest_checkpoint(run), callbacks, progress)


def check_run(run: Run, any_demonstrations: bool = False, resumed: bool = False) -> None:
    """
    Look whether a run can be trained, before anything is built.

    :param run: The run
    :param any_demonstrations: Whether a file of demonstrations may be of another environment
    :param resumed: Whether it has its demonstrations already
    :raises CommandError: if not, with the reason
    """
    cell, options = run.cell, run.options
    check_cell(cell)
    check_device(run.device)
    env_kwargs = cell.hyperparams.get("env_kwargs", {})
    try_env(cell.env_id, env_kwargs)
    with closing(make_env(cell.env_id, env_kwargs)) as env:
        if options.eval_env_kwargs:
            with closing(make_env(cell.env_id, {**env_kwargs, **options.eval_env_kwargs})) as eval_env:
                check_alike(eval_env, env, "--eval-env-kwargs")
        if not resumed:
            check_expert_data(cell, env, any_demonstrations)


def _train_at(run: Run, callbacks: Sequence[BaseCallback], progress: bool) -> Run:
    """Begin, go on, or return what is done."""
    if run.resolved_file.is_file():
        check_same(load_run(run.folder), run)
    standing = run.standing
    if standing is not None and standing.state is State.DONE:
        return run
    run.folder.mkdir(parents=True, exist_ok=True)
    if latest_checkpoint(run.checkpoint_folder) is not None:
        return _train(run, _newest_checkpoint(run), callbacks, progress)
    write_resolved(run)
    return _train(run, None, callbacks, progress)


def check_same(found: Run, wanted: Run) -> None:
    """
    Look whether what is in a folder is a part of the run that is to be trained there.

    :param found: What is there
    :param wanted: What is to be trained
    :raises CommandError: if its cell or its seed is another
    """
    for name in ("algo", "env_id", "hyperparams", "benchmark"):
        if getattr(found.cell, name) != getattr(wanted.cell, name):
            raise CommandError(f"{found.folder} holds a run with other {name}: take another folder")
    if found.seed != wanted.seed:
        raise CommandError(f"{found.folder} holds a run with seed {found.seed}, not {wanted.seed}")


def _newest_checkpoint(run: Run) -> Path:
    """The newest checkpoint that is whole."""
    try:
        checkpoint, damaged = latest_valid_checkpoint(run.checkpoint_folder)
    except CheckpointError as error:
        raise CommandError(str(error)) from error
    for damage in damaged:
        print(f"{damage}; going on from {checkpoint}", file=sys.stderr)
    return checkpoint


def _train(run: Run, checkpoint: Path | None, callbacks: Sequence[BaseCallback], progress: bool) -> Run:
    register_algorithms()
    logging = tracked(run) if run.options.track else nullcontext(run)
    with held(run.folder, checkpoint) as done, _threads(run.options.num_threads), logging as logged:
        if checkpoint is None:
            clear(run)
        set_random_seed(run.seed)
        manager = ZooManager(logged, checkpoint, callbacks, progress, done)
        built = manager.setup_experiment()
        assert built is not None  # it is only where rl_zoo3 searches for hyperparameters
        manager.learn(built[0])
        manager.save_trained_model(built[0])
        if manager.interrupted:
            raise TrainingInterrupted(run)
    return run


@contextmanager
def _threads(number: int) -> Iterator[None]:
    """Threads of PyTorch while a run is trained."""
    before = th.get_num_threads()
    if number > 0:
        th.set_num_threads(number)
    try:
        yield
    finally:
        th.set_num_threads(before)
