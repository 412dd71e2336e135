"""Trainings and studies killed at any moment: between two steps, before and after a file appears."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sweeps import PATH, TINY, TUNED, jobs_of, same, study_of

from zoo_configs.cli import main
from zoo_configs.training.state import State, run_status
from zoo_configs.training.train import train_run
from zoo_configs.tuning.study import counted

COUNTING = "CloseLoopToyCounting"
OPTIONS = {**TINY["options"], "eval_freq": 4, "eval_episodes": 1, "save_freq": 4, "num_threads": 1}
TUNE = ["tune", "--baseline", "sacfd", "--preset", "quick", *TUNED, "-n", "6", "--n-trials", "2"]
TUNE += ["--num-threads", "1", "--eval-episodes", "1", "--n-evaluations", "2", "--n-startup-trials", "1"]
TUNE += ["--env", f"toy_tasks:BulletArm/{COUNTING}-v0"]
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


@pytest.mark.parametrize("moment", moments(60, 26))
def test_a_killed_study_loses_nothing(moment, tmp_path):
    (tmp_path / "space.yml").write_text("learning_rate: {low: 0.0001, high: 0.01, log: true}")
    words = [*TUNE, "-f", str(tmp_path / "logs"), "--space", str(tmp_path / "space.yml")]
    run_dying(moment, f"from zoo_configs.cli import main; main({words!r})")
    assert main(words) == 0
    assert main([*words, "--study-name", "whole"]) == 0
    studies = [study_of(tmp_path / "logs", name) for name in (f"sacfd_{COUNTING}", "whole")]
    killed, whole = ({str((t.params, t.value, t.state)) for t in counted(study)} for study in studies)
    assert killed == whole and len(whole) == 2
