"""Programs that measure run and add rows."""

import runpy
import sys
from pathlib import Path

import imageio.v3 as iio
import pytest

from measurements import DataFile

TOOLS = Path(__file__).resolve().parents[2] / "tools"
REACHING = "BulletArm/CloseLoopBlockReaching-v0"
STACKING = "BulletArm/OpenLoopBlockStacking-v0"


def run(monkeypatch: pytest.MonkeyPatch, program: str, *words: str) -> None:
    monkeypatch.setattr(sys, "argv", [program, *words])
    runpy.run_path(str(TOOLS / program), run_name="__main__")


def test_speed_is_compared_with_a_reference(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rates, data = TOOLS.parent / "docs" / "data" / "reference_rates.csv", tmp_path / "speed.csv"
    words = ["--env", REACHING, "--seconds", "0.1", "--reference", str(rates), "--data", str(data)]
    run(monkeypatch, "measure_speed.py", *words)
    [row] = DataFile(data, ("env",)).read()
    parts = sum(float(row[f"{part}_ms"]) for part in ("physics", "rendering", "rest"))
    assert parts == pytest.approx(float(row["step_ms"]), abs=0.02)
    assert 0 < float(row["without_expert_ms"]) <= float(row["step_ms"])
    assert float(row["times_reference"]) > 0 and "measure_speed.py --env" in row["command"]


@pytest.mark.slow
def test_an_update_has_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = tmp_path / "updates.csv"
    words = ["--baseline", "equi_sacfd", "--env", REACHING, "--seconds", "0.3", "--data", str(data)]
    run(monkeypatch, "measure_updates.py", *words)
    [row] = DataFile(data, ("baseline",)).read()
    shares = [float(row[part]) for part in ("gradients_of_convolutions", "convolutions", "pooling", "rest")]
    assert sum(shares) == pytest.approx(1.0, abs=0.01)
    assert float(row["update_ms"]) > 0 and float(row["equivariant_over_plain"]) > 0


def test_experts_are_measured_on_the_grid(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = tmp_path / "experts.csv"
    kwargs = ["--env-kwargs", "obs_size:64", "num_objects:2", "--data", str(data)]
    run(monkeypatch, "measure_experts.py", "--env", STACKING, "-n", "1", "--snap", *kwargs)
    [row] = DataFile(data, ("env",)).read()
    figures = [row[name] for name in ("env", "robot", "env_kwargs", "snap", "success", "mean_steps")]
    assert figures == ["OpenLoopBlockStacking", "kuka", "num_objects:2 obs_size:64", "yes", "1", "2"]


def test_tasks_are_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["--env", STACKING, "-o", str(tmp_path), "--pixels", "32", "--heightmap"]
    run(monkeypatch, "draw_gallery.py", *words, "--env-kwargs", "obs_size:32")
    names = ["OpenLoopBlockStacking-v0-heightmap.webp", "OpenLoopBlockStacking-v0.webp"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    assert iio.imread(tmp_path / names[1]).shape == (30, 52, 3)


def test_curves_are_kept_in_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = tmp_path / "curves.csv"
    source = (TOOLS.parent / "docs" / "data" / "six_baselines.csv").read_text().splitlines()
    data.write_text("\n".join(source[:3]) + "\n")
    run(monkeypatch, "draw_curves.py", str(data), "-o", str(tmp_path / "curves.png"))
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")
