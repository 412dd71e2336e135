"""Programs that measure and draw, pages that are filled from data files, and the website."""

import csv
import json
import re
import runpy
import subprocess
import sys
from pathlib import Path

import imageio.v3 as iio
import pytest

import bulletarm_gym
import fill_tables
from measurements import DataFile, runs_of_tasks
from website import agents, gallery, hooks, measured, task_page
from website.catalogue import SHOWN, grouped, relatives
from website.docstrings import LABELS
from website.markdown import table

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


def test_runs_of_other_experiments_do_not_count_for_their_task():
    others = (
        {"options": "-params expert_episodes:10"},
        {"options": "--benchmark open_loop_2d"},
        {"preset": "quick"},
    )
    run = {"env": "CloseLoopCornerPicking", "preset": "cpu", "options": "", "last": "0.99"}
    assert runs_of_tasks([run, *(run | other for other in others)]) == {run["env"]: [run]}


ROOT = Path(__file__).resolve().parents[2]
TOOLS = ROOT / "tools"
REACHING = "BulletArm/CloseLoopBlockReaching-v0"
STACKING = "BulletArm/OpenLoopBlockStacking-v0"


def run(monkeypatch, program, *words):
    monkeypatch.setattr(sys, "argv", [program, *words])
    runpy.run_path(str(TOOLS / program), run_name="__main__")


def test_speed_is_compared_with_a_reference(tmp_path, monkeypatch):
    rates, data = ROOT / "docs" / "data" / "reference_rates.csv", tmp_path / "speed.csv"
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


@pytest.mark.parametrize("more", [[], ["--over", "expert_episodes"]], ids=" ".join)
def test_curves_are_drawn_over_time_steps_or_a_setting(more, tmp_path, monkeypatch):
    data, image = ROOT / "docs" / "data" / "demonstrations.csv", tmp_path / "curves.png"
    run(monkeypatch, "draw_curves.py", str(data), *more, "-o", str(image))
    assert iio.imread(image).std() > 10


BY_NAME = {one.name: one for one in SHOWN}
PICKING = "CloseLoopBlockPicking"


def test_every_environment_has_images_and_a_page_in_navigation_and_gallery():
    assert [one.env_id for one in SHOWN] == list(bulletarm_gym.ENV_IDS)
    folder = ROOT / "docs" / "images" / "tasks"
    wanted = {f"{one.image}{suffix}.webp" for one in SHOWN for suffix in ("", "-heightmap")}
    assert {path.name for path in folder.iterdir()} == wanted
    home = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    assert f"{len(bulletarm_gym.ENV_IDS)} tasks," in home
    first, *groups = hooks.navigation()
    entries = [entry for group in groups for members in group.values() for entry in members]
    pages = [page for entry in entries for page in entry.values()]
    assert first == "tasks/index.md" and sorted(pages) == sorted(f"tasks/{name}.md" for name in BY_NAME)
    assert sorted(re.findall(r"\]\((\w+)\.md\)", gallery.page())) == sorted(BY_NAME)
    members = [one.name for group in grouped().values() for one in group]
    assert sorted(members) == sorted(BY_NAME)


def test_pages_of_all_environments():
    for name, shown in BY_NAME.items():
        text = task_page.page(shown)
        heads = re.findall(r"^## (.*)$", text, re.MULTILINE)
        assert heads[:4] == ["Task", "Observation", "Action", "Parameters"]
        assert shown.env_id in text and ":class:" not in text and ":attr:" not in text, name
        for target in re.findall(r"\]\(([\w./-]+)(?:#[\w-]+)?\)", text):
            exists = (ROOT / "docs" / "tasks" / target).resolve().exists()
            assert exists or target.removesuffix(".md") in BY_NAME, target


def test_pages_describe_the_class_the_spaces_and_the_parameters():
    text = task_page.page(BY_NAME["OpenLoopRampHouseBuilding2"])
    facts = BY_NAME["OpenLoopRampHouseBuilding2"].facts
    assert tuple(facts) == LABELS and "roof" in facts["Description"]
    assert "at least 4.2 cm" in facts["Randomisation"]  # from the class that it extends
    assert "`Box(0, 0.4, (3, 24, 24), float32)`" in text and "`Box(-1, 1, (7,), float32)`" in text
    assert "| 5 | `r` | rotation about the rotated y axis | -0.785 rad (-45°) | 0.785 rad (45°) |" in text
    assert "| `in_hand_size` |" in text and "| `view` |" not in text
    names = {other.name for other in relatives(BY_NAME["CloseLoopHouseBuilding"])}
    assert names == {"OpenLoopHouseBuilding1", "OpenLoopRampHouseBuilding1", "CloseLoopHouseBuilding1"}
    cells = table(["a", "b"], [["x | y", "1\n2"]], numbers=1)
    assert cells == "| a | b |\n| --- | ---: |\n| x \\| y | 1 2 |\n"


def test_results_are_read_from_tables_and_cards():
    text = task_page.page(BY_NAME[PICKING])
    card = json.loads((measured.AGENTS / PICKING / "equi_sacfd" / "card.json").read_text())
    with (measured.DATA / "experts.csv").open(newline="") as file:
        rows = [list(row.values()) for row in csv.DictReader(file)]
    [success] = [float(row[6]) for row in rows if row[:4] == [PICKING, "kuka", "", ""]]
    assert f"| KUKA |  | {success:.2f}" in text and "steps per second**" in text
    assert f"success rate **{card['success']:.2f}** in {card['episodes']} episodes" in text
    assert f"bulletarm-zoo enjoy --published BulletArm/{PICKING}-v0 --baseline equi_sacfd" in text
    assert PICKING in agents.filled("<!-- agents: sacfd, equi_* -->")
    assert agents.filled("a\n<!-- agents: none_* -->\nb") == "a\n\nb"


@pytest.mark.slow
def test_site_is_built_strictly(tmp_path):
    """Every link, anchor and reference leads somewhere."""
    pytest.importorskip("mkdocstrings_handlers", reason="the extra docs")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    page = (tmp_path / "tasks" / "OpenLoopBlockStacking" / "index.html").read_text(encoding="utf-8")
    assert 'href="../../api/tasks/#bulletarm_gym.tasks.stacking.BlockStacking"' in page
    home = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert "fonts.googleapis.com" not in home and "fonts.gstatic.com" not in home
    role = re.compile(":(?:attr|class|data|exc|func|meth|mod):[`<]")
    pages = (tmp_path / "api").rglob("*.html")
    left = [path for path in pages if role.search(path.read_text(encoding="utf-8"))]
    assert not left, "roles that Markdown does not know"
