"""What ``plot`` and ``report`` make of a benchmark's runs."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from zoo_configs.benchmarking.evaluated import EvaluatedRun
from zoo_configs.benchmarking.results import (
    baseline_table,
    bootstrap_interval,
    cell_table,
    run_table,
)
from zoo_configs.benchmarking.tables import markdown
from zoo_configs.cells.cell import resolve
from zoo_configs.cli import main
from zoo_configs.commands.train import build_parser, find_cell
from zoo_configs.drawing.curves import mean_curve
from zoo_configs.training.options import TrainingOptions, given_options
from zoo_configs.training.repeating import repeating_command
from zoo_configs.training.runs import Run, find_runs, write_resolved
from zoo_configs.training.state import State, held, note

PICKING, REACHING = "BulletArm/CloseLoopBlockPicking-v0", "BulletArm/CloseLoopBlockReaching-v0"
OVERRIDES = {
    "expert_episodes": 7,
    "replay_buffer_kwargs": {"expert_fraction": 0.4},
    "env_kwargs": {"obs_size": 48},
}


def add_run(folder: Path, env_id: str, baseline: str, seed: int, successes: list[list[bool]]) -> Run:
    """A run that was evaluated every 10 time steps."""
    cell = resolve(baseline, "cpu", env_id, OVERRIDES)
    task = env_id.partition("/")[2].partition("-")[0]
    options = TrainingOptions.of(cell, {"n_timesteps": 30, "eval_freq": 10, "num_threads": 1})
    run = Run(folder / task / baseline / f"seed_{seed}", cell, seed, "cpu", options)
    write_resolved(run)
    with held(run.folder):
        steps = np.arange(1, len(successes) + 1) * 10
        np.savez(run.evaluations_file, timesteps=steps, results=successes, successes=successes)
    return run


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two tasks, two baselines, two seeds; one run has not come to its end."""
    for env_id in (PICKING, REACHING):
        for seed in range(2):
            good = [[False] * 4, [True, True, False, seed == 0], [True, True, True, seed == 0]]
            add_run(tmp_path, env_id, "equi_sacfd", seed, good)
            add_run(tmp_path, env_id, "sacfd", seed, [[False] * 4, [True] + [False] * 3])
    return tmp_path


def test_a_run_that_is_not_finished_shortens_no_curve(folder: Path) -> None:
    from zoo_configs.drawing.curves import load_curve

    short = add_run(folder, PICKING, "equi_sacfd", 2, [[True] * 4])
    runs = [run for run in find_runs(folder, PICKING) if run.cell.label == "equi_sacfd"]
    assert short.folder in [run.folder for run in runs]
    mean = mean_curve([load_curve(run.evaluations_file) for run in runs])
    assert mean.timesteps.tolist() == [10, 20, 30]
    assert mean.runs.tolist() == [3, 2, 2]
    assert mean.success == pytest.approx([1 / 3, 0.625, 0.875])
    assert mean.error == pytest.approx([1 / 3, 0.125, 0.125])


def test_cells_have_wilsons_interval_over_all_episodes(folder: Path) -> None:
    cells = cell_table(run_table(map(EvaluatedRun.of, find_runs(folder)))).set_index(["task", "baseline"])
    cell = cells.loc[(PICKING, "equi_sacfd")]
    assert (cell["success"], cell["seeds"], cell["done"], cell["episodes"]) == (0.875, "0 1", 2, 8)
    assert cell["error"] == pytest.approx(0.125)
    share, z = 7 / 8, stats.norm.ppf(0.975)
    middle, half = share + z**2 / 16, z * np.sqrt(share * (1 - share) / 8 + z**2 / 256)
    assert (cell["low"], cell["high"]) == pytest.approx(
        ((middle - half) / (1 + z**2 / 8), (middle + half) / (1 + z**2 / 8))
    )


def test_baselines_have_an_interquartile_mean_with_a_bootstrapped_interval() -> None:
    rng = np.random.default_rng(0)
    rows = [
        {"task": task, "baseline": "a", "success": float(value)}
        for task in "xyz"
        for value in rng.uniform(0, 1, 4)
    ]
    [row] = baseline_table(pd.DataFrame(rows)).to_dict("records")
    values = np.sort([run["success"] for run in rows])
    assert row["iqm"] == pytest.approx(values[3:9].mean())
    assert 0 < row["low"] < row["iqm"] < row["high"] < 1
    assert (row["tasks"], row["runs"]) == (3, 12)
    # Between tasks that are all sure there is nothing to draw; with one seed a task, runs are drawn of all
    assert bootstrap_interval([np.array([0.0, 0.0]), np.array([1.0, 1.0])]) == pytest.approx((0.5, 0.5))
    low, high = bootstrap_interval([np.array([value]) for value in values])
    assert low < row["iqm"] < high
    assert np.isnan(bootstrap_interval([np.array([1.0])])).all()


def test_the_command_of_a_cell_repeats_it(folder: Path) -> None:
    run = next(run for run in find_runs(folder) if run.seed == 1)
    words = shlex.split(repeating_command(run))
    assert words[:2] == ["bulletarm-zoo", "train"]
    args = build_parser().parse_args(words[2:])
    again = find_cell(args, args.env)
    assert again.hyperparams == run.cell.hyperparams and args.seed == 1 and args.device == "cpu"
    assert TrainingOptions.of(again, given_options(args)) == run.options


def test_plot_writes_picture_and_tables(folder: Path, capsys: Any) -> None:
    assert main(["plot", "-f", str(folder)]) == 0
    out = capsys.readouterr().out
    assert "interquartile mean" in out
    written = [folder / f"learning_curves.{suffix}" for suffix in ("png", "md", "csv")]
    assert [line.strip() for line in out.splitlines()[-3:]] == [str(path) for path in written]
    table = pd.read_csv(written[2])
    assert list(table["baseline"]) == ["equi_sacfd", "sacfd"] * 2 and (table["done"] == 2).all()
    page = written[1].read_text()
    assert "| CloseLoopBlockPicking | equi_sacfd | 0.88 | 0.12 | 0.53 to 0.98 | 0 1 | 2 of 2 | 30 |" in page
    assert page.count("    bulletarm-zoo train --env") == 4


def test_curves_kept_in_a_file_are_drawn_without_their_runs(folder: Path, tmp_path: Path) -> None:
    data, picture = tmp_path / "kept" / "curves.csv", tmp_path / "kept" / "curves.png"
    data.parent.mkdir()
    table = picture.with_suffix(".csv").with_stem("tables")
    for found in (["-f", str(folder / "CloseLoopBlockPicking")], ["-f", str(folder)], []):
        assert main(["plot", *found, "--data", str(data), "-o", str(table.with_suffix(".png"))]) == 0
    drawn = pd.read_csv(table)
    assert main(["plot", "-f", str(folder), "-o", str(picture.with_stem("folder"))]) == 0
    pd.testing.assert_frame_equal(drawn, pd.read_csv(picture.with_name("folder.csv")))
    assert table.with_suffix(".png").read_bytes() == picture.with_stem("folder").read_bytes()
    rows = pd.read_csv(data)
    assert len(rows) == 8 and rows["evaluations"][0] == "10:0 20:0.75 30:1"
    assert rows["command"].str.startswith("bulletarm-zoo train --env").all()


def test_a_file_of_curves_keeps_what_a_run_measured(folder: Path) -> None:
    run = EvaluatedRun.of(find_runs(folder)[0])
    again = EvaluatedRun.of_record(run.record())
    assert again.record() == run.record()
    assert again.curve.error == pytest.approx(run.curve.error)
    returns = EvaluatedRun.of_record({**run.record(), "measure": "evaluation return"})
    assert np.isnan(returns.curve.error).all()


def test_files_of_curves_that_cannot_be_drawn(
    folder: Path, tmp_path: Path, refuse: Callable[..., str]
) -> None:
    data = tmp_path / "curves.csv"
    assert "no run of these" in refuse("plot", "--data", str(data))
    assert main(["plot", "-f", str(folder), "--data", str(data)]) == 0
    assert "no run of these" in refuse("plot", "--data", str(data), "--baseline", "sac")
    assert "--training draws" in refuse("plot", "--data", str(data), "--training")
    data.write_text(data.read_text().replace("10:0 20", "10:0:20"))
    assert f"{data} is damaged" in refuse("plot", "--data", str(data))
    data.write_text("env\n")
    assert "no such file of measurements" in refuse("plot", "--data", str(data))


def test_a_report_puts_all_on_one_page(folder: Path, capsys: Any) -> None:
    note(folder / "CloseLoopBlockPicking/sac/seed_0", State.FAILED, "the block is lost")
    about = "name: small\ncommand: bulletarm-zoo benchmark small.yml\nruns:\n"
    runs = [run.folder.relative_to(folder) for run in find_runs(folder)]
    names = [*map(str, runs), "CloseLoopBlockPicking/sac/seed_0", "CloseLoopBlockPicking/sac/seed_1"]
    (folder / "benchmark.yml").write_text(about + "".join(f"- {name}\n" for name in names))
    assert main(["report", str(folder), "-o", str(folder / "page.md")]) == 0
    page = (folder / "page.md").read_text()
    assert page.startswith("# small\n\n    bulletarm-zoo benchmark small.yml\n")
    assert "Runs: 8 done, 1 waiting, 1 failed." in page
    assert "- failed CloseLoopBlockPicking/sac/seed_0: the block is lost" in page
    assert "](page.png)" in page and (folder / "page.png").read_bytes().startswith(b"\x89PNG")
    assert "- 8 runs on " in page and "torch" in page
    assert "interquartile mean" in page


def test_reports_that_cannot_be_made(folder: Path, refuse: Callable[..., str]) -> None:
    assert "there is no folder nowhere" in refuse("report", "nowhere")
    assert "must end in .md" in refuse("report", ".", "-o", "page.html")
    assert "cannot be written" in refuse("report", ".", "-o", "/dev/null/page.md")


def test_returns_have_no_share_of_successes(folder: Path) -> None:
    table = run_table(map(EvaluatedRun.of, find_runs(folder))).assign(measure="evaluation return")
    cells = cell_table(table)
    assert cells["low"].isna().all()
    assert "| CloseLoopBlockPicking | sacfd | 0.25 | 0.00 |  | 0 1 |" in markdown(
        cells, baseline_table(table)
    )
