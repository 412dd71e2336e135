"""Trainings and studies killed at any moment: between two steps, before and after a file appears."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sweeps import HERE, PATH, TINY, same, trials_of

from zoo_configs.cli import main
from zoo_configs.experiments.config import resolve
from zoo_configs.training.options import TrainingOptions
from zoo_configs.training.runs import Run
from zoo_configs.training.state import State, run_status
from zoo_configs.training.train import train_experiment

# Registers a toy that counts its steps, and the files that appear, and kills its process at one of them.
DYING = f"""
import os, signal, sys
sys.path.insert(0, {str(HERE)!r})
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
OPTIONS = {**TINY["options"], "eval_freq": 4, "eval_episodes": 1, "save_freq": 4, "num_threads": 1}
TUNE = ["tune", "--baseline", "sacfd", "--preset", "quick", "--env-kwargs", "obs_size:48", "-n", "6"]
TUNE += ["--num-threads", "1", "--eval-episodes", "1", "--n-evaluations", "2", "--n-startup-trials", "1"]
TUNE += ["--n-trials", "2", "-params", "expert_episodes:2", "pretrain_steps:2", "batch_size:4"]
TUNE += ["buffer_size:100", "n_envs:1"]
# Moments of about 45 events of a training and 60 of a study. The default suite has the first ones.
MOMENTS = np.random.default_rng(0)
SLOW = pytest.mark.slow
OF_TRAINING = [
    pytest.param(int(m), marks=[SLOW] * (n > 1)) for n, m in enumerate(MOMENTS.integers(1, 45, 27))
]
OF_STUDY = [pytest.param(int(m), marks=[SLOW] * (n > 0)) for n, m in enumerate(MOMENTS.integers(1, 60, 26))]


def train(toy_id: str, folder: Path) -> Run:
    experiment = resolve("sacfd", "quick", toy_id, TINY["hyperparams"])
    options = TrainingOptions.of(experiment, OPTIONS)
    return train_experiment(experiment, 0, "cpu", folder, options=options, at=folder / "run")


def run_dying(folder: Path, moment: int, code: str) -> int:
    """Run code in a process that kills itself at an event, and return its exit code."""
    (folder / "dying.py").write_text(DYING)
    paths = os.pathsep.join([str(folder), PATH])
    variables = {**os.environ, "DIES_AT": str(moment), "PYTHONPATH": paths}
    command = [sys.executable, "-c", f"import dying; {code}"]
    done = subprocess.run(command, cwd=folder, env=variables, stdout=subprocess.DEVNULL, check=False)
    return done.returncode


@pytest.mark.parametrize("moment", OF_TRAINING)
def test_a_killed_training_loses_nothing(moment, toy_id, tmp_path):
    code = f"import test_kills; test_kills.train({toy_id!r}, test_kills.Path({str(tmp_path)!r}))"
    assert run_dying(tmp_path, moment, code) in (0, -9)
    assert run_status(tmp_path / "run").state in (State.WAITING, State.DONE, State.KILLED)
    assert same(train(toy_id, tmp_path).folder, train(toy_id, tmp_path / "whole").folder)


def counted(folder: Path, study: str) -> list[tuple[Any, Any, str]]:
    """The trials of a study that count."""
    trials = trials_of(folder, study)
    again = {number for trial in trials for number in trial.user_attrs.get("repeats", ())}
    kept = [(trial.params, trial.value, trial.state.name) for trial in trials if trial.number not in again]
    return sorted(kept, key=str)


@pytest.mark.parametrize("moment", OF_STUDY)
def test_a_killed_study_loses_nothing(moment, toy_id, tmp_path):
    (tmp_path / "space.yml").write_text("learning_rate: {low: 0.0001, high: 0.01, log: true}")
    words = [*TUNE, "--env", toy_id, "-f", str(tmp_path / "logs"), "--space", str(tmp_path / "space.yml")]
    assert run_dying(tmp_path, moment, f"from zoo_configs.cli import main; main({words!r})") in (0, -9)
    assert main(words) == 0
    assert main([*words, "--study-name", "whole"]) == 0
    killed, whole = (counted(tmp_path / "logs", name) for name in ("sacfd_CloseLoopToy", "whole"))
    assert killed == whole and len(whole) == 2
