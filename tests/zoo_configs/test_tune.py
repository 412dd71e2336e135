"""``bulletarm-zoo tune``: search spaces, trials, and what several processes make of a study."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import optuna
import pytest
import yaml
from optuna.storages.journal import JournalFileBackend, JournalStorage
from optuna.trial import FixedTrial, FrozenTrial

from zoo_configs.algorithms import algorithm_classes
from zoo_configs.cells.cell import resolve
from zoo_configs.cli import main
from zoo_configs.errors import CommandError
from zoo_configs.tuning import trial as trial_module
from zoo_configs.tuning.space import (
    Parameter,
    check_space,
    first_values,
    fit_space,
    load_space,
    moved,
    parse_space,
)
from zoo_configs.tuning.study import ERROR, retried

PICKING = "BulletArm/CloseLoopBlockPicking-v0"
SPACE = "learning_rate: {low: 1.0e-4, high: 1.0e-2, log: true}\nbatch_size: {choices: [4, 8]}\n"
NAME = "sacfd_CloseLoopToy"
CELL = ["--baseline", "sacfd", "--preset", "quick", "--env-kwargs", "obs_size:48"]
SIZE = ["-n", "6", "--eval-episodes", "1", "--n-evaluations", "2", "--n-startup-trials", "2"]
TINY = ["-params", "expert_episodes:2", "pretrain_steps:1", "batch_size:4", "buffer_size:100", "n_envs:1"]
Tune = Callable[..., int]
# Registers, in a process of its own, a toy that stops to move once there is a checkpoint.
HANGING = f"""
import sys, time
from pathlib import Path
sys.path.insert(0, {str(Path(__file__).parent)!r})
import gymnasium, toy_env

class Hanging(toy_env.ToyEnv):
    def step(self, action):
        while any(Path().glob("studies/*/*/checkpoints/*/model.zip")):
            time.sleep(1)
        return super().step(action)

gymnasium.register(toy_env.TOY_ID, Hanging)
"""


@pytest.fixture
def tune(toy_id: str, tmp_path: Path) -> Tune:
    """Searches two hyperparameters of a tiny cell: ``tune(*more)`` returns the exit code."""
    space = tmp_path / "space.yml"
    space.write_text(SPACE)

    def run(*more: str) -> int:
        named = ["tune", *CELL, "--env", toy_id, "-f", str(tmp_path), "--space", str(space)]
        return main([*named, *SIZE, "--num-threads", "1", *more, *TINY])

    return run


def trials(folder: Path, name: str = NAME) -> list[FrozenTrial]:
    storage = JournalStorage(JournalFileBackend(str(folder / "studies" / name / "journal.log")))
    return optuna.load_study(study_name=name, storage=storage).trials


def test_a_study_begins_with_the_baseline_and_ends_with_the_best(
    tune: Tune, toy_id: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert tune("--n-trials", "3") == 0
    printed = capsys.readouterr().out
    study = tmp_path / "studies" / NAME
    done = trials(tmp_path)
    assert done[0].params == {"learning_rate": 1e-3, "batch_size": "4"}  # lin_1e-3
    assert len(done) == 3 and all(0 <= trial.value <= 1 for trial in done if trial.value is not None)
    for picture in ("history", "importances", "parallel_coordinates"):
        assert (study / f"{picture}.png").stat().st_size > 5000
    best = yaml.safe_load((study / "best.yml").read_text())[toy_id]
    assert best["n_timesteps"] == 6 and best["learning_rate"].startswith("lin_")
    assert f"optuna-dashboard {study / 'journal.log'}" in printed
    command = ["train", "--algo", "sacfd", "--env", toy_id, "--conf-file", str(study / "best.yml")]
    assert main([*command, "-f", str(tmp_path / "logs"), "--no-progress", "--eval-freq", "0"]) == 0


def test_a_bar_counts_the_trials_of_the_study(
    tune: Tune, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also those of other processes, and of an earlier start; on terminals, unless flags say."""
    assert tune("--n-trials", "1") == 0
    assert "trial" not in capsys.readouterr().err
    assert tune("--n-trials", "2", "-P") == 0
    printed = capsys.readouterr()
    assert "1/2" in printed.err and "2/2" in printed.err and "0/2" not in printed.err
    assert "trial 1: " in printed.out
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    assert tune("--n-trials", "3", "--no-progress") == 0
    assert "trial" not in capsys.readouterr().err
    assert tune("--n-trials", "3") == 0
    assert "3/3" in capsys.readouterr().err


def test_a_study_of_a_seed_is_one_study(tune: Tune, tmp_path: Path) -> None:
    """Also where it is stopped on the way; and a study that has its trials does nothing."""
    assert tune("--study-name", "whole", "--n-trials", "4") == 0
    assert tune("--study-name", "parts", "--n-trials", "2") == 0
    assert tune("--study-name", "parts", "--n-trials", "4") == 0
    assert tune("--study-name", "parts", "--n-trials", "4") == 0
    whole, parts = trials(tmp_path, "whole"), trials(tmp_path, "parts")
    assert [trial.params for trial in whole] == [trial.params for trial in parts]
    assert [trial.value for trial in whole] == [trial.value for trial in parts]
    assert len({str(trial.params) for trial in whole}) == 4
    assert tune("--study-name", "other", "--n-trials", "2", "--seed", "1") == 0
    assert trials(tmp_path, "other")[1].params != whole[1].params


def test_a_worker_that_dies_leaves_its_trial_to_be_taken_up(tune: Tune, toy_id: str, tmp_path: Path) -> None:
    (tmp_path / "hanging.py").write_text(HANGING)
    words = ["tune", *CELL, "--env", f"hanging:{toy_id}", "-f", str(tmp_path), "--num-threads", "1"]
    words += ["--space", str(tmp_path / "space.yml"), *SIZE, "--n-trials", "2", *TINY]
    code = f"import sys; from zoo_configs.cli import main; sys.exit(main({words!r}))"
    with subprocess.Popen([sys.executable, "-c", code], cwd=tmp_path, stdout=subprocess.DEVNULL) as worker:
        while not list(tmp_path.glob("studies/*/trial_0000/checkpoints/*/model.zip")):
            assert worker.poll() is None
            time.sleep(0.1)
        assert tune("--n-trials", "1") == 0  # it is in work
        worker.kill()
    assert [trial.state.name for trial in trials(tmp_path)] == ["RUNNING"]
    assert tune("--n-trials", "2") == 0
    assert tune("--n-trials", "2", "--study-name", "whole") == 0
    killed, *resumed = sorted(trials(tmp_path), key=lambda trial: trial.state.name != "FAIL")
    whole = trials(tmp_path, "whole")
    assert killed.number == 0 and resumed[0].user_attrs["repeats"] == [0]
    assert [(trial.params, trial.value) for trial in resumed] == [(t.params, t.value) for t in whole]
    folders = {path.name for path in (tmp_path / "studies" / NAME).glob("trial_*") if path.is_dir()}
    assert folders == {"trial_0000", "trial_0002"}


def test_a_failed_trial_is_no_pruned_one(tune: Tune, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*args: Any) -> float:
        raise ValueError("a loss that is not a number")

    monkeypatch.setattr("zoo_configs.tuning.study.score", fail)
    assert tune("--n-trials", "2") == 0
    assert [trial.state.name for trial in trials(tmp_path)] == ["FAIL", "FAIL"]
    assert trials(tmp_path)[0].user_attrs[ERROR] == "a loss that is not a number"
    assert not (tmp_path / "studies" / NAME / "best.yml").exists()


def test_a_trial_that_falls_behind_is_pruned(
    tune: Tune, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(optuna.Trial, "should_prune", lambda trial: trial.number == 1)
    assert tune("--n-trials", "2") == 0
    assert [trial.state.name for trial in trials(tmp_path)] == ["COMPLETE", "PRUNED"]
    assert trials(tmp_path)[1].last_step == 0  # stopped at its first evaluation
    assert trial_module.PRUNED in trials(tmp_path)[1].user_attrs


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--seed", "5"], "exists with other seed"),
        (["-params", "gamma:0.5"], "exists with other hyperparams"),
        (["--eval-episodes", "3"], "exists with other options"),
        (["--storage", "magic://nowhere"], "--storage: magic://nowhere cannot be opened"),
        (["--space", "nowhere.yml"], "nowhere.yml"),
        (["--sampler", "tpee"], "invalid choice: 'tpee'"),
        (["--n-trials", "0"], "at least 1, got '0'"),
    ],
)
def test_what_does_not_fit_is_told(
    words: list[str], message: str, tune: Tune, capsys: pytest.CaptureFixture[str]
) -> None:
    assert tune("--n-trials", "1") == 0
    capsys.readouterr()
    assert tune(*words) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert message in line


def test_a_study_stays_in_its_folder(tune: Tune, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    database = f"sqlite:///{tmp_path / 'study.db'}"
    assert tune("--n-trials", "1", "--storage", database) == 0
    assert tune("--n-trials", "2", "--storage", database) == 0
    capsys.readouterr()
    assert tune("--n-trials", "2", "--storage", database, "-f", str(tmp_path / "elsewhere")) == 2
    assert "was begun in another folder" in capsys.readouterr().err


@pytest.mark.parametrize("begun", ["trial", "attribute", "direction"])
def test_a_study_of_another_program_is_refused_unchanged(
    begun: str, tune: Tune, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    database = f"sqlite:///{tmp_path / 'study.db'}"
    direction = "minimize" if begun == "direction" else "maximize"
    foreign = optuna.create_study(storage=database, study_name="mine", direction=direction)
    if begun == "trial":
        foreign.optimize(lambda trial: trial.suggest_float("x", 0.0, 1.0), n_trials=1)
    if begun == "attribute":
        foreign.set_user_attr("owner", "me")
    before = (foreign.trials, foreign.user_attrs)
    assert tune("--n-trials", "1", "--storage", database, "--study-name", "mine") == 2
    assert (
        "--study-name must be a new study or one of bulletarm-zoo tune, got mine" in capsys.readouterr().err
    )
    again = optuna.load_study(storage=database, study_name="mine")
    assert (again.trials, again.user_attrs) == before


@pytest.mark.parametrize(
    "algo", [name for name in algorithm_classes() if name not in ("ars", "dqn", "qrdqn")]
)
def test_every_algorithm_takes_what_its_space_moves(algo: str) -> None:
    """All that act in a box; but the recurrent one, whose policies have no heightmaps."""
    if algo == "ppo_lstm":
        with pytest.raises(CommandError, match="unknown search space 'ppo_lstm'"):
            load_space(algo)
        return
    space = load_space(algo)
    check_space(space, algorithm_classes()[algo])
    assert len({parameter.name for parameter in space}) == len(space) >= 4


@pytest.mark.parametrize("baseline", ["equi_sacfd", "ferm_sacfd", "tqcfd"])
def test_the_first_trial_is_the_baseline(baseline: str) -> None:
    cell = resolve(baseline, "cpu", PICKING)
    space = load_space(cell.algo)
    values = first_values(space, cell, algorithm_classes()[cell.algo])
    assert values.keys() >= {"learning_rate", "gamma", "batch_size", "tau", "bc_weight", "n_steps"}
    known = tuple(parameter for parameter in space if parameter.name in values)
    same = moved(cell, known, FixedTrial(values))  # type: ignore[arg-type]
    assert float(same.pop("learning_rate").removeprefix("lin_")) == 1e-3
    assert all(same[key] == value for key, value in cell.hyperparams.items() if key != "learning_rate")


def test_what_is_given_is_not_searched() -> None:
    given = {"pretrain_steps": 4, "n_steps": 2}
    cell = resolve("sacfd", "quick", PICKING, given)
    space = fit_space(load_space("sacfd"), cell, given, is_own=False)
    assert {"pretrain_steps", "n_steps"}.isdisjoint(parameter.name for parameter in space)
    first = first_values(space, cell, algorithm_classes()["sacfd"])
    assert first.keys() == {parameter.name for parameter in space}
    same = moved(cell, space, FixedTrial(first))  # type: ignore[arg-type]
    kept = same.keys() & cell.hyperparams.keys()
    assert {name for name in kept if same[name] != cell.hyperparams[name]} == {"learning_rate"}
    assert (same["learning_rate"], same["pretrain_steps"]) == ("lin_0.001", 4)
    everything = dict.fromkeys((parameter.name for parameter in space), 0.5) | given
    with pytest.raises(CommandError, match="nothing is left"):
        fit_space(load_space("sacfd"), cell, everything, is_own=False)


def test_a_space_of_ones_own_begins_with_what_is_given() -> None:
    space = parse_space("own", {"pretrain_steps": {"choices": [0, 4]}})
    cell = resolve("sacfd", "quick", PICKING, {"pretrain_steps": 4})
    assert fit_space(space, cell, {"pretrain_steps": 4}, is_own=True) == space
    with pytest.raises(CommandError, match="pretrain_steps is 3, which the search space"):
        fit_space(space, cell, {"pretrain_steps": 3}, is_own=True)


def test_choices_hold_the_baselines_value() -> None:
    stacking = resolve("sacfd", "quick", "BulletArm/CloseLoopBlockStacking-v0")
    space = fit_space(load_space("sacfd"), stacking, {}, is_own=False)
    steps = next(parameter for parameter in space if parameter.name == "pretrain_steps")
    assert steps.choices == (4000, 0, 500, 1000, 2000)
    assert "pretrain_steps" in first_values(space, stacking, algorithm_classes()["sacfd"])


def test_what_is_moved_keeps_the_rest() -> None:
    cell = resolve("equi_sacfd", "cpu", PICKING)
    space = (Parameter("policy_kwargs.net_arch.qf", choices=([32], [64, 64])), Parameter("tau", 0.001, 0.1))
    hyperparams = moved(cell, space, FixedTrial({"policy_kwargs.net_arch.qf": "[64, 64]", "tau": 0.02}))  # type: ignore[arg-type]
    assert hyperparams["policy_kwargs"]["net_arch"] == {"pi": [32], "qf": [64, 64]}
    assert hyperparams["policy_kwargs"]["features_extractor_kwargs"]["n"] == 4
    assert cell.hyperparams["tau"] == 0.01


@pytest.mark.parametrize(
    ("space", "message"),
    [
        ("[]", "takes a mapping of parameters"),
        ("{}", "takes a mapping of parameters"),
        ("{gamma: 0.9}", "gamma of mine takes low and high, or choices, got 0.9"),
        ("{gamma: {lo: 0.1, high: 1}}", "unknown key of gamma of mine 'lo'"),
        ("{gamma: {low: 1, high: 0}}", "gamma of mine takes numbers low < high"),
        ("{gamma: {low: 0, high: 1, log: true}}", "gamma of mine takes positive numbers low < high"),
        ("{gamma: {choices: [], low: 1}}", "choices takes a list and stands alone"),
    ],
)
def test_a_space_that_makes_no_sense_is_told(space: str, message: str) -> None:
    with pytest.raises(CommandError, match=message):
        parse_space("mine", yaml.safe_load(space))


def test_an_unknown_hyperparameter_is_told() -> None:
    with pytest.raises(CommandError, match="'bc_wight', did you mean 'bc_weight'"):
        check_space((Parameter("bc_wight", 0, 1),), algorithm_classes()["sacfd"])


def test_trials_that_were_taken_up_do_not_count() -> None:
    first, second = (optuna.trial.create_trial(state=optuna.trial.TrialState.FAIL) for _ in range(2))
    second.user_attrs = {"repeats": [0, 3]}
    assert retried([first, second]) == {0, 3}
