"""Pages whose tables and sentences are filled from files of measurements."""

from __future__ import annotations

from pathlib import Path

import pytest

from zoo_configs.cli import main
from zoo_configs.errors import CommandError
from zoo_configs.measuring.data_files import EXPERTS, SPEED, DataFile
from zoo_configs.pages.experts import elsewhere_table, expert_table
from zoo_configs.pages.markers import Source, fill_pages, filled, pages_of
from zoo_configs.pages.speeds import ratio_sentence, ratio_summary

FIGURES = {"two": lambda source: "2", "table": lambda source: "| a |\n| - |"}
REACHING = "CloseLoopBlockReaching"


def page_of(folder: Path, text: str) -> Path:
    page = folder / "page.md"
    page.write_text(text)
    return page


def place(name: str, content: str = "") -> str:
    return f"<!-- data: {name} -->{content}<!-- end of data -->"


def test_places_are_filled_and_the_rest_is_left(tmp_path: Path) -> None:
    text = "Told in `<!-- data: NAME -->`.\n\nIt is {two} times.\n\n{table}\n\nEnd\n"
    page = page_of(tmp_path, text.format(two=place("two", "3"), table=place("table", "\n\nold\n\n")))
    wanted = text.format(two=place("two", "2"), table=place("table", "\n\n| a |\n| - |\n\n"))
    assert fill_pages([page], tmp_path, FIGURES) == [page]
    assert page.read_text() == wanted
    assert fill_pages([page], tmp_path, FIGURES) == []


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (place("tow"), r"unknown place for data 'tow', did you mean 'two'\?"),
        (place("two")[:20] + place("two"), "has no <!-- end of data -->"),
        (place("two").replace("end", "ned"), "has no <!-- end of data -->"),
    ],
)
def test_nothing_is_written_if_one_page_cannot_be_filled(text: str, message: str, tmp_path: Path) -> None:
    good, bad = tmp_path / "good.md", tmp_path / "later.md"
    good.write_text(place("two"))
    bad.write_text(text)
    with pytest.raises(CommandError, match=message):
        fill_pages(pages_of([tmp_path]), tmp_path, FIGURES)
    assert good.read_text() == place("two")


def put_experts(folder: Path, *rows: dict[str, str]) -> None:
    usual = dict(env=REACHING, robot="kuka", episodes="200", success="0.995", mean_steps="3.04")
    about = dict(first_seed="0", commit="abc1234", date="2026-01-02")
    for row in rows:
        DataFile(folder / "experts.csv", EXPERTS).add(
            {**dict.fromkeys(EXPERTS.columns, ""), **usual, **about, **row}
        )


def test_experts_stand_side_by_side(tmp_path: Path) -> None:
    fixed = "action_sequence:'pxyz' random_orientation:False"
    put_experts(
        tmp_path,
        {},
        {"env_kwargs": fixed, "success": "1", "mean_steps": "3"},
        {"env_kwargs": "obs_size:32", "success": "0"},  # neither default nor fixed: in no column
        {"robot": "panda", "episodes": "50", "success": "0", "mean_steps": ""},
        {"env": "CloseLoopBlockPicking", "episodes": "35", "commit": "def5678"},
    )
    source = Source(tmp_path, tmp_path / "docs" / "page.md")
    assert f"| `{REACHING}` | kuka | `obs_size:32` | 0.000, 3.0 |" in elsewhere_table(source)
    assert "Picking" not in elsewhere_table(source)
    table = expert_table(source, lambda name: name.startswith("CloseLoopBlock"))
    lines = table.splitlines()
    assert lines[0] == "| id `BulletArm/...-v0` | KUKA | KUKA, fixed orientation | Panda |"
    assert lines[2:4] == [
        f"| `{REACHING}` | 0.995, 3.0 | 1.000, 3.0 | 0.00 |",
        "| `CloseLoopBlockPicking` | 0.99, 3.0 |  |  |",
    ]
    assert "[experts.csv](../experts.csv)" in table
    assert "- Panda: 50 episodes, commit abc1234, 2026-01-02" in lines
    kuka = "- KUKA: 200 episodes, commit abc1234, 2026-01-02; 35 episodes, commit def5678, 2026-01-02 "
    assert kuka + "(`CloseLoopBlockPicking`)" in lines


def test_ratios_are_summed_up_by_their_geometric_mean(tmp_path: Path) -> None:
    ratios = {"CloseLoopA": "2", "CloseLoopB": "8", "CloseLoopOurs": "", "OpenLoopA": "3"}
    for name, ratio in ratios.items():
        row = {**dict.fromkeys(SPEED.columns, ""), "env": name, "times_reference": ratio}
        DataFile(tmp_path / "speed.csv", SPEED).add(row)
    source = Source(tmp_path, tmp_path / "page.md")
    said = ratio_sentence(source)
    assert "4.0 for the 2 close-loop tasks of the paper (the least 2.0) and 3.0 for its 1" in said
    assert ratio_summary(source).startswith("Steps 2 to 8 times as fast")


def test_report_fills_pages(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    put_experts(tmp_path / "data", {})
    page = page_of(tmp_path, place("experts, close loop"))
    command = ["report", "--docs", str(tmp_path), "--data"]
    assert main([*command, str(tmp_path / "data")]) == 0
    assert capsys.readouterr().out.split() == ["Written:", str(page)]
    assert f"| `{REACHING}` | 0.995, 3.0 |" in page.read_text()
    assert main([*command, str(tmp_path / "data")]) == 0
    assert "Nothing has changed" in capsys.readouterr().out
    assert main([*command, str(tmp_path / "nowhere")]) == 2
    assert "there is no" in capsys.readouterr().err


def test_a_page_without_places_is_left(tmp_path: Path) -> None:
    assert filled(page_of(tmp_path, "plain"), tmp_path, {}) == "plain"
