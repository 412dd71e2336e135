"""Measured results: rows of runs, replaced when measured anew, and the table that shows them."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Callable
from pathlib import Path

import pytest

from zoo_configs.agents import Agent
from zoo_configs.cells.cell import resolve
from zoo_configs.cells.rules import task_name
from zoo_configs.cli import main
from zoo_configs.commands.results import _options
from zoo_configs.evaluating import Outcome
from zoo_configs.measuring.data_files import RESULTS, DataFile
from zoo_configs.pages.markers import Source
from zoo_configs.pages.results import results_table
from zoo_configs.publishing.published import published_agents
from zoo_configs.training.runs import load_run

Refuse = Callable[..., str]
DATA = Path(__file__).resolve().parents[2] / "docs" / "data" / "results.csv"
EMPTY = dict.fromkeys(RESULTS.columns, "")
ROW = {
    **EMPTY,
    **dict(env="CloseLoopToy", baseline="sacfd", preset="quick", seed="0", demonstrations="300", noise="0.1"),
    **dict(updates="500", steps="1500", best="1", last="0.95", minutes="3.4", commit="abc1234"),
}


def test_published_agents_are_in_the_table() -> None:
    rows = DataFile(DATA, RESULTS).read()
    measured = {tuple(row[name] for name in ("env", "baseline", "preset", "seed", "commit")) for row in rows}
    for _, card in published_agents():
        assert (task_name(card.env), card.baseline, card.preset, str(card.seed), card.commit) in measured


def test_a_run_gets_a_row(run_folder: Path, tmp_path: Path) -> None:
    data = DataFile(tmp_path / "results.csv", RESULTS)
    data.add(other := {**ROW, "env": "CloseLoopOther"})
    words = [str(run_folder), "--data", str(data.path), "-n", "2", "--device", "cpu", "--commit", "abc1234"]
    for _ in range(2):  # the second time it is replaced
        assert main(["results", *words]) == 0
        first, row = data.read()
    assert first == other
    assert [row[name] for name in ("env", "baseline", "preset", "seed")] == [
        *("CloseLoopToy", "equi_sacfd", "quick", "0")
    ]
    assert {row["best"], row["last"]} <= {"0", "0.5", "1"}
    assert row["least"] <= row["greatest"]
    numbers = ["2", "2", "12", "abc1234"]
    assert [row[name] for name in ("episodes", "updates", "steps", "commit")] == numbers
    assert "batch_size:4" in row["options"]


def test_runs_are_evaluated_in_as_many_environments_as_in_training(
    run_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, counts = load_run(run_folder), []

    def evaluate(agent: Agent, args: argparse.Namespace) -> Outcome:
        counts.append(args.n_envs)
        return Outcome([True], [1.0])

    monkeypatch.setattr("zoo_configs.publishing.packing.evaluate_agent", evaluate)
    data = tmp_path / "results.csv"
    for n_eval_envs in 1, 5:
        options = dataclasses.replace(run.options, n_eval_envs=n_eval_envs)
        changed = dataclasses.replace(run, options=options)
        monkeypatch.setattr("zoo_configs.training.runs.load_run", lambda _, run=changed: run)
        assert main(["results", str(run_folder), "--data", str(data), "--device", "cpu"]) == 0
    assert counts == [1, 1, 5, 5]


@pytest.mark.parametrize(
    ("benchmark", "shown"), [(None, ""), ("open_loop_3d", ""), ("open_loop_2d", "--benchmark open_loop_2d")]
)
def test_a_row_names_the_benchmark_that_is_not_the_first_of_its_task(
    benchmark: str | None, shown: str
) -> None:
    cell = resolve("sdqfd_equi_fcn", "cpu", "BulletArm/OpenLoopBlockStacking-v0", benchmark=benchmark)
    command = ["bulletarm-zoo", "train", "--benchmark", str(cell.benchmark), "-params", "gamma:0.9"]
    assert _options(cell, command) == f"{shown} -params gamma:0.9".strip()


def test_rows_become_cells(tmp_path: Path) -> None:
    data = DataFile(tmp_path / "results.csv", RESULTS)
    for row in ROW, {**ROW, "preset": "cpu"}, {**ROW, "env": "OpenLoopToy"}:
        data.add(row)
    table = results_table(Source(tmp_path, tmp_path / "page.md"), "quick", "CloseLoop*")
    _, _, line = table.splitlines()
    assert line == "| Toy | `sacfd` | 300 with noise, 500, 1,500 | 0 | 1.00 | 0.95 |  | 3 | abc1234 |"


def test_seeds_share_a_row(tmp_path: Path) -> None:
    data = DataFile(tmp_path / "results.csv", RESULTS)
    second = dict(seed="2", best="0.5", last="0.85", minutes="4.6", least="0.8", greatest="0.9")
    shorter = dict(seed="1", steps="9")
    for more in second, shorter, dict(least="0.75", greatest="1"):
        data.add({**ROW, **more})
    table = results_table(Source(tmp_path, tmp_path / "page.md"), "quick", "*")
    _, _, line, other = table.splitlines()
    assert "| 0, 2 | 0.75 (1.00, 0.50) | 0.90 (0.95, 0.85) |" in line
    assert line.endswith("| 0.75 to 1.00; 0.80 to 0.90 | 4 | abc1234 |")
    assert "300 with noise, 500, 9 | 1 | 1.00 | 0.95 |" in other


def test_what_was_measured_earlier_is_marked(tmp_path: Path) -> None:
    DataFile(tmp_path / "results.csv", RESULTS).add({**ROW, "earlier": "yes", "options": "gamma:0.9"})
    table = results_table(Source(tmp_path, tmp_path / "page.md"), "quick", "*")
    assert "| Toy (`gamma:0.9`) |" in table
    assert "| abc1234, earlier |" in table


def test_what_was_measured_earlier_stays_beside_the_same_training_of_now(tmp_path: Path) -> None:
    data = DataFile(tmp_path / "results.csv", RESULTS)
    for more in {"earlier": "yes", "commit": "0123456"}, {"best": "0.5"}, {"best": "0.75"}:
        data.add({**ROW, **more})
    _, _, now, before = results_table(Source(tmp_path, tmp_path / "page.md"), "quick", "*").splitlines()
    assert "| 0 | 1.00 | 0.95 |" in before and before.endswith("| 0123456, earlier |")
    assert "| 0 | 0.75 | 0.95 |" in now and now.endswith("| abc1234 |")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "the following arguments are required: RUN_FOLDER"),
        (["nowhere"], "nowhere is no run folder"),
        (["nowhere", "--data", "/dev/null/a.csv"], "cannot be written"),
        (["nowhere", "--data", str(DATA.with_name("speed.csv"))], "is no such file of measurements"),
    ],
)
def test_what_cannot_be_tabled(words: list[str], message: str, refuse: Refuse) -> None:
    assert message in refuse("results", *words)
