"""``train_experiment``: what a notebook, a study and a benchmark call."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NoReturn

import numpy as np
import pandas as pd
import pytest
import torch as th
import yaml
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.save_util import load_from_zip_file

from zoo_configs.algorithms import algorithm_classes
from zoo_configs.errors import CommandError
from zoo_configs.experiments.config import ExperimentConfig, resolve
from zoo_configs.training.options import TrainingOptions, add_options
from zoo_configs.training.runs import Run, load_run
from zoo_configs.training.state import LOCK_FILE, State, run_lock, run_status
from zoo_configs.training.train import train_experiment

TINY = {"expert_episodes": 2, "pretrain_steps": 2, "batch_size": 4, "buffer_size": 100, "n_envs": 1}
SHORT = {"n_timesteps": 12, "eval_freq": 6, "eval_episodes": 2, "save_freq": 6, "verbose": 0}


@pytest.fixture
def experiment(toy_id: str) -> ExperimentConfig:
    return resolve("sacfd", "quick", toy_id, {**TINY, "env_kwargs": {"obs_size": 48}})


@pytest.fixture
def options(experiment: ExperimentConfig) -> TrainingOptions:
    return TrainingOptions.of(experiment, SHORT)


def weights(run: Run) -> dict[str, th.Tensor]:
    return dict(load_from_zip_file(run.last_model, device="cpu")[1]["policy"])


def same(first: Run, second: Run) -> bool:
    left, right = weights(first), weights(second)
    return all(bool((left[key] == right[key]).all()) for key in left)


class Stop(BaseCallback):
    """Ends the training by an error."""

    def __init__(self, at: int, error: BaseException) -> None:
        super().__init__()
        self.at, self.error = at, error

    def _on_step(self) -> bool:
        if self.num_timesteps == self.at:
            raise self.error
        return True


def test_a_quiet_training_prints_nothing(
    experiment: ExperimentConfig, options: TrainingOptions, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    train_experiment(experiment, 0, "cpu", tmp_path, options=options)
    assert capsys.readouterr().out == ""


def test_two_trainings_in_a_process_do_not_disturb_each_other(
    experiment: ExperimentConfig, options: TrainingOptions, tmp_path: Path
) -> None:
    threads = th.get_num_threads()
    alone = train_experiment(experiment, 0, "cpu", tmp_path, options=options)
    other = train_experiment(experiment, 1, "cpu", tmp_path, options=options)
    again = train_experiment(experiment, 0, "cpu", tmp_path, options=options)
    assert same(alone, again) and not same(alone, other)
    assert {run.folder.name[-1] for run in (alone, other, again)} == {"1", "2", "3"}
    assert th.get_num_threads() == threads


def test_a_run_says_all_about_itself(
    experiment: ExperimentConfig, options: TrainingOptions, tmp_path: Path
) -> None:
    run = train_experiment(experiment, 3, "cpu", tmp_path, options=options, at=tmp_path / "here")
    about = yaml.safe_load(run.resolved_file.read_text())["run"]
    assert (about["seed"], about["baseline"], about["preset"]) == (3, "sacfd", "quick")
    assert about["versions"]["torch"] == th.__version__
    assert about["options"]["n_timesteps"] == 12
    assert "cores" in about["machine"]
    loaded = load_run(run.folder)
    assert (loaded.seed, loaded.options, loaded.experiment.hyperparams) == (
        3,
        options,
        experiment.hyperparams,
    )
    how = loaded.status
    assert how is not None and how.state is State.DONE and how.pid == os.getpid() and how.seconds > 0


def test_a_chosen_folder_goes_on_from_its_checkpoint(
    experiment: ExperimentConfig, options: TrainingOptions, tmp_path: Path
) -> None:
    there = tmp_path / "there"

    def train(*callbacks: BaseCallback) -> Run:
        return train_experiment(
            experiment, 0, "cpu", tmp_path, options=options, at=there, callbacks=callbacks
        )

    with pytest.raises(RuntimeError, match="pulled"):
        train(Stop(10, RuntimeError("the plug was pulled")))
    how = run_status(there)
    assert how is not None and how.state is State.FAILED and how.error == "the plug was pulled"
    run = train()
    assert same(run, train_experiment(experiment, 0, "cpu", tmp_path, options=options))
    before = run.last_model.stat().st_mtime_ns
    assert train(Stop(1, RuntimeError("not reached"))).last_model.stat().st_mtime_ns == before


def test_what_was_done_before_the_first_checkpoint_is_not_counted_twice(
    experiment: ExperimentConfig, tmp_path: Path
) -> None:
    options = TrainingOptions.of(experiment, {**SHORT, "save_freq": 100})
    there = tmp_path / "there"
    with pytest.raises(RuntimeError, match="pulled"):
        plug = Stop(8, RuntimeError("the plug was pulled"))
        train_experiment(experiment, 0, "cpu", tmp_path, options=options, at=there, callbacks=[plug])
    runs = [
        train_experiment(experiment, 0, "cpu", tmp_path, options=options, at=tmp_path / at)
        for at in ("there", "here")
    ]
    assert same(*runs)
    ours, theirs = (np.load(run.evaluations_file) for run in runs)
    assert all(np.array_equal(ours[key], theirs[key]) for key in theirs)
    ours, theirs = (pd.read_csv(run.training_log) for run in runs)
    assert ours.equals(theirs)


def test_a_run_that_was_killed_at_its_very_end_is_done(
    experiment: ExperimentConfig, options: TrainingOptions, tmp_path: Path
) -> None:
    """Its model and its last checkpoint are there, but the folder does not say that it is done."""
    run = train_experiment(experiment, 0, "cpu", tmp_path, options=options, at=tmp_path / "a")
    before, state = weights(run), run.folder / "state.yml"
    state.write_text(state.read_text().replace("state: done", "state: running"))
    assert run.status is not None and run.status.state is State.KILLED
    run.last_model.write_bytes(b"of an earlier interruption")
    again = train_experiment(experiment, 0, "cpu", tmp_path, options=options, at=tmp_path / "a")
    assert again.status is not None and again.status.state is State.DONE
    assert all(bool((weights(again)[key] == before[key]).all()) for key in before)


def test_a_chosen_folder_is_of_one_run(
    experiment: ExperimentConfig, options: TrainingOptions, tmp_path: Path
) -> None:
    train_experiment(experiment, 0, "cpu", tmp_path, options=options, at=tmp_path / "a")
    with pytest.raises(CommandError, match="seed 0, not 1"):
        train_experiment(experiment, 1, "cpu", tmp_path, options=options, at=tmp_path / "a")
    experiment.hyperparams["gamma"] = 0.5
    with pytest.raises(CommandError, match="hyperparams"):
        train_experiment(experiment, 0, "cpu", tmp_path, options=options, at=tmp_path / "a")


def test_what_fails_at_once_leaves_no_folder(experiment: ExperimentConfig, tmp_path: Path) -> None:
    options = TrainingOptions.of(experiment, {**SHORT, "eval_freq": 0, "save_freq": 0})
    with pytest.raises(RuntimeError):
        train_experiment(
            experiment, 0, "cpu", tmp_path, options=options, callbacks=[Stop(1, RuntimeError("early"))]
        )
    assert not (tmp_path / "sacfd").exists()


def test_options_that_do_not_exist_are_told(experiment: ExperimentConfig) -> None:
    with pytest.raises(CommandError, match="'eval_frq', did you mean 'eval_freq'"):
        TrainingOptions.of(experiment, {"eval_frq": 3})
    with pytest.raises(CommandError, match=r"--eval-episodes: .*got '0'"):
        TrainingOptions.of(experiment, {"eval_episodes": 0})


def test_rl_zoo3_has_the_same_flags(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compared with the parser inside its main function."""
    train = pytest.importorskip("rl_zoo3.train")
    found: list[argparse.ArgumentParser] = []

    class Theirs(argparse.ArgumentParser):
        def parse_args(self, *args: Any, **kwargs: Any) -> NoReturn:
            found.append(self)
            raise StopIteration

    monkeypatch.setattr(train, "argparse", SimpleNamespace(ArgumentParser=Theirs))
    with pytest.raises(StopIteration):
        train.train()
    theirs = {flag: action for action in found[0]._actions for flag in action.option_strings}
    parser, defaults = argparse.ArgumentParser(), TrainingOptions().plain()
    add_options(parser)
    for action in parser._actions[1:]:
        assert all(theirs[flag].dest == action.dest for flag in action.option_strings)
        assert defaults[action.dest] == (theirs[action.option_strings[0]].default or defaults[action.dest])


@pytest.mark.parametrize("algo", ["sacfd", "sac"])
def test_rl_zoo3_evaluates_our_runs(
    algo: str, toy_id: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    enjoy, algos = pytest.importorskip("rl_zoo3.enjoy"), pytest.importorskip("rl_zoo3.utils").ALGOS
    monkeypatch.setitem(algos, algo, algorithm_classes()[algo])
    own: dict[str, Any] = {"policy": "MultiInputPolicy", "env_kwargs": {"obs_size": 48}, "expert_episodes": 2}
    stock = {"policy": "MlpPolicy", "env_kwargs": {"g": 9.0}, "normalize": True}
    common = {"n_timesteps": 12, "buffer_size": 200, "learning_starts": 4, "learning_rate": "lin_1e-3"}
    env_id, hyperparams = (toy_id, own) if algo == "sacfd" else ("Pendulum-v1", stock)
    experiment, options = (
        ExperimentConfig(algo, env_id, {**hyperparams, **common}),
        TrainingOptions(eval_freq=6, verbose=0),
    )
    run = train_experiment(experiment, 0, "cpu", tmp_path, options=options)
    assert run.statistics_file.is_file() == (algo == "sac")
    words = ["--algo", algo, "--env", env_id, "-f", str(tmp_path), "-n", "20", "--no-render", "--load-best"]
    monkeypatch.setattr(sys, "argv", ["enjoy", *words, "--device", "cpu"])
    enjoy.enjoy()


def test_who_trains_a_run_keeps_others_out(tmp_path: Path) -> None:
    with run_lock(tmp_path):
        how = run_status(tmp_path)
        assert how is not None and how.state is State.RUNNING
        with pytest.raises(CommandError, match="is being trained by another process"), run_lock(tmp_path):
            pass
    assert run_status(tmp_path).state is State.DONE  # type: ignore[union-attr]


def test_ctrl_c_during_a_save_counts_as_killed(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), run_lock(tmp_path):
        try:
            raise KeyboardInterrupt
        finally:
            raise RuntimeError("unexpected pos 64 vs 0")  # as from torch.save
    how = run_status(tmp_path)
    assert how is not None and how.state is State.KILLED


def test_who_is_killed_leaves_a_killed_run(tmp_path: Path) -> None:
    code = f"""
import os, signal
from pathlib import Path
from zoo_configs.training.state import run_lock
with run_lock(Path({str(tmp_path)!r})):
    os.kill(os.getpid(), signal.SIGKILL)
"""
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == -9
    assert (tmp_path / LOCK_FILE).is_file()
    how = run_status(tmp_path)
    assert how is not None and how.state is State.KILLED
    (tmp_path / "state.yml").write_text("state: dancing")
    with pytest.raises(CommandError, match="cannot be read"):
        run_status(tmp_path)


@pytest.mark.parametrize("killed", [True, False])
def test_the_time_of_who_was_killed_counts_up_to_the_checkpoint(killed: bool, tmp_path: Path) -> None:
    with run_lock(tmp_path):
        (checkpoint := tmp_path / "checkpoint").mkdir()
    how = run_status(tmp_path)
    assert how is not None and how.until == how.since + how.seconds
    if killed:
        how = how._replace(state=State.RUNNING, until=0.0, seconds=5.0)
        os.utime(checkpoint, (how.since + 100.0, how.since + 100.0))
        (tmp_path / "state.yml").write_text(yaml.safe_dump({**how._asdict(), "state": how.state.value}))
    with run_lock(tmp_path, checkpoint):
        again = run_status(tmp_path)
    assert again is not None
    assert again.seconds == pytest.approx(105.0 if killed else how.seconds)


def test_ctrl_c_counts_as_killed(
    experiment: ExperimentConfig, options: TrainingOptions, tmp_path: Path
) -> None:
    with pytest.raises(KeyboardInterrupt) as stop:
        train_experiment(
            experiment, 0, "cpu", tmp_path, options=options, callbacks=[Stop(8, KeyboardInterrupt())]
        )
    run = stop.value.run  # type: ignore[attr-defined]
    how = run_status(run.folder)
    assert how is not None and how.state is State.KILLED
    assert run.last_model.is_file() and np.any([weights(run)])
