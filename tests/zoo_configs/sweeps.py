"""What the tests share: all experiments, a tiny benchmark, and how its runs are compared."""

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import optuna
import pandas as pd
import yaml
from optuna.storages.journal import JournalFileBackend, JournalStorage
from stable_baselines3.common.save_util import load_from_zip_file

from zoo_configs.benchmarking.plan import build_jobs, parse_plan
from zoo_configs.environments import our_env_ids, register_environments
from zoo_configs.experiments.families import families
from zoo_configs.training.state import State, run_status

register_environments()
ALL = [
    (baseline, preset, env_id)
    for env_id in our_env_ids()
    for family in families()
    if family.has_env(env_id)
    for baseline in family.baselines
    for preset in family.presets
    if family.has_experiment(baseline, env_id)
]
"""Baseline, preset and environment id of each experiment."""
RUN_NAME = "BulletArm-CloseLoopToy-v0_1"
HERE = Path(__file__).parent
ROOT = HERE.parent.parent
# Where processes find the toys as a package of a user's.
PATH = os.pathsep.join([str(ROOT), str(HERE), os.environ.get("PYTHONPATH", "")])
TINY = {
    "tasks": ["CloseLoopToy"],
    "baselines": ["sacfd"],
    "preset": "quick",
    "seeds": 2,
    "options": {"n_timesteps": 12, "eval_freq": 6, "eval_episodes": 2, "save_freq": 6, "verbose": 0},
    "hyperparams": {
        **{"expert_episodes": 2, "pretrain_steps": 2, "batch_size": 4, "buffer_size": 100, "n_envs": 1},
        "env_kwargs": {"obs_size": 48},
    },
}
# The same as flags, after others of the same name.
TUNED = (
    *("--env-kwargs", "obs_size:48", "-params", "expert_episodes:2", "pretrain_steps:2", "batch_size:4"),
    *("buffer_size:100", "n_envs:1"),
)
FLAGS = ("--gym-packages", "toy_tasks", "--device", "cpu", "--no-progress")


def jobs_of(folder, **keys):
    return build_jobs(parse_plan("tiny.yml", {**TINY, **keys}), folder, ["toy_tasks"], "cpu")


def weights(folder):
    [model] = folder.glob("BulletArm-*.zip")
    return dict(load_from_zip_file(model, device="cpu")[1]["policy"])


def episodes(folder):
    """Return and length of each episode, by environment."""
    return [pd.read_csv(path, comment="#")[["r", "l"]] for path in sorted(folder.glob("*.monitor.csv"))]


def same(left, right):
    ours, theirs = weights(left), weights(right)
    with np.load(left / "evaluations.npz") as first, np.load(right / "evaluations.npz") as second:
        evaluated = all(np.array_equal(first[key], second[key]) for key in first)
    monitored = all(map(pd.DataFrame.equals, episodes(left), episodes(right)))
    return evaluated and monitored and all(bool((ours[key] == theirs[key]).all()) for key in ours)


def study_of(folder, name):
    storage = JournalStorage(JournalFileBackend(str(folder / "studies" / name / "journal.log")))
    return optuna.load_study(study_name=name, storage=storage)


def wait_for(condition, seconds=120):
    last = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < last, "it does not happen"
        time.sleep(0.05)


def start(folder, plan, *flags):
    """The command line in a process of its own."""
    (folder / "tiny.yml").write_text(yaml.safe_dump(plan))
    words = [sys.executable, "-m", "zoo_configs.cli", "benchmark", str(folder / "tiny.yml")]
    return subprocess.Popen(
        [*words, "-f", str(folder / "out"), *FLAGS, *flags],
        env={**os.environ, "PYTHONPATH": PATH},
        stderr=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
    )


def is_running(folder):
    return run_status(folder).state is State.RUNNING
