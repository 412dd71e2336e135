"""Tables, curves, films and files."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from gymnasium import spaces

from zoo_configs.cli import main
from zoo_configs.drawing.curves import LearningCurve, draw_curves, load_curve, mean_curve
from zoo_configs.drawing.video import compose_frame, observed_images
from zoo_configs.experiments.config import ExperimentConfig
from zoo_configs.files import whole_file
from zoo_configs.training.runs import Run, claim_run_folder, write_resolved
from zoo_configs.training.seeds import SeedStream, stream_seed

REACHING = "BulletArm/CloseLoopBlockReaching-v0"


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
        "for command in ('enjoy', 'record', 'plot', 'benchmark', 'list'):\n"
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


def evaluated_run(log_folder: Path, env_id: str, timesteps: list[int]) -> None:
    folder = claim_run_folder(log_folder / "sacfd", env_id)
    experiment = ExperimentConfig("sacfd", env_id, {"n_timesteps": 10}, {}, "sacfd", "cpu")
    run = Run(folder, experiment, len(list(log_folder.glob("*/*"))))
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
