"""``bulletarm-zoo tune``: search spaces, trials, and studies of several processes."""

import re
import shlex

import optuna
import pytest
import yaml
from optuna.trial import FixedTrial
from sweeps import ALL, TUNED, study_of

from zoo_configs.algorithms import algorithm_classes
from zoo_configs.cli import main
from zoo_configs.errors import CommandError
from zoo_configs.experiments.config import ExperimentConfig, merge, resolve
from zoo_configs.files import parse_yaml
from zoo_configs.training.state import lock
from zoo_configs.tuning.space import (
    BASELINE,
    Parameter,
    baseline_value,
    first_values,
    load_space,
    sample_params,
)
from zoo_configs.tuning.study import ERROR

PICKING = "BulletArm/CloseLoopBlockPicking-v0"
SPACE = "learning_rate: {low: 1.0e-4, high: 1.0e-2, log: true}\nbatch_size: {choices: [4, 8]}\n"
NAME = "sacfd_CloseLoopToy"
SIZE = ["-n", "6", "--eval-episodes", "1", "--n-evaluations", "2", "--n-startup-trials", "2"]


@pytest.fixture
def tune(toy_id, tmp_path):
    """Searches two hyperparameters of a tiny experiment: ``tune(*more)`` returns the exit code."""
    (space := tmp_path / "space.yml").write_text(SPACE)

    def run(*more):
        named = ["tune", "--baseline", "sacfd", "--preset", "quick", "--env", toy_id, "-f", str(tmp_path)]
        return main([*named, "--space", str(space), *SIZE, "--num-threads", "1", *more, *TUNED])

    return run


def states(folder):
    return [trial.state.name for trial in study_of(folder, NAME).trials]


def test_a_study_begins_with_the_baseline_and_repeats_itself(tune, toy_id, tmp_path, capsys):
    assert tune("--n-trials", "1") == 0
    assert "trial" not in capsys.readouterr().err
    assert tune("--n-trials", "3", "-P", "--gym-packages", "json") == 0
    done, printed = study_of(tmp_path, NAME).trials, capsys.readouterr()
    folder = tmp_path / "studies" / NAME
    assert done[0].params == {"learning_rate": 0.001, "batch_size": "4"}
    assert len(done) == 3 and all(0 <= trial.value <= 1 for trial in done if trial.value is not None)
    for plot in ("history", "importances", "parallel_coordinates"):
        assert (folder / f"{plot}.png").stat().st_size > 5000
    assert "1/3" in printed.err and "3/3" in printed.err and "0/3" not in printed.err
    assert "trial 1: " in printed.out and f"optuna-dashboard {folder / 'journal.log'}" in printed.out
    best = yaml.safe_load((folder / "best.yml").read_text())[toy_id]
    assert best["n_timesteps"] == 6 and best["learning_rate"].startswith("lin_")
    [(_, command)] = re.findall("(To train .*): bulletarm-zoo (.*)", printed.out)
    assert str(folder / "best.yml") in command and "--gym-packages json" in command
    arguments = ["-f", str(tmp_path / "logs"), "--no-progress", "--eval-freq", "0"]
    assert main([*shlex.split(command), *arguments]) == 0
    assert tune("--study-name", "whole", "--n-trials", "3") == 0
    assert tune("--study-name", "other", "--n-trials", "2", "--seed", "1") == 0
    found = [
        [(t.params, t.value) for t in study_of(tmp_path, name).trials] for name in (NAME, "whole", "other")
    ]
    assert found[0] == found[1] and len({str(params) for params, _ in found[0]}) == 3
    assert found[2][1] != found[0][1]


def test_only_a_trial_of_a_dead_process_is_repeated(tune, tmp_path):
    assert tune("--n-trials", "1") == 0
    trial = study_of(tmp_path, NAME).ask()
    with (tmp_path / "studies" / NAME / f"trial_{trial.number:04d}.lock").open("a") as claim:
        assert lock(claim)  # as a process that trains it
        assert tune("--n-trials", "2") == 0
        assert states(tmp_path) == ["COMPLETE", "RUNNING"]
    assert tune("--n-trials", "2") == 0
    assert states(tmp_path) == ["COMPLETE", "FAIL", "COMPLETE"]
    assert study_of(tmp_path, NAME).trials[2].user_attrs["repeats"] == [1]
    folders = {path.name for path in (tmp_path / "studies" / NAME).glob("trial_*") if path.is_dir()}
    assert folders == {"trial_0000", "trial_0001"}


@pytest.mark.parametrize("killed_after", [None, "add_trial"])
def test_a_baseline_whose_process_dies_at_once_is_repeated_once(killed_after, tune, tmp_path, monkeypatch):
    """Also if the process that repeats it dies before the first trial has failed."""
    assert tune("--n-trials", "1") == 0
    study = study_of(tmp_path, NAME)
    values = study.trials[0].params
    study.enqueue_trial(values, {BASELINE: True})
    study.ask()
    if killed_after:
        monkeypatch.setattr(optuna.Study, "tell", interrupt)
        assert tune("--n-trials", "2") == 130
        monkeypatch.undo()
    assert tune("--n-trials", "2") == 0
    assert states(tmp_path) == ["COMPLETE", "FAIL", "COMPLETE"]
    assert study_of(tmp_path, NAME).trials[2].params == values


def interrupt(*args, **kwargs):
    raise KeyboardInterrupt


def test_a_study_without_a_complete_trial_fails(tune, tmp_path, capsys):
    (tmp_path / "space.yml").write_text("policy_kwargs.n_critics: {choices: [x, y]}")
    assert tune("--n-trials", "2", "--pruner", "none", "--save-freq", "0") == 0  # the baseline
    assert not list(tmp_path.glob("studies/*/trial_0000/checkpoints"))
    assert states(tmp_path) == ["COMPLETE", "FAIL"]
    assert "as an integer" in study_of(tmp_path, NAME).trials[1].user_attrs[ERROR]
    assert tune("--n-trials", "1", "--study-name", "all", "-params", "policy_kwargs:{n_critics: x}") == 2
    assert "as an integer" in capsys.readouterr().err


def test_a_trial_that_falls_behind_is_pruned(tune, tmp_path, monkeypatch):
    """At its first evaluation. Also a parameter without a value in the baseline is searched."""
    content = "tau: {low: 0.1, high: 0.2}\npolicy_kwargs.n_critics: {low: 1, high: 9}"
    (tmp_path / "space.yml").write_text(content)
    monkeypatch.setattr(optuna.Trial, "should_prune", lambda trial: trial.number == 1)
    assert tune("--n-trials", "2") == 0
    assert states(tmp_path) == ["COMPLETE", "PRUNED"]
    first, second = study_of(tmp_path, NAME).trials
    assert first.params == {"tau": 0.01} and second.last_step == 0
    assert second.params.keys() == {"tau", "policy_kwargs.n_critics"} and second.params["tau"] != 0.01


def test_another_study_is_refused(tune, tmp_path, capsys):
    database = ["--storage", storage := f"sqlite:///{tmp_path / 'study.db'}"]
    assert tune("--n-trials", "1", *database) == 0
    capsys.readouterr()
    optuna.create_study(storage=storage, study_name="minimized", direction="minimize")
    owned = optuna.create_study(storage=storage, study_name="owned", direction="maximize")
    owned.set_user_attr("owner", "another program")
    for words, text in (
        ([*database, "--seed", "5"], "seed"),
        ([*database, "--eval-episodes", "3"], "options"),
        ([*database, "-f", str(tmp_path / "elsewhere")], "folder"),
        (["--storage", "magic://nowhere"], "magic://nowhere"),
        ([], "--storage"),
        *(([*database, "--study-name", name], "--study-name") for name in ("minimized", "owned")),
    ):
        assert tune(*words) == 2
        [line] = capsys.readouterr().err.splitlines()
        assert text in line


def test_an_algorithm_has_the_hyperparameters_of_its_space():
    for algo in algorithm_classes().keys() - {"ars", "dqn", "qrdqn", "ppo_lstm"}:
        space = load_space(ExperimentConfig(algo, "Pendulum-v1", {}), {})
        assert len({parameter.name for parameter in space}) == len(space) >= 4, algo


def test_the_first_trial_of_every_experiment_is_the_baseline():
    """The space contains its values, and nothing that it does not use."""
    for names in ALL:
        experiment = resolve(*names)
        space = load_space(experiment, {})
        first = first_values(space, experiment)
        assert first.keys() == {parameter.name for parameter in space}, names
        trial = FixedTrial(first)
        trial.set_user_attr(BASELINE, True)
        assert sample_params(experiment, space, trial) == {}
        imitates = experiment.hyperparams.get("bc_weight", 0) != 0
        assert imitates == ("bc_weight" in first), names


def test_sampled_values_replace_those_of_the_baseline():
    """Others of the same mapping stay, and a schedule stays a schedule."""
    experiment = resolve("equi_sacfd", "cpu", PICKING)
    space = load_space(experiment, {})
    values = first_values(space, experiment)
    space = (*space, Parameter("policy_kwargs.net_arch.qf", choices=([32], [64, 64])))
    trial = FixedTrial({**values, "policy_kwargs.net_arch.qf": "[64, 64]"})
    sampled = sample_params(experiment, space, trial)
    policy_kwargs = merge(experiment.hyperparams, sampled)["policy_kwargs"]
    assert policy_kwargs["net_arch"] == {"pi": [32], "qf": [64, 64]}
    assert policy_kwargs["features_extractor_kwargs"]["n"] == 4
    assert sampled.pop("learning_rate") == "lin_0.001" and sampled.pop("policy_kwargs")
    assert all(value == baseline_value(name, experiment) for name, value in sampled.items())


def test_values_of_the_command_line_are_not_searched():
    given = {"pretrain_steps": 4, "n_steps": 2}
    experiment = resolve("sacfd", "quick", PICKING, given)
    space = load_space(experiment, given)
    assert {"pretrain_steps", "n_steps"}.isdisjoint(parameter.name for parameter in space)
    with pytest.raises(CommandError, match="search space"):
        load_space(experiment, dict.fromkeys((parameter.name for parameter in space), 0.5) | given)


@pytest.mark.parametrize(
    ("space", "value", "stored"),
    [
        ("{pretrain_steps: {choices: [0, 4]}}", 3, ("3", (3, 0, 4))),
        ("{bc_weight: {choices: [10.0, 30.0]}}", 30, ("30.0", (10.0, 30.0))),
        ("{learning_rate: {choices: [1e-4, 1e-3]}}", 0.001, ("0.001", (1e-4, 1e-3))),
        ("{tau: {low: 1e-2, high: 1e-1}}", 0.005, (0.005, ())),
    ],
)
def test_a_space_is_extended_by_the_value_of_the_command_line(space, value, stored, tmp_path):
    [name] = parse_yaml(space)
    (file := tmp_path / "space.yml").write_text(space)
    experiment = resolve("sacfd", "quick", PICKING, {name: value})
    [parameter] = load_space(experiment, {name: value}, file)
    assert (parameter.optuna_value(value), parameter.choices) == stored
    assert first_values((parameter,), experiment) == {name: stored[0]}


def test_choices_may_be_lists(tmp_path):
    (file := tmp_path / "space.yml").write_text("policy_kwargs.net_arch.qf: {choices: [[8], [16, 16]]}")
    [parameter] = load_space(resolve("sacfd", "quick", PICKING), {}, file)
    assert parameter.choices[-2:] == ([8], [16, 16])


def test_whole_number_bounds_mean_whole_numbers_except_for_floats(tmp_path):
    names = ("batch_size", "n_envs", "learning_rate", "bc_weight")
    (file := tmp_path / "space.yml").write_text(yaml.safe_dump({key: {"low": 1, "high": 9} for key in names}))
    space = load_space(resolve("sacfd", "quick", PICKING, {"bc_weight": 3}), {}, file)
    trial = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0)).ask()
    whole = {parameter.name: isinstance(parameter.suggest(trial), int) for parameter in space}
    assert whole == {"batch_size": True, "n_envs": True, "learning_rate": False, "bc_weight": False}


@pytest.mark.parametrize(
    ("space", "named"),
    [
        ("n_timesteps: {low: 6, high: 20}", "n_timesteps"),
        ("seed: {low: 1, high: 20}", "seed"),
        ("tau: {low: 0.1, high: 0.2, log: no}", "log"),
        ("tau: {low: 0.1, high: .inf}", "low < high"),
        ("tau: {low: 0.1, high: 0.2, needs: 5}", "needs"),
        ("tau: {low: 0.1, high: 0.2}\ntau: {low: 0.3, high: 0.4}", "once, got tau"),
        ("gamma: {low: 0.5, high: 2.0}", "gamma must be"),
        ("gamma: {choices: [0.5, .nan]}", "gamma must be"),
        ("policy_kwargs.nonsense: {low: 1, high: 2}", "nonsense"),
        ("batch_size: {low: 4.0, high: 8.0}", "batch_size must be"),
        *((space, "space.yml") for space in ("[]", "{}", "gamma: 0.9", "gamma: {choices: [], low: 1}")),
        ("tau: {lo: 0.1, high: 1}", "lo"),
        ("tau: {low: 1, high: 0}", "low < high"),
        ("tau: {low: 0, high: 1, log: true}", "log"),
    ],
)
def test_a_space_with_values_that_cannot_be_trained_is_refused(space, named, tmp_path):
    (file := tmp_path / "space.yml").write_text(space)
    with pytest.raises(CommandError, match=named):
        load_space(resolve("sacfd", "quick", PICKING), {}, file)


def test_values_of_a_space_are_checked_together(tmp_path):
    """A type of noise needs a standard deviation, but none of these values does alone."""
    noise = {"noise_type": {"choices": [None, "normal"]}, "noise_std": {"low": 0.1, "high": 0.2}}
    (file := tmp_path / "space.yml").write_text(yaml.safe_dump(noise))
    experiment = ExperimentConfig("td3", "Pendulum-v1", {"n_timesteps": 9, "policy": "MlpPolicy"})
    assert len(load_space(experiment, {}, file)) == 2
