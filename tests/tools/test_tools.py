"""Programs that measure and draw, and pages that are filled from data files."""

import runpy
import sys
from pathlib import Path

import imageio.v3 as iio
import pytest

import fill_tables
from measurements import DataFile

HEAD = "env robot env_kwargs snap episodes first_seed success mean_steps machine date commit command".split()
EXPERT = dict.fromkeys(HEAD, "") | {"env": "CloseLoopBlockReaching", "robot": "kuka", "episodes": "200"}
EXPERT |= {"success": "0.995", "mean_steps": "3.04"}
KEY = ("env", "robot", "env_kwargs", "snap")


def place(name, content=""):
    return f"<!-- data: {name} -->{content}<!-- end of data -->"


def test_a_row_replaces_the_one_with_its_key_in_a_file_with_its_columns(tmp_path):
    data = DataFile(tmp_path / "experts.csv", KEY)
    for changes in {}, {"robot": "ur5"}, {"success": "0.5"}:
        data.add({**EXPERT, **changes})
    assert [(row["robot"], row["success"]) for row in data.read()] == [("kuka", "0.5"), ("ur5", "0.995")]
    (tmp_path / "experts.csv").write_text("a,b\n1,2\n")
    with pytest.raises(SystemExit, match=r"experts\.csv"):
        data.read()


@pytest.mark.parametrize("text", [place("sped"), place("speed").replace("end", "ned")])
def test_no_page_is_written_if_one_cannot_be_filled(text, tmp_path, monkeypatch):
    DataFile(tmp_path / "experts.csv", KEY).add(EXPERT)
    pages = {tmp_path / "a.md": place("experts, close loop"), tmp_path / "b.md": text}
    for page, content in pages.items():
        page.write_text(content)
    monkeypatch.setattr(sys, "argv", ["fill_tables.py", str(tmp_path), "--data", str(tmp_path)])
    with pytest.raises(SystemExit, match=r"b\.md"):
        fill_tables.main()
    assert {page: page.read_text() for page in pages} == pages


TOOLS = Path(__file__).resolve().parents[2] / "tools"
REACHING = "BulletArm/CloseLoopBlockReaching-v0"
STACKING = "BulletArm/OpenLoopBlockStacking-v0"


def run(monkeypatch, program, *words):
    monkeypatch.setattr(sys, "argv", [program, *words])
    runpy.run_path(str(TOOLS / program), run_name="__main__")


def test_speed_is_compared_with_a_reference(tmp_path, monkeypatch):
    rates, data = TOOLS.parent / "docs" / "data" / "reference_rates.csv", tmp_path / "speed.csv"
    words = ["--env", REACHING, "--seconds", "0.1", "--reference", str(rates), "--data", str(data)]
    run(monkeypatch, "measure_speed.py", *words)
    [row] = DataFile(data, ("env",)).read()
    parts = sum(float(row[f"{part}_ms"]) for part in ("physics", "rendering", "rest"))
    assert parts == pytest.approx(float(row["step_ms"]), abs=0.02)
    assert 0 < float(row["without_expert_ms"]) <= float(row["step_ms"])
    assert float(row["times_reference"]) > 0 and "measure_speed.py --env" in row["command"]


def test_experts_are_measured_on_the_grid(tmp_path, monkeypatch):
    data = tmp_path / "experts.csv"
    kwargs = ["--env-kwargs", "obs_size:64", "num_objects:2", "--data", str(data)]
    run(monkeypatch, "measure_experts.py", "--env", STACKING, "-n", "1", "--snap", *kwargs)
    [row] = DataFile(data, ("env",)).read()
    figures = [row[name] for name in ("env", "robot", "env_kwargs", "snap", "success", "mean_steps")]
    assert figures == ["OpenLoopBlockStacking", "kuka", "num_objects:2 obs_size:64", "yes", "1", "2"]


def test_tasks_are_drawn(tmp_path, monkeypatch):
    words = ["--env", STACKING, "-o", str(tmp_path), "--pixels", "32", "--heightmap"]
    run(monkeypatch, "draw_gallery.py", *words, "--env-kwargs", "obs_size:32")
    names = ["OpenLoopBlockStacking-v0-heightmap.webp", "OpenLoopBlockStacking-v0.webp"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    assert iio.imread(tmp_path / names[1]).shape == (30, 52, 3)
