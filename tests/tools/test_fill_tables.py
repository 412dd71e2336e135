"""Pages are filled from data files."""

import sys
from pathlib import Path

import pytest

import fill_tables
from measurements import DataFile, number

HEAD = "env robot env_kwargs snap episodes first_seed success mean_steps machine date commit command".split()
EXPERT = dict.fromkeys(HEAD, "") | {"env": "CloseLoopBlockReaching", "robot": "kuka", "episodes": "200"}
EXPERT |= {"success": "0.995", "mean_steps": "3.04"}
KEY = ("env", "robot", "env_kwargs", "snap")


def place(name: str, content: str = "") -> str:
    return f"<!-- data: {name} -->{content}<!-- end of data -->"


def test_a_row_replaces_the_one_with_its_key(tmp_path: Path) -> None:
    data = DataFile(tmp_path / "experts.csv", KEY)
    for changes in {}, {"robot": "ur5"}, {"success": "0.5"}:
        data.add({**EXPERT, **changes})
    assert [(row["robot"], row["success"]) for row in data.read()] == [("kuka", "0.5"), ("ur5", "0.995")]


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
    DataFile(tmp_path / "experts.csv", KEY).add(EXPERT)
    pages = {tmp_path / "a.md": place("experts, close loop"), tmp_path / "b.md": text}
    for page, content in pages.items():
        page.write_text(content)
    monkeypatch.setattr(sys, "argv", ["fill_tables.py", str(tmp_path), "--data", str(tmp_path)])
    with pytest.raises(SystemExit, match=r"b\.md"):
        fill_tables.main()
    assert {page: page.read_text() for page in pages} == pages
