"""Training of one experiment: the common path of ``train``, ``tune`` and ``benchmark``."""

import shutil
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import asdict, replace
from pathlib import Path

import stable_baselines3 as sb3
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import set_random_seed

from sb3_extensions.common.checkpoint import CheckpointError, latest_checkpoint, latest_valid_checkpoint
from zoo_configs.arguments import check_device
from zoo_configs.environments import register_environments, tried_env
from zoo_configs.errors import CommandError
from zoo_configs.experiments.config import ExperimentConfig
from zoo_configs.files import made_folder, read_yaml
from zoo_configs.training.evaluation import save_model
from zoo_configs.training.options import TrainingOptions
from zoo_configs.training.runs import Run, claim_run_folder, clear, copy_statistics, load_run, write_resolved
from zoo_configs.training.state import State, run_lock
from zoo_configs.training.trainer import Trainer
from zoo_configs.training.validation import check_experiment, check_expert_data

RESULT_OPTIONS = ("n_timesteps", "eval_freq", "eval_episodes", "n_eval_envs", "trained_agent")
"""Options of a training that change its result or its evaluations."""


class TrainingInterrupted(KeyboardInterrupt):
    """Ctrl-C ended the training of ``run``, whose model is saved."""

    def __init__(self, run: Run) -> None:
        super().__init__()
        self.run = run


def train_experiment(
    experiment: ExperimentConfig,
    seed: int,
    device: str = "auto",
    folder: str | Path = "logs",
    *,
    options: TrainingOptions | None = None,
    at: str | Path | None = None,
    gym_packages: Sequence[str] = (),
    allow_mismatched_demos: bool = False,
    callbacks: Sequence[BaseCallback] = (),
    progress: bool = False,
) -> Run:
    """
    Train one experiment in a run folder.

    With ``at``, a repeated call continues: a finished run is returned, and a killed one resumes from its last
    checkpoint or starts again. Without ``at``, a new folder is created, which is removed if the run fails
    before it has a model or a checkpoint.

    :param experiment: The experiment, as from :func:`zoo_configs.experiments.config.resolve`
    :param seed: Seed of model and environments
    :param folder: Log folder
    :param options: Options of the training, None for those of the preset
    :param at: Run folder
    :param gym_packages: Packages that register the environment, in addition to ours
    :param allow_mismatched_demos: Whether ``expert_data`` may come from another environment
    :param callbacks: Callbacks in addition to those of the options
    :raises CommandError: for an experiment that cannot be trained; no file has changed then
    :raises KeyboardInterrupt: after Ctrl-C, when the model is saved
    """
    options = options or TrainingOptions.of(experiment)
    run = Run(Path(at or ""), experiment, seed, device, options, tuple(gym_packages))
    if at is not None:
        return train_run(run, callbacks, progress, allow_mismatched_demos)
    check_run(run, allow_mismatched_demos)
    logs = Path(folder) / experiment.algo
    with made_folder(logs):
        run = replace(run, folder=claim_run_folder(logs, experiment.env_id))
        try:
            return _train(run, None, callbacks, progress)
        except BaseException:
            if not run.has_model and latest_checkpoint(run.checkpoint_folder) is None:
                shutil.rmtree(run.folder, ignore_errors=True)
            raise


def resume_run(run: Run, progress: bool = False) -> Run:
    """
    Resume a run, whose options and device may have changed, from its latest valid checkpoint.

    :raises CommandError: if there is no valid checkpoint, the run is finished, or its file was edited
    :raises KeyboardInterrupt: after Ctrl-C, when the model is saved
    """
    begun = load_run(run.folder).options.eval_episodes
    if run.evaluations_file.is_file() and run.options.eval_episodes != begun:
        raise CommandError(f"eval_episodes must be {begun} as at the start, got {run.options.eval_episodes}")
    _check_unedited(run)
    check_run(run, allow_mismatched_demos=True)  # the replay buffer contains the demonstrations
    checkpoint = _latest_checkpoint(run)
    steps = int(checkpoint.name.split("_")[1])
    if run.status.state is State.DONE and steps >= run.n_timesteps:
        done = f"run {run.folder} is already finished ({steps} of {run.n_timesteps} steps)"
        raise CommandError(f"{done}. Pass a larger -n to continue.")
    return _train(run, checkpoint, (), progress)


def _check_unedited(run: Run) -> None:
    """Raise ``CommandError`` if the hyperparameters of a run have changed since its start."""
    ours, path = run.experiment.hyperparams, run.config_file
    theirs = read_yaml(path) if path.is_file() else ours
    if changed := [name for name in {**ours, **theirs} if ours.get(name) != theirs.get(name)]:
        raise CommandError(f"{', '.join(changed)} of {run.resolved_file} must be as in {path} at the start")


def check_run(run: Run, allow_mismatched_demos: bool) -> None:
    """Raise ``CommandError`` if a run cannot be trained, before anything is built."""
    register_environments(run.gym_packages)
    check_experiment(run.experiment)
    run.options.check_packages()
    check_device(run.device)
    env_kwargs = run.experiment.hyperparams.get("env_kwargs", {})
    with tried_env(run.experiment.env_id, env_kwargs) as env:
        if not allow_mismatched_demos:
            check_expert_data(run.experiment, env)


def check_same(found: Run, wanted: Run) -> None:
    """Raise ``CommandError`` if a run folder has another training than the run to train there."""
    for name in ("algo", "env_id", "hyperparams", "benchmark"):
        if getattr(found.experiment, name) != getattr(wanted.experiment, name):
            raise CommandError(f"{found.folder} has a run with different {name}. Use another folder.")
    theirs, ours = (
        {"seed": run.seed, **asdict(run.options), "n_timesteps": run.n_timesteps} for run in (found, wanted)
    )
    for name in ("seed", *RESULT_OPTIONS):
        if theirs[name] != ours[name]:
            raise CommandError(f"{found.folder} has a run with {name} {theirs[name]}, not {ours[name]}")


def train_run(
    run: Run,
    callbacks: Sequence[BaseCallback] = (),
    progress: bool = False,
    allow_mismatched_demos: bool = False,
) -> Run:
    """Start or resume a run in its folder, or return a finished one, as :func:`train_experiment` does."""
    check_run(run, allow_mismatched_demos)
    if run.resolved_file.is_file():
        check_same(load_run(run.folder), run)
    if run.status.state is State.DONE:
        return run
    run.folder.mkdir(parents=True, exist_ok=True)
    is_begun = latest_checkpoint(run.checkpoint_folder) is not None
    return _train(run, _latest_checkpoint(run) if is_begun else None, callbacks, progress)


def _latest_checkpoint(run: Run) -> Path:
    """Return the latest valid checkpoint, and report damaged later ones."""
    try:
        checkpoint, damaged = latest_valid_checkpoint(run.checkpoint_folder)
    except CheckpointError as error:
        raise CommandError(str(error)) from error
    for damage in damaged:
        print(f"{damage}. Resuming from {checkpoint}", file=sys.stderr)
    return checkpoint


def _train(run: Run, checkpoint: Path | None, callbacks: Sequence[BaseCallback], progress: bool) -> Run:
    with run_lock(run.folder, checkpoint), ExitStack() as stack:
        stack.callback(th.set_num_threads, th.get_num_threads())
        if run.options.num_threads > 0:
            th.set_num_threads(run.options.num_threads)
        logged = stack.enter_context(_tracked(run)) if run.options.track else run
        if checkpoint is None:
            clear(run)
            copy_statistics(run)
        set_random_seed(run.seed)
        trainer = stack.enter_context(closing(Trainer(logged, checkpoint, callbacks, progress)))
        write_resolved(run)
        if run.options.verbose:
            print(f"Training in {run.folder}", flush=True)
        finished = trainer.learn()
        save_model(run, trainer.model, run.last_model)
        if not finished:
            raise TrainingInterrupted(run)
    return run


@contextmanager
def _tracked(run: Run) -> Iterator[Run]:
    """Log a run to Weights & Biases, and provide the run with the TensorBoard folder that it reads."""
    import wandb

    name = f"{run.experiment.env_id}__{run.experiment.label}__{run.seed}__{int(time.time())}"
    session = wandb.init(
        name=name,
        tags=[f"v{sb3.__version__}"],
        config={"seed": run.seed, **asdict(run.options), **run.experiment.hyperparams},
        sync_tensorboard=True,
        save_code=True,
    )
    try:
        yield replace(run, options=replace(run.options, tensorboard_log=f"runs/{name.replace('/', '-')}"))
    finally:
        session.finish()
