"""Pages are filled from data files."""

import sys
from pathlib import Path

import pytest

import expert_tables
import fill_tables
import measurements
from measurements import DataFile, number

REACHING = "CloseLoopBlockReaching"
EXPERT = dict.fromkeys(
    "env robot env_kwargs snap episodes first_seed success mean_steps machine date commit command".split(), ""
)
KEY = ("env", "robot", "env_kwargs", "snap")


def place(name: str, content: str = "") -> str:
    return f"<!-- data: {name} -->{content}<!-- end of data -->"


def put_experts(folder: Path, *rows: dict[str, str]) -> None:
    usual = dict(env=REACHING, robot="kuka", episodes="200", success="0.995", mean_steps="3.04")
    for row in rows:
        about = dict(commit="abc1234", date="2026-01-02")
        DataFile(folder / "experts.csv", KEY).add({**EXPERT, **usual, **about, **row})


def test_a_row_replaces_the_one_with_its_key(tmp_path: Path) -> None:
    put_experts(tmp_path, {}, {"robot": "ur5"}, {"success": "0.5"})
    rows = DataFile(tmp_path / "experts.csv", KEY).read()
    assert [(row["robot"], row["success"]) for row in rows] == [("kuka", "0.5"), ("ur5", "0.995")]


def test_a_file_with_other_columns_is_rejected(tmp_path: Path) -> None:
    (tmp_path / "experts.csv").write_text("a,b\n1,2\n")
    with pytest.raises(SystemExit, match=r"experts\.csv"):
        DataFile(tmp_path / "experts.csv", KEY).read()


def test_numbers_have_no_trailing_zeros() -> None:
    assert [number(value, 3) for value in (1.0, 0.5, 0.1236, 100.0)] == ["1", "0.5", "0.124", "100"]
    assert number(100.0, 0) == "100" and number(float("nan"), 2) == ""


def test_places_are_filled_and_the_rest_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    figures = {"two": lambda _: "2", "table": lambda _: "| a |\n| - |"}
    monkeypatch.setattr(fill_tables, "FIGURES", figures)
    text = "As in `<!-- data: NAME -->`.\n\nIt is {two} times.\n\n{table}\n\n??? info\n\n    {fold}\n\nEnd\n"
    page = tmp_path / "page.md"
    old = {"table": place("table", "\n\nold\n\n"), "fold": place("table")}
    page.write_text(text.format(two=place("two", "3"), **old))
    table, fold = (
        f"\n\n{indentation}| a |\n{indentation}| - |\n\n{indentation}" for indentation in ("", "    ")
    )
    new = {"table": place("table", table), "fold": place("table", fold)}
    wanted = text.format(two=place("two", "2"), **new)
    monkeypatch.setattr(sys, "argv", ["fill_tables.py", str(page)])
    fill_tables.main()
    assert page.read_text() == wanted


@pytest.mark.parametrize("text", [place("sped"), place("speed").replace("end", "ned")])
def test_no_page_is_written_if_one_cannot_be_filled(
    text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    put_experts(tmp_path, {})
    pages = {tmp_path / "a.md": place("experts, close loop"), tmp_path / "b.md": text}
    for page, content in pages.items():
        page.write_text(content)
    monkeypatch.setattr(sys, "argv", ["fill_tables.py", str(tmp_path), "--data", str(tmp_path)])
    with pytest.raises(SystemExit, match=r"b\.md"):
        fill_tables.main()
    assert {page: page.read_text() for page in pages} == pages


def test_experts_have_a_column_for_each_arm(tmp_path: Path) -> None:
    put_experts(
        tmp_path,
        {},
        {"env_kwargs": "random_orientation:False", "success": "1", "mean_steps": "3"},
        {"env_kwargs": "obs_size:32", "success": "0"},  # in no column
        {"robot": "panda", "episodes": "50", "success": "0", "mean_steps": ""},
    )
    source = expert_tables.Source(tmp_path, tmp_path / "page.md")
    head, _, line, *_ = expert_tables.expert_table(source, lambda name: name == REACHING).splitlines()
    assert head == "| id `BulletArm/...-v0` | KUKA | KUKA, fixed orientation | Panda |"
    assert line == f"| `{REACHING}` | 0.995, 3.0 | 1.000, 3.0 | 0.00 |"
    assert f"| `{REACHING}` | kuka | `obs_size:32` | 0.000, 3.0 |" in expert_tables.other_experts(source)


def test_seeds_share_a_row(tmp_path: Path) -> None:
    columns = (measurements.DATA / "results.csv").read_text().splitlines()[0].split(",")
    usual = dict(env="CloseLoopToy", baseline="sacfd", preset="quick", demonstrations="300", noise="0.1")
    usual |= dict(updates="500", steps="1500", best="1", last="0.95", minutes="3.4", commit="abc1234")
    data = DataFile(tmp_path / "results.csv", ("env", "seed", "steps"))
    for more in dict(seed="0"), dict(seed="2", best="0.5", last="0.85"), dict(seed="1", steps="9"):
        data.add({**dict.fromkeys(columns, ""), **usual, **more})
    source = expert_tables.Source(tmp_path, tmp_path / "page.md")
    _, _, line, other = fill_tables.results_table(source, "quick", "*").splitlines()
    assert "| 300 with noise, 500, 1,500 | 0, 2 | 0.75 (1.00, 0.50) | 0.90 (0.95, 0.85) |" in line
    assert "300 with noise, 500, 9 | 1 | 1.00 | 0.95 |" in other


def test_summary_has_means_over_seeds_of_one_preset(tmp_path: Path) -> None:
    columns = (measurements.DATA / "results.csv").read_text().splitlines()[0].split(",")
    data = DataFile(tmp_path / "results.csv", ("env", "seed", "preset"))
    for seed, last, preset, minutes in (
        ("0", "1", "cpu", ""),
        ("1", "0.5", "cpu", "3"),
        ("2", "0", "quick", ""),
    ):
        run = dict(env="CloseLoopToy", seed=seed, last=last, preset=preset, minutes=minutes)
        data.add({**dict.fromkeys(columns, ""), **run})
    source = expert_tables.Source(tmp_path, tmp_path / "page.md")
    assert fill_tables.results_summary(source).splitlines()[2:] == ["| `CloseLoopToy` | 0.75 | 3 |"]
