"""Experiments, tables and pages of ``plot``."""

from __future__ import annotations

import csv
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from zoo_configs.cli import main
from zoo_configs.commands.train import build_parser, find_experiment
from zoo_configs.drawing.curves import load_curve, mean_curve
from zoo_configs.experiments.config import resolve
from zoo_configs.results import (
    EXPLANATION,
    baseline_rows,
    experiment_row,
    interquartile_mean,
    read_experiments,
)
from zoo_configs.training.options import TrainingOptions, given_options
from zoo_configs.training.origin import repeating_command
from zoo_configs.training.runs import Run, find_runs, write_resolved
from zoo_configs.training.state import State, run_lock, run_status, set_status

PICKING, REACHING = "BulletArm/CloseLoopBlockPicking-v0", "BulletArm/CloseLoopBlockReaching-v0"
OVERRIDES = {
    "expert_episodes": 7,
    "replay_buffer_kwargs": {"expert_fraction": 0.4},
    "env_kwargs": {"obs_size": 48},
}
GOOD = [[False] * 4, [True, True, False, True], [True, True, True, False]]


def add_run(
    folder: Path, env_id: str, baseline: str, seed: int, successes: list[list[bool]], **changes: Any
) -> Run:
    """A run that was evaluated every 10 time steps; it gets the next free folder."""
    options = {"n_timesteps": 30, "eval_freq": 10, "num_threads": 1, **changes.pop("options", {})}
    experiment = resolve(baseline, changes.pop("preset", "cpu"), env_id, {**OVERRIDES, **changes})
    task = env_id.partition("/")[2].partition("-")[0]
    place = folder / f"{task}_{len(list(folder.glob('*')))}" / baseline / f"seed_{seed}"
    run = Run(place, experiment, seed, "cpu", TrainingOptions.of(experiment, options))
    write_resolved(run)
    with run_lock(run.folder):
        steps = np.arange(1, len(successes) + 1) * 10
        np.savez(run.evaluations_file, timesteps=steps, results=successes, successes=successes)
    return run


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two tasks, two baselines, two seeds."""
    for env_id in (PICKING, REACHING):
        for seed in range(2):
            good = [[False] * 4, [True, True, False, seed == 0], [True, True, True, seed == 0]]
            add_run(tmp_path, env_id, "equi_sacfd", seed, good)
            add_run(tmp_path, env_id, "sacfd", seed, [[False] * 4, [True] + [False] * 3])
    return tmp_path


def labels(folder: Path) -> list[str]:
    return [experiment.label for experiment in read_experiments(folder)]


@pytest.mark.parametrize(
    ("changes", "label"),
    [
        ({"learning_rate": 0.002}, "learning_rate=0.002"),
        ({"env_kwargs": {"obs_size": 48, "robot": "panda"}}, "robot=panda"),
        ({"env_kwargs": {"obs_size": 48, "max_steps": 9}}, "max_steps=9"),
        ({"preset": "quick"}, "preset=quick"),
        ({"options": {"n_timesteps": 20}}, "n_timesteps=20"),
    ],
    ids=str,
)
def test_different_experiments_have_curves_of_their_own(
    changes: dict[str, Any], label: str, tmp_path: Path
) -> None:
    add_run(tmp_path, REACHING, "sacfd", 0, GOOD)
    add_run(tmp_path, REACHING, "sacfd", 1, GOOD, **changes)
    found = labels(tmp_path)
    assert len(found) == 2 and sum(label in one for one in found) == 1
    assert all(one.startswith("sacfd, ") for one in found)


def test_evaluations_and_threads_do_not_make_an_experiment(tmp_path: Path) -> None:
    add_run(tmp_path, REACHING, "sacfd", 0, GOOD)
    add_run(tmp_path, REACHING, "sacfd", 1, GOOD, options={"eval_episodes": 3, "num_threads": 2})
    [experiment] = read_experiments(tmp_path)
    assert experiment.label == "sacfd" and list(experiment.success) == [0, 1]


def test_an_equal_run_counts_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    longer = add_run(tmp_path, REACHING, "sacfd", 0, GOOD)
    shorter = add_run(tmp_path, REACHING, "sacfd", 0, GOOD[:2])
    [experiment] = read_experiments(tmp_path)
    assert [result.run.folder for result in experiment.results.values()] == [longer.folder]
    assert str(shorter.folder) in capsys.readouterr().err


def test_an_unfinished_run_shortens_no_curve(folder: Path) -> None:
    add_run(folder, PICKING, "equi_sacfd", 2, [[True] * 4])
    runs = [run for run in find_runs(folder, PICKING) if run.experiment.label == "equi_sacfd"]
    mean = mean_curve([load_curve(run.evaluations_file) for run in runs])
    assert mean.timesteps.tolist() == [10, 20, 30]
    assert mean.runs.tolist() == [3, 2, 2]
    assert mean.success == pytest.approx([1 / 3, 0.625, 0.875])
    assert mean.error == pytest.approx([1 / 3, 0.125, 0.125])


def test_tables_show_every_seed(folder: Path) -> None:
    experiments = read_experiments(folder)
    row = ["CloseLoopBlockPicking", "equi_sacfd", "0.88", "0: 1.00, 1: 0.75", "2 of 2", "30"]
    assert experiment_row(experiments[0])[:6] == row
    assert baseline_rows(experiments)[0] == ["equi_sacfd", "0.88", "0: 1.00, 1: 0.75", "0.88", "2", "4"]
    assert "instead of a confidence interval" in EXPLANATION


def test_the_interquartile_mean_omits_a_quarter_at_each_end() -> None:
    assert interquartile_mean([0.0, 1.0, 0.4, 0.6]) == pytest.approx(0.5)
    assert interquartile_mean([0.0, 1.0, 0.5]) == pytest.approx(0.5)
    assert interquartile_mean([0.3]) == pytest.approx(0.3)


def test_the_command_of_a_run_repeats_it(folder: Path) -> None:
    run = next(run for run in find_runs(folder) if run.seed == 1)
    words = shlex.split(repeating_command(run))
    assert words[:2] == ["bulletarm-zoo", "train"]
    args = build_parser().parse_args(words[2:])
    again = find_experiment(args, args.env)
    assert again.hyperparams == run.experiment.hyperparams and args.seed == 1 and args.device == "cpu"
    assert TrainingOptions.of(again, given_options(args)) == run.options


def test_plot_writes_figure_and_tables(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plot", "-f", str(folder)]) == 0
    out = capsys.readouterr().out
    assert "interquartile mean" in out
    written = [folder / f"learning_curves.{suffix}" for suffix in ("png", "md", "csv")]
    assert [line.strip() for line in out.splitlines()[-3:]] == [str(path) for path in written]
    assert written[0].read_bytes().startswith(b"\x89PNG")
    page = written[1].read_text()
    assert "](learning_curves.png)" in page and "torch" in page
    assert page.count("    bulletarm-zoo train --env") == 4
    with written[2].open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 8 and {row["done"] for row in rows} == {"yes"}
    assert [row["success"] for row in rows[:2]] == ["1.0", "0.75"]


def test_plot_selects_environments_and_baselines(
    folder: Path, capsys: pytest.CaptureFixture[str], refuse: Callable[..., str]
) -> None:
    assert main(["plot", "-f", str(folder), "--env", PICKING, "--baseline", "sacfd"]) == 0
    out = capsys.readouterr().out
    assert "equi_sacfd" not in out and "BlockReaching" not in out
    refuse("plot", "-f", str(folder), "--baseline", "sac")


def test_a_failed_run_is_not_done(tmp_path: Path) -> None:
    run = add_run(tmp_path, REACHING, "sacfd", 0, GOOD)
    (run.folder / "state.yml").unlink()
    set_status(run.folder, State.FAILED, "the block is lost")
    assert run_status(run.folder).state is State.FAILED  # type: ignore[union-attr]
    [experiment] = read_experiments(tmp_path)
    assert experiment_row(experiment)[4] == "0 of 1"


def test_returns_are_plotted_too(tmp_path: Path) -> None:
    run = add_run(tmp_path, REACHING, "sacfd", 0, GOOD)
    np.savez(run.evaluations_file, timesteps=[10], results=[[3.0, 5.0]])
    [experiment] = read_experiments(tmp_path)
    assert experiment_row(experiment)[2:4] == ["4.00", "0: 4.00"]
    assert experiment.results[0].curve.measure == "evaluation return"
