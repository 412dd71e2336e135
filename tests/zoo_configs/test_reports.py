"""Tables, curves, films and files."""

from __future__ import annotations

import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from gymnasium import spaces

from bulletarm_gym.check import environments
from bulletarm_gym.check.environments import Yardstick
from zoo_configs.cells.cell import Cell
from zoo_configs.cli import main
from zoo_configs.drawing.curves import LearningCurve, draw_curves, load_curve, mean_curve
from zoo_configs.drawing.video import compose_frame, observed_images
from zoo_configs.errors import CommandError
from zoo_configs.files import whole_file
from zoo_configs.measuring import overhead
from zoo_configs.measuring.data_files import OVERHEAD, SPEED, UPDATES, DataFile, number
from zoo_configs.measuring.throughput import ReferenceRate, load_reference
from zoo_configs.training.runs import Run, claim_run_folder, write_resolved
from zoo_configs.training.seeds import SeedStream, stream_seed

REACHING = "BulletArm/CloseLoopBlockReaching-v0"


def test_speed_compares_with_the_reference(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(environments, "measure_yardstick", lambda: Yardstick(step_us=48, render_ms=4.2))
    data = DataFile(tmp_path / "speed.csv", SPEED)
    kept = ["--data", str(data.path), "--markdown"]
    assert main(["speed", "--env", REACHING, "--seconds", "0.1", "--reference", *kept]) == 0
    machine, head, _, row, summary = capsys.readouterr().out.splitlines()
    assert "load average" in machine
    cells = dict(zip(_cells(head), _cells(row), strict=True))
    assert cells["environment"] == REACHING
    parts = sum(float(cells[part]) for part in ("physics", "rendering", "rest"))
    assert parts == pytest.approx(float(cells["ms/step"]), abs=0.02)
    assert 0 < float(cells["without expert"]) <= float(cells["ms/step"])
    assert float(cells["ratio"]) > 0
    assert summary.startswith("ratio: geometric mean")
    [row] = data.read()
    assert row["env"] == "CloseLoopBlockReaching" and row["times_reference"] == number(
        float(cells["ratio"]), 1
    )
    assert row["step_ms"] == number(float(cells["ms/step"]), 2)
    assert row["command"].endswith(f"--env {REACHING} --seconds 0.1 --seed 0 --reference")
    assert main(["speed", "--baseline", "sacfd", "--env", REACHING, *kept]) == 2
    assert "speed.csv is no such file of measurements" in capsys.readouterr().err


def test_speed_splits_an_update(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = DataFile(tmp_path / "updates.csv", UPDATES)
    command = [
        "speed",
        "--baseline",
        "equi_sacfd",
        "sacfd",
        "sacfd_state",
        "--env",
        REACHING,
        "--seconds",
        "0.5",
        "--data",
        str(data.path),
        "--markdown",
    ]
    assert main(command) == 0
    machine, head, _, *rows = [
        line for line in capsys.readouterr().out.splitlines() if "|" in line or "load" in line
    ]
    assert REACHING in machine
    equivariant, plain, state = (dict(zip(_cells(head), _cells(row), strict=True)) for row in rows)
    assert float(equivariant["ms/update"]) > 0
    assert float(equivariant["equivariant/plain"]) > 0
    assert plain["equivariant/plain"] == state["equivariant/plain"] == ""
    shares = [float(value.rstrip("%")) for value in equivariant.values() if value.endswith("%")]
    assert sum(shares) == pytest.approx(100, abs=3)
    assert len(shares) == 4 and min(shares) >= 0  # each part is named
    first, second, third = data.read()
    assert [row["network"] for row in (first, second, third)] == ["equivariant", "cnn", "state"]
    assert first["update_ms"] == number(float(equivariant["ms/update"]), 1)
    kept = [first[part] for part in ("gradients_of_convolutions", "convolutions", "pooling", "rest")]
    assert [float(share) * 100 for share in kept] == pytest.approx(shares, abs=0.6)
    assert second["equivariant_over_plain"] == "" and second["device"] in ("cpu", "cuda")


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_a_reference_is_scaled_by_the_yardstick() -> None:
    rate = ReferenceRate(Yardstick(step_us=50, render_ms=4), steps_per_second=40, reset_ms=30)
    assert rate.scaled_to(Yardstick(step_us=100, render_ms=8)) == 20


def test_a_foreign_file_is_no_reference(tmp_path: Path) -> None:
    path = tmp_path / "rates.csv"
    path.write_text("a,b\n1,2\n")
    with pytest.raises(CommandError, match="columns env_id,"):
        load_reference(path)


def test_list_names_ids_parameters_and_baselines(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, expected in (
        ([], REACHING),
        (["--env", REACHING], "obs_size"),
        (["--baselines"], "equi_sacfd"),
    ):
        assert main(["list", *arguments]) == 0
        assert expected in capsys.readouterr().out


@pytest.mark.parametrize(
    ("env_id", "surface"), [(REACHING, "flat"), ("BulletArm/OpenLoopBumpHouseBuilding4-v0", "bump")]
)
def test_list_tells_the_surface(env_id: str, surface: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", "--env", env_id, "--markdown"]) == 0
    assert f"| surface | '{surface}' |" in capsys.readouterr().out


@pytest.mark.parametrize("arguments", [[], ["--env", REACHING], ["--baselines"]], ids=" ".join)
def test_lists_fit_80_columns(
    arguments: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert main(["list", *arguments]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    assert "…" not in "".join(lines)


def test_help_is_quick() -> None:
    """Neither PyTorch nor the engine is loaded to tell what a command takes."""
    code = (
        "import sys; from zoo_configs.cli import main\n"
        "for command in ('enjoy', 'record', 'plot', 'speed', 'list'):\n"
        "    try: main([command, '--help'])\n"
        "    except SystemExit: pass\n"
        "assert not {'torch', 'pybullet', 'matplotlib'} & set(sys.modules), 'heavy'"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


def test_curves_read_success(tmp_path: Path) -> None:
    path = tmp_path / "evaluations.npz"
    np.savez(path, timesteps=[5, 10], results=[[0, 0], [9, 9]], successes=[[False, True], [True, True]])
    curve = load_curve(path)
    assert curve.success.tolist() == [0.5, 1.0]
    assert curve.error == pytest.approx([0.5 / np.sqrt(2), 0])
    draw_curves({"title": {"agent": curve}}, tmp_path / "curve.png")
    assert (tmp_path / "curve.png").read_bytes().startswith(b"\x89PNG")


def test_a_mean_curve_takes_at_each_step_the_runs_that_have_it() -> None:
    error, ones = np.full(3, 0.1), np.ones(3, dtype=np.int64)
    long = LearningCurve(np.array([5, 10, 15]), np.array([0.0, 0.5, 1.0]), error, "success", ones)
    short = LearningCurve(np.array([5, 10]), np.array([1.0, 1.0]), error[:2], "success", ones[:2])
    mean = mean_curve([long, short])
    assert mean.timesteps.tolist() == [5, 10, 15]
    assert mean.success.tolist() == [0.5, 0.75, 1.0]
    assert mean.error == pytest.approx([0.5, 0.25, np.nan], nan_ok=True)  # over seeds, where there are two
    assert mean.runs.tolist() == [2, 2, 1]
    assert mean_curve([long]) is long


def test_plot_draws_a_panel_an_environment(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for env_id in (REACHING, "BulletArm/CloseLoopBlockPicking-v0"):
        for seed in range(2):
            folder = claim_run_folder(tmp_path / "sacfd", env_id)
            run = Run(folder, Cell("sacfd", env_id, {}, {}, "equi_sacfd", "cpu"), ())
            write_resolved(run)
            successes = [[False, False], [seed == 0, True]]
            np.savez(run.evaluations_file, timesteps=[5, 10], results=successes, successes=successes)
    assert main(["plot", "-f", str(tmp_path), "--markdown"]) == 0
    _, _, picking, reaching, *others = capsys.readouterr().out.splitlines()
    assert _cells(reaching)[:5] == ["CloseLoopBlockReaching", "equi_sacfd", "0.75", "0.25", "0.30 to 0.95"]
    assert "BlockPicking" in picking
    assert others[-3].strip() == str(tmp_path / "learning_curves.png")
    assert (tmp_path / "learning_curves.png").read_bytes().startswith(b"\x89PNG")


def evaluated_run(log_folder: Path, env_id: str, timesteps: list[int]) -> None:
    folder = claim_run_folder(log_folder / "sacfd", env_id)
    run = Run(folder, Cell("sacfd", env_id, {}, {}, "sacfd", "cpu"), ())
    write_resolved(run)
    results = np.zeros((len(timesteps), 2))
    np.savez(run.evaluations_file, timesteps=timesteps, results=results, successes=results)


def test_plot_takes_runs_of_different_evaluations(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for timesteps in ([5, 10], [6, 12]):
        evaluated_run(tmp_path, REACHING, timesteps)
    assert main(["plot", "-f", str(tmp_path), "-o", str(tmp_path / "curves.svg")]) == 0
    assert "CloseLoopBlockReaching" in capsys.readouterr().out
    assert "<svg" in (tmp_path / "curves.svg").read_text()


def test_plot_tells_what_it_cannot_read_or_write(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    evaluated_run(tmp_path, REACHING, [5, 10])
    for output, message in (("curves", "must end in .png"), ("/dev/null/a.png", "cannot be written")):
        assert main(["plot", "-f", str(tmp_path), "-o", output]) == 2
        assert message in capsys.readouterr().err
    [evaluations] = tmp_path.glob("sacfd/*/evaluations.npz")
    evaluations.write_bytes(evaluations.read_bytes()[:100])
    assert main(["plot", "-f", str(tmp_path)]) == 2
    assert f"{evaluations} is damaged" in capsys.readouterr().err


def test_plot_tells_that_there_is_nothing_to_draw(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plot", "-f", str(tmp_path)]) == 2
    assert "no evaluated run" in capsys.readouterr().err


def test_a_frame_shows_picture_and_heightmap() -> None:
    space = spaces.Dict({"heightmap": spaces.Box(0, 0.4, (1, 8, 8)), "holding": spaces.Box(0, 1, (1,))})
    seen = {"heightmap": np.full((1, 8, 8), 0.2, np.float32), "holding": np.zeros(1, np.float32)}
    (image,) = observed_images(seen, space)
    assert image == pytest.approx(np.full((8, 8), 0.5))
    picture = np.full((60, 80, 3), 7, np.uint8)
    frame = compose_frame(picture, seen, space, "caption")
    assert frame.shape == (352, 640, 3)
    assert (frame[:320, :320] == 7).all()
    assert (frame[:320, 320:] != 7).all()
    assert frame[320:].max() > 200  # there is a text


def test_a_file_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "file.txt"
    path.write_text("before")
    with pytest.raises(RuntimeError), whole_file(path) as partial:
        partial.write_text("half")
        raise RuntimeError
    assert path.read_text() == "before"
    with whole_file(path) as partial:
        partial.write_text("after")
    assert path.read_text() == "after"
    assert list(tmp_path.iterdir()) == [path]


def test_seed_streams_are_apart() -> None:
    seeds = {
        stream_seed(seed, stream, index) for seed in range(4) for stream in SeedStream for index in range(9)
    }
    assert len(seeds) == 4 * len(SeedStream) * 9
    assert stream_seed(1, SeedStream.TEST) == stream_seed(1, SeedStream.TEST)


def test_speed_tells_what_train_adds(
    toy_id: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(overhead, "measure_overhead", partial(overhead.measure_overhead, pairs=2))
    data = DataFile(tmp_path / "overhead.csv", OVERHEAD)
    # The paper's preset has no updates before the first step.
    command = ["speed", "--baseline", "sacfd", "--env", toy_id, "--preset", "paper", "--device", "cpu"]
    command += ["--env-kwargs", "obs_size:128", "--overhead", "2", "--data", str(data.path), "--markdown"]
    assert main(command) == 0
    *_, head, _, row = capsys.readouterr().out.splitlines()
    measured = dict(zip(_cells(head), _cells(row), strict=True))
    assert measured["time steps"] == "2" and measured["overhead"].endswith("%")
    assert float(measured["model.learn() CPU s"]) > 0 and float(measured["train CPU s"]) > 0
    [row] = data.read()
    assert row["timesteps"] == "2" and row["env_kwargs"] == "obs_size:128"
    assert float(row["least"]) <= float(row["overhead"]) <= float(row["greatest"])
