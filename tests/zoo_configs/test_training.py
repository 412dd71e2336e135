"""Training from Python and by the command line: run folder, logs, repeating, resuming, loading."""

import io
import os
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
import torch as th
import yaml
from stable_baselines3.common.callbacks import BaseCallback
from sweeps import TINY, same

from zoo_configs.algorithms import algorithm_classes
from zoo_configs.cli import main
from zoo_configs.drawing.curves import read_training_log
from zoo_configs.errors import CommandError
from zoo_configs.experiments.config import ExperimentConfig, resolve
from zoo_configs.files import write_yaml
from zoo_configs.training.options import TrainingOptions
from zoo_configs.training.runs import Run, claim_run_folder, load_run
from zoo_configs.training.state import State
from zoo_configs.training.train import TrainingInterrupted, train_experiment

GOLDEN = Path(__file__).with_name("golden_updates.yml")
"""Certificates of short trainings; the bits depend on processor and versions."""
RUN_NAME = "BulletArm-CloseLoopToy-v0_1"
SHORT = TINY["options"]
REACHING, STACKING = "BulletArm/CloseLoopBlockReaching-v0", "BulletArm/OpenLoopBlockStacking-v0"
TrainHere = Callable[..., Run]


class Stop(BaseCallback):
    """Ends a training by an error."""

    def __init__(self, at: int, error: BaseException) -> None:
        super().__init__()
        self.at, self.error = at, error

    def _on_step(self) -> bool:
        if self.num_timesteps == self.at:
            raise self.error
        return True


@pytest.fixture
def train(toy_id, tmp_path):
    """Trains the toy: ``train(*callbacks, at=..., seed=..., gamma=..., option=...)`` returns the run."""

    def run(*callbacks: BaseCallback, at: str | None = None, seed: int = 0, **changes: Any) -> Run:
        options = {name: changes.pop(name) for name in list(changes) if name in SHORT}
        experiment = resolve("sacfd", "quick", toy_id, {**TINY["hyperparams"], **changes})
        chosen = TrainingOptions.of(experiment, {**SHORT, **options})
        folder = None if at is None else tmp_path / at
        return train_experiment(
            experiment, seed, "cpu", tmp_path, options=chosen, at=folder, callbacks=callbacks
        )

    return run


def state(run: Run) -> State | None:
    return None if run.status is None else run.status.state


# ---- From Python


def test_trainings_in_a_process_are_independent_and_quiet(train, capsys):
    threads = th.get_num_threads()
    alone, other, again = train(), train(seed=1), train()
    assert same(alone.folder, again.folder) and not same(alone.folder, other.folder)
    assert {run.folder.name[-1] for run in (alone, other, again)} == {"1", "2", "3"}
    assert th.get_num_threads() == threads and capsys.readouterr().out == ""


def test_a_chosen_folder_continues_from_its_checkpoint(train):
    with pytest.raises(RuntimeError, match="pulled"):
        train(Stop(10, RuntimeError("the plug was pulled")), at="there")
    failed = load_run(train_folder := train(at="other").folder.parent / "there")
    assert failed.status is not None and failed.status.state is State.FAILED
    assert failed.status.error == "the plug was pulled"
    run = train(at="there")
    assert same(run.folder, train_folder.parent / "other")
    before = run.last_model.stat().st_mtime_ns
    assert train(Stop(1, RuntimeError("not reached")), at="there").last_model.stat().st_mtime_ns == before
    for changes in {"seed": 1}, {"gamma": 0.5}:
        with pytest.raises(CommandError, match="there"):
            train(at="there", **changes)


def test_work_before_the_first_checkpoint_is_not_counted_twice(train):
    with pytest.raises(RuntimeError, match="pulled"):
        train(Stop(8, RuntimeError("the plug was pulled")), at="there", save_freq=100)
    runs = [train(at=at, save_freq=100) for at in ("there", "here")]
    assert same(runs[0].folder, runs[1].folder)
    ours, theirs = (pd.read_csv(run.training_log) for run in runs)
    assert ours.equals(theirs)


def test_a_run_that_was_killed_at_its_very_end_is_done(train):
    """Model and last checkpoint exist, but the status does not say that it is done."""
    run, whole = train(at="a"), train(at="b")
    status = run.folder / "state.yml"
    status.write_text(status.read_text().replace("state: done", "state: running"))
    assert state(run) is State.KILLED
    run.last_model.write_bytes(b"of an earlier interruption")
    assert state(train(at="a")) is State.DONE and same(run.folder, whole.folder)


def test_a_run_that_fails_at_once_leaves_no_folder(train, tmp_path):
    with pytest.raises(RuntimeError):
        train(Stop(1, RuntimeError("early")), eval_freq=0, save_freq=0)
    assert not (tmp_path / "sacfd").exists()


def test_ctrl_c_counts_as_killed(train):
    with pytest.raises(TrainingInterrupted) as stop:
        train(Stop(8, KeyboardInterrupt()))
    assert state(stop.value.run) is State.KILLED and stop.value.run.last_model.is_file()


def test_run_folders_are_claimed_by_one_process(tmp_path, toy_id, monkeypatch):
    """Also if another process creates the folder between the listing and the claim."""
    assert claim_run_folder(tmp_path / "logs", toy_id).name == RUN_NAME
    monkeypatch.setattr(Path, "glob", lambda *_: iter(()))
    assert claim_run_folder(tmp_path / "logs", toy_id).name == f"{RUN_NAME[:-1]}2"


@pytest.mark.parametrize("algo", ["sacfd", "sac"])
def test_rl_zoo3_evaluates_our_runs(algo, toy_id, tmp_path, monkeypatch):
    enjoy, algos = pytest.importorskip("rl_zoo3.enjoy"), pytest.importorskip("rl_zoo3.utils").ALGOS
    monkeypatch.setitem(algos, algo, algorithm_classes()[algo])
    own: dict[str, Any] = {"policy": "MultiInputPolicy", "env_kwargs": {"obs_size": 48}, "expert_episodes": 2}
    stock = {"policy": "MlpPolicy", "env_kwargs": {"g": 9.0}, "normalize": True}
    common = {"n_timesteps": 12, "buffer_size": 200, "learning_starts": 4, "learning_rate": "lin_1e-3"}
    env_id, hyperparams = (toy_id, own) if algo == "sacfd" else ("Pendulum-v1", stock)
    experiment = ExperimentConfig(algo, env_id, {**hyperparams, **common})
    run = train_experiment(experiment, 0, "cpu", tmp_path, options=TrainingOptions(eval_freq=6, verbose=0))
    assert run.statistics_file.is_file() == (algo == "sac")
    words = ["--algo", algo, "--env", env_id, "-f", str(tmp_path), "-n", "20", "--no-render", "--load-best"]
    monkeypatch.setattr(sys, "argv", ["enjoy", *words, "--device", "cpu"])
    enjoy.enjoy()


# ---- Run folder of the command line


def test_a_run_folder_is_complete(run_folder, toy_id):
    names = {path.name for path in run_folder.iterdir()}
    models = {"BulletArm-CloseLoopToy-v0.zip", "best_model.zip", "checkpoints"}
    reports = {"hyperparams.yml", "evaluations.npz", "training.csv", "certificate.yml", "learning_curve.png"}
    assert names == {*models, *reports, "BulletArm-CloseLoopToy-v0", "state.yml", ".lock", "0.monitor.csv"}
    content = yaml.safe_load((run_folder / "hyperparams.yml").read_text())
    about = content["run"]
    assert (about["seed"], about["baseline"], about["preset"]) == (0, "equi_sacfd", "quick")
    assert about["versions"]["torch"] == th.__version__ and "cores" in about["machine"]
    assert content[toy_id]["policy"] == "EquivariantPolicy"
    assert content[toy_id]["env_kwargs"] == {"action_sequence": "pxyzr", "obs_size": 48}
    loaded = load_run(run_folder)
    assert (loaded.seed, loaded.experiment.hyperparams) == (0, content[toy_id])
    how = loaded.status
    assert how is not None and how.state is State.DONE and how.pid == os.getpid() and how.seconds > 0
    assert "is_success" in (run_folder / "0.monitor.csv").read_text().splitlines()[1]
    with np.load(run_folder / "evaluations.npz") as evaluations:
        assert evaluations["timesteps"].tolist() == [0, 6, 12]  # the first after pretraining
        assert evaluations["successes"].shape == (3, 2)
    log = read_training_log(run_folder / "training.csv")
    assert log["timesteps"].tolist() == [0, 6, 12]
    assert np.isfinite(log[["value_expert", "entropy_expert", "critic_loss", "bc_loss"]]).all(axis=None)
    for name in ("value_online", "entropy_online"):
        assert np.isfinite(log[name]).tolist() == [False, True, True]


def test_evaluation_has_the_parameters_but_not_the_scenes_of_training(train_tiny, tmp_path, toy_envs):
    assert train_tiny(tmp_path, "expert_episodes:0", "pretrain_steps:0", "--baseline", "sac") == 0
    _, *evaluation, training = sorted(toy_envs, key=lambda env: 0 in env.seeds)
    assert {env.obs_size for env in toy_envs} == {48}
    seeds = [seed for env in evaluation for seed in env.seeds if seed is not None]
    assert training.seeds[0] == 0
    assert len(set(seeds)) >= 2 and 0 not in seeds  # new scenes at each evaluation


TRAINING_BAR = "━"


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_progress_bars_are_shown_on_terminals(train_tiny, run_folder, tmp_path, monkeypatch, toy_id):
    words = ["train", "--baseline", "sacfd", "--preset", "cpu", "--env", toy_id, "-f", str(tmp_path / "b")]
    words += ["-n", "2", "--eval-freq", "0", "--device", "cpu", "--env-kwargs", "obs_size:48"]
    words += ["-params", "expert_episodes:2", "pretrain_steps:2", "batch_size:4", "buffer_size:100"]
    enjoy = ["enjoy", str(run_folder), "-n", "1", "--device", "cpu"]
    for file, shown in (Terminal(), True), (io.StringIO(), False):
        monkeypatch.setattr(sys, "stderr", file)
        assert main(words) == main(enjoy) == 0
        bars = ("expert episodes", "pretraining", TRAINING_BAR, "1/1")
        assert [bar in file.getvalue() for bar in bars] == [shown] * 4
    monkeypatch.setattr(sys, "stderr", silent := Terminal())
    assert train_tiny(tmp_path / "a") == main([*enjoy, "--no-progress"]) == 0
    assert silent.getvalue() == ""


RAD = ["augmentation:{rad: {size: 48}}", "contrastive_steps:2", "--env-kwargs", "obs_size:53"]


@pytest.mark.parametrize(
    ("baseline", "env_id", "more"),
    [
        ("equi_sacfd_per_aug", REACHING, ["buffer_size:400"]),
        ("equi_tqcfd", REACHING, []),
        ("sacfd_state", REACHING, []),
        ("ferm_sacfd", REACHING, RAD),
        ("dqn_cnn_asr", STACKING, []),
        ("adet_cnn_asr", STACKING, []),
        ("dqfd_equi_fcn", STACKING, ["--benchmark", "open_loop_2d"]),
        ("sdqfd_equi_deictic_asr", "BulletArm/OpenLoopRampBlockStacking-v0", []),
    ],
)
def test_a_baseline_trains(baseline, env_id, more, train_tiny, tmp_path):
    words = ["--baseline", baseline, "--env", env_id, "--eval-episodes", "1"]
    if "OpenLoop" in env_id:
        words += ["-n", "6", "--eval-freq", "3", "--save-freq", "3", "--env-kwargs", "num_objects:2"]
        words += ["obs_size:64", "-params", "expert_episodes:1", "n_envs:1"]
    assert train_tiny(tmp_path, *more, *words) == 0
    [run] = tmp_path.glob("*/BulletArm-*_1")
    assert main(["enjoy", str(run), "-n", "1", "--device", "cpu"]) == 0
    check_updates(baseline, run)


def test_the_default_baseline_has_the_recorded_updates(run_folder):
    check_updates("equi_sacfd", run_folder)


def check_updates(baseline, run):
    """
    Check that a training has the recorded bits, on a machine like that of the record. Then the results in the
    documentation are still valid.

    Record others with ``WRITE_GOLDEN_UPDATES=1``.
    """
    golden, found = yaml.safe_load(GOLDEN.read_text()), yaml.safe_load((run / "certificate.yml").read_text())
    if "WRITE_GOLDEN_UPDATES" in os.environ:
        write_yaml(GOLDEN, {**golden, baseline: found})
    elif {**found, "checksums": 0} == {**golden[baseline], "checksums": 0}:
        assert found["checksums"] == golden[baseline]["checksums"]


@pytest.mark.parametrize(
    ("algo", "env_id", "parameters"),
    [
        ("sac", "Pendulum-v1", ["g:9.0", "-params", "learning_starts:4"]),
        ("ppo", "TOY", ["obs_size:48", "-params", "n_steps:8", "batch_size:8"]),
        ("td3", "TOY", ["obs_size:48", "-params", "buffer_size:50", "learning_starts:4", "batch_size:4"]),
    ],
)
def test_a_stock_algorithm_trains(algo, env_id, parameters, toy_id, tmp_path):
    words = ["--algo", algo, "--env", env_id.replace("TOY", toy_id), "-f", str(tmp_path), "-n", "8"]
    options = ["--eval-freq", "-1", "--no-progress", "--device", "cpu", "--env-kwargs"]
    assert main(["train", *words, *options, *parameters]) == 0


def test_enjoy_finds_the_run_of_an_algorithm(toy_id, tmp_path, capsys):
    named = ["--algo", "tqc", "--env", toy_id, "-f", str(tmp_path), "--device", "cpu", "--no-progress"]
    size = ["-n", "2", "--eval-freq", "-1", "--preset", "cpu", "--env-kwargs", "obs_size:48", "--seed", "0"]
    params = ["expert_episodes:2", "pretrain_steps:0", "batch_size:4", "buffer_size:100", "n_envs:1"]
    assert main(["train", *named, *size, "-params", *params]) == 0
    assert "baseline tqc of --algo tqc" in capsys.readouterr().out
    assert list(tmp_path.glob("tqcfd/*_1"))
    assert main(["enjoy", *named, "-n", "1"]) == 0
    assert main(["enjoy", *named, "--algo", "ppo"]) == 2


# ---- Tasks of a user

MODULE, OWN_ID = "my_own_tasks", "BulletArm/CloseLoopOwnReaching-v0"
TASKS = """
    import bulletarm_gym
    from bulletarm_gym.tasks.picking import BlockReaching

    class OwnReaching(BlockReaching):
        pass

    def steps(scene, outcome):
        return -1.0

    bulletarm_gym.register_task("OwnReaching", OwnReaching)
"""


def forget() -> None:
    """Restore the state of a new process."""
    gym.registry.pop(OWN_ID, None)
    sys.modules.pop(MODULE, None)


@pytest.fixture
def own_tasks(tmp_path, monkeypatch):
    """The working directory, with a module of tasks in it."""
    (tmp_path / f"{MODULE}.py").write_text(textwrap.dedent(TASKS))
    monkeypatch.chdir(tmp_path)
    forget()
    yield tmp_path
    forget()
    sys.path.remove(str(tmp_path))


def test_a_run_stores_the_package_of_its_task(own_tasks, train_tiny, capsys):
    named = ["--env", f"{MODULE}:{OWN_ID}"]
    assert train_tiny(own_tasks / "logs", *named, "--baseline", "sacfd", "--eval-episodes", "1") == 0
    [run] = (own_tasks / "logs" / "sacfd").iterdir()
    assert yaml.safe_load((run / "hyperparams.yml").read_text())["run"]["gym_packages"] == [MODULE]
    acting = ["-n", "1", "--device", "cpu"]
    assert main(["push", str(run), "--folder", "agent", *acting]) == 0
    assert f"import {MODULE}" in (own_tasks / "agent" / "README.md").read_text()
    for command in (
        ["enjoy", "--published", "agent", *acting],
        ["enjoy", "--env", OWN_ID, "--baseline", "sacfd", *acting, "--n-envs", "2"],
        ["record", str(run), *acting, "-o", "video.gif"],
        ["train", "--resume", str(run), "-n", "20", "--no-progress"],
    ):
        forget()
        assert main(command) == 0, capsys.readouterr().err


def test_commands_import_tasks_and_rewards(own_tasks, capsys):
    words = ["demos", "--env", REACHING, "-n", "1", "--env-kwargs", "obs_size:32"]
    assert main(["list", "--env", OWN_ID, "--gym-packages", MODULE]) == 0
    assert main([*words, f"reward:{MODULE}:steps"]) == 0
    assert main([*words, f"reward:{MODULE}:stepz"]) == 2
    assert "stepz" in capsys.readouterr().err
    forget()
    (own_tasks / f"{MODULE}.py").write_text("def")
    assert main(["enjoy", "--gym-packages", MODULE]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert MODULE in line and "SyntaxError" in line
