"""Trainings on a quick environment."""

import sys

import gymnasium as gym
import pytest
import sweeps
import yaml
from toy_env import TOY_ID, ToyEnv

from zoo_configs.cli import main

# A run of two seconds. Further parameters can follow, because a repeated flag replaces values.
TINY = (
    *("-n", "12", "--eval-freq", "6", "--eval-episodes", "2", "--save-freq", "6"),
    *("--seed", "0", "--device", "cpu", "--num-threads", "1", "--no-progress"),
    *("--env-kwargs", "obs_size:48"),
    *("-params", "expert_episodes:2", "pretrain_steps:2", "buffer_size:100", "-params", "batch_size:4"),
)


@pytest.fixture(scope="session")
def toy_id():
    """An id that the closed-loop baselines serve."""
    gym.register(TOY_ID, entry_point=ToyEnv)
    yield TOY_ID
    del gym.registry[TOY_ID]


@pytest.fixture
def toy_envs():
    """Environments made since the test began, in order."""
    ToyEnv.made.clear()
    return ToyEnv.made


@pytest.fixture(scope="session")
def train_tiny(toy_id):
    """Trains Equivariant SACfD for a few steps: ``train_tiny(folder, *more)`` returns the exit code."""

    def train(folder, *more):
        names = ["--baseline", "equi_sacfd", "--preset", "cpu", "--env", toy_id, "-f", str(folder)]
        return main(["train", *names, *TINY, *more])

    return train


@pytest.fixture(scope="session")
def trained(train_tiny, tmp_path_factory):
    """Log folder with one run, not to be changed."""
    folder = tmp_path_factory.mktemp("logs")
    assert train_tiny(folder, "n_envs:1", "--preset", "quick") == 0
    return folder


@pytest.fixture(scope="session")
def run_folder(trained):
    """That run, not to be changed."""
    return trained / "sacfd" / sweeps.RUN_NAME


@pytest.fixture
def refuse(toy_id, tmp_path, capsys, monkeypatch):
    """
    Runs a command line with a mistake in an empty folder, with ``TOY`` for the toy's id. Checks that the exit
    status is 2 and that nothing is left behind, and returns the one line of the error output.
    """

    def run(*words):
        monkeypatch.chdir(tmp_path)
        before = set(tmp_path.rglob("*"))
        capsys.readouterr()
        assert main([toy_id if word == "TOY" else word for word in words]) == 2
        printed = capsys.readouterr()
        [line] = printed.err.splitlines()
        assert len(printed.out.splitlines()) <= 3
        assert line.startswith(f"bulletarm-zoo {words[0]}: error: ")
        assert set(tmp_path.rglob("*")) == before
        return line

    return run


@pytest.fixture
def toys(toy_id):
    """Toys of ``--gym-packages toy_tasks`` are known during a test alone."""
    yield
    for env_id in list(gym.registry):
        if env_id.startswith("BulletArm/CloseLoopToy") and env_id != toy_id:
            del gym.registry[env_id]
    sys.modules.pop("toy_tasks", None)


@pytest.fixture
def bench(toys, tmp_path):
    """Runs a benchmark like TINY but for some keys: ``bench(*flags, key=value)`` returns the exit code."""

    def run(*flags, **keys):
        (tmp_path / "tiny.yml").write_text(yaml.safe_dump({**sweeps.TINY, **keys}))
        where = ["-f", str(tmp_path / "out"), *sweeps.FLAGS]
        return main(["benchmark", str(tmp_path / "tiny.yml"), *where, *flags])

    return run
