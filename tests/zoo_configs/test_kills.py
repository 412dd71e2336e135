"""Trainings and studies killed at any moment: between two steps, before and after a file appears."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import pytest
from optuna.storages.journal import JournalFileBackend, JournalStorage
from stable_baselines3.common.save_util import load_from_zip_file

from zoo_configs.cli import main
from zoo_configs.experiments.config import resolve
from zoo_configs.training.options import TrainingOptions
from zoo_configs.training.runs import Run
from zoo_configs.training.state import State, run_status
from zoo_configs.training.train import train_experiment

# Registers a toy that counts its steps, and the files that appear, and kills its process at one of them.
DYING = f"""
import os, signal, sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
import gymnasium, toy_env

events, last, replace = 0, int(os.environ["DIES_AT"]), os.replace

def count():
    global events
    events += 1
    if events == last:
        os.kill(os.getpid(), signal.SIGKILL)

def replace_and_count(*args, **kwargs):
    count()
    replace(*args, **kwargs)
    count()

class Dying(toy_env.ToyEnv):
    def step(self, action):
        count()
        return super().step(action)

os.replace = replace_and_count
gymnasium.register(toy_env.TOY_ID, Dying)
"""
OVERRIDES = {
    **{"expert_episodes": 2, "pretrain_steps": 2, "batch_size": 4, "buffer_size": 100, "n_envs": 1},
    "env_kwargs": {"obs_size": 48},
}
OPTIONS = {
    "n_timesteps": 12,
    "eval_freq": 4,
    "eval_episodes": 1,
    "save_freq": 4,
    "verbose": 0,
    "num_threads": 1,
}
TUNE = [
    "tune",
    "--baseline",
    "sacfd",
    "--preset",
    "quick",
    "--env-kwargs",
    "obs_size:48",
    "--num-threads",
    "1",
]
TUNE += [
    "-n",
    "6",
    "--eval-episodes",
    "1",
    "--n-evaluations",
    "2",
    "--n-startup-trials",
    "1",
    "--n-trials",
    "2",
]
TINY = ["-params", "expert_episodes:2", "pretrain_steps:1", "batch_size:4", "buffer_size:100", "n_envs:1"]
# Moments of the default suite, drawn once; of about 45 events of a training and 60 of a study.
MOMENTS = np.random.default_rng(0)
TRAINING_EVENTS, STUDY_EVENTS = 45, 60


def train(toy_id: str, folder: Path, packages: tuple[str, ...] = ()) -> Run:
    experiment = resolve("sacfd", "quick", toy_id, OVERRIDES)
    options = TrainingOptions.of(experiment, OPTIONS)
    return train_experiment(
        experiment, 0, "cpu", folder, options=options, at=folder / "run", gym_packages=packages
    )


def run_dying(folder: Path, moment: int, code: str) -> int:
    """Run code in a process that kills itself at an event; returns how it ended."""
    (folder / "dying.py").write_text(DYING)
    paths = os.pathsep.join([str(folder), str(Path(__file__).parent), *sys.path])
    variables = {**os.environ, "DIES_AT": str(moment), "PYTHONPATH": paths}
    command = [sys.executable, "-c", code]
    return subprocess.run(
        command, cwd=folder, env=variables, stdout=subprocess.DEVNULL, check=False
    ).returncode


def policy(run: Run) -> dict[str, Any]:
    return dict(load_from_zip_file(run.last_model, device="cpu")[1]["policy"])


def check_killed_training(toy_id: str, folder: Path, moment: int) -> None:
    code = f"import dying, test_kills; test_kills.train({toy_id!r}, test_kills.Path({str(folder)!r}))"
    ended = run_dying(folder, moment, code)
    assert ended in (0, -9)
    how = run_status(folder / "run")
    assert how is None or how.state is (State.DONE if ended == 0 else State.KILLED) or how.state is State.DONE
    resumed, whole = train(toy_id, folder), train(toy_id, folder / "whole")
    left, right = policy(resumed), policy(whole)
    assert all(bool((left[key] == right[key]).all()) for key in left)
    with np.load(resumed.evaluations_file) as first, np.load(whole.evaluations_file) as second:
        assert all(np.array_equal(first[key], second[key]) for key in second)


def check_killed_study(toy_id: str, folder: Path, moment: int) -> None:
    (folder / "space.yml").write_text("learning_rate: {low: 0.0001, high: 0.01, log: true}")
    words = [*TUNE, "--env", toy_id, "-f", str(folder / "logs"), "--space", str(folder / "space.yml")]
    code = f"import dying; from zoo_configs.cli import main; main({[*words, *TINY]!r})"
    assert run_dying(folder, moment, code) in (0, -9)
    assert main([*words, *TINY]) == 0
    assert main([*words, "--study-name", "whole", *TINY]) == 0
    killed, whole = (counted(folder / "logs" / "studies" / name) for name in ("sacfd_CloseLoopToy", "whole"))
    assert killed == whole and len(whole) == 2


def counted(folder: Path) -> list[tuple[Any, Any, str]]:
    """The trials that count, of a study."""
    storage = JournalStorage(JournalFileBackend(str(folder / "journal.log")))
    trials = optuna.load_study(study_name=folder.name, storage=storage).trials
    again = {number for trial in trials for number in trial.user_attrs.get("repeats", ())}
    kept = [(trial.params, trial.value, trial.state.name) for trial in trials if trial.number not in again]
    return sorted(kept, key=str)


@pytest.mark.parametrize("moment", MOMENTS.integers(1, TRAINING_EVENTS, 2).tolist())
def test_a_killed_training_loses_nothing(moment: int, toy_id: str, tmp_path: Path) -> None:
    check_killed_training(toy_id, tmp_path, moment)


@pytest.mark.parametrize("moment", MOMENTS.integers(1, STUDY_EVENTS, 1).tolist())
def test_a_killed_study_loses_nothing(moment: int, toy_id: str, tmp_path: Path) -> None:
    check_killed_study(toy_id, tmp_path, moment)


@pytest.mark.slow
@pytest.mark.parametrize("moment", MOMENTS.integers(1, TRAINING_EVENTS, 25).tolist())
def test_a_killed_training_loses_nothing_at_many_moments(moment: int, toy_id: str, tmp_path: Path) -> None:
    check_killed_training(toy_id, tmp_path, moment)


@pytest.mark.slow
@pytest.mark.parametrize("moment", MOMENTS.integers(1, STUDY_EVENTS, 25).tolist())
def test_a_killed_study_loses_nothing_at_many_moments(moment: int, toy_id: str, tmp_path: Path) -> None:
    check_killed_study(toy_id, tmp_path, moment)
