"""Trainings and studies killed at any moment: between two steps, before and after a file appears."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sweeps import PATH, TINY, jobs_of, same, trials_of

from zoo_configs.cli import main
from zoo_configs.training.state import State, run_status
from zoo_configs.training.train import train_run

COUNTING = "CloseLoopToyCounting"
OPTIONS = {**TINY["options"], "eval_freq": 4, "eval_episodes": 1, "save_freq": 4, "num_threads": 1}
TUNE = ["tune", "--baseline", "sacfd", "--preset", "quick", "--env-kwargs", "obs_size:48", "-n", "6"]
TUNE += ["--num-threads", "1", "--eval-episodes", "1", "--n-evaluations", "2", "--n-startup-trials", "1"]
TUNE += ["--n-trials", "2", "-params", "expert_episodes:2", "pretrain_steps:2", "batch_size:4"]
TUNE += ["buffer_size:100", "n_envs:1", "--env", f"toy_tasks:BulletArm/{COUNTING}-v0"]
pytestmark = pytest.mark.usefixtures("toys")


def moments(highest, count):
    """Numbers of events; the default run has the first one alone."""
    numbers = np.random.default_rng(0).integers(1, highest, count).tolist()
    return [numbers[0], *(pytest.param(number, marks=pytest.mark.slow) for number in numbers[1:])]


def train(folder):
    [job] = jobs_of(Path(), tasks=[COUNTING], seeds=1, options=OPTIONS)
    return train_run(replace(job, folder=Path(folder)))


def run_dying(moment, code):
    """Run code in a process that kills itself at an event."""
    variables = {**os.environ, "DIES_AT": str(moment), "PYTHONPATH": PATH}
    done = subprocess.run([sys.executable, "-c", code], env=variables, capture_output=True, check=False)
    assert done.returncode in (0, -9), done.stderr


@pytest.mark.parametrize("moment", moments(45, 27))
def test_a_killed_training_loses_nothing(moment, tmp_path):
    run_dying(moment, f"import test_kills; test_kills.train({str(tmp_path / 'run')!r})")
    assert run_status(tmp_path / "run").state in (State.WAITING, State.DONE, State.KILLED)
    assert same(train(tmp_path / "run").folder, train(tmp_path / "whole").folder)


def counted(folder, study):
    """The trials of a study that count."""
    trials = trials_of(folder, study)
    again = {number for trial in trials for number in trial.user_attrs.get("repeats", ())}
    kept = [(trial.params, trial.value, trial.state.name) for trial in trials if trial.number not in again]
    return sorted(kept, key=str)


@pytest.mark.parametrize("moment", moments(60, 26))
def test_a_killed_study_loses_nothing(moment, tmp_path):
    (tmp_path / "space.yml").write_text("learning_rate: {low: 0.0001, high: 0.01, log: true}")
    words = [*TUNE, "-f", str(tmp_path / "logs"), "--space", str(tmp_path / "space.yml")]
    run_dying(moment, f"from zoo_configs.cli import main; main({words!r})")
    assert main(words) == 0
    assert main([*words, "--study-name", "whole"]) == 0
    killed, whole = (counted(tmp_path / "logs", name) for name in (f"sacfd_{COUNTING}", "whole"))
    assert killed == whole and len(whole) == 2
