"""The table of results: rows of runs, replaced when measured anew, and the page that shows it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from zoo_configs.cli import main
from zoo_configs.publishing.measured import Row, merge, read_rows, render_page, write_rows
from zoo_configs.publishing.published import published_agents

Refuse = Callable[..., str]
DOCS = Path(__file__).resolve().parents[2] / "docs"
PLACE = "# Page\n\n<!-- results: quick CloseLoop* -->\n<!-- end of results -->\n\nText.\n"
ROW = Row(
    "BulletArm/CloseLoopToy-v0", "", "sacfd", "quick", "0", "300", "0.1", "", "500", "1500", "1", "0.95"
)


def test_the_page_shows_the_table() -> None:
    """Mended by: bulletarm-zoo results -o docs/data/results.csv --page docs/results.md"""
    page = (DOCS / "results.md").read_text(encoding="utf-8")
    assert render_page(page, read_rows(DOCS / "data" / "results.csv")) == page


def test_the_table_has_a_row_for_each_published_agent() -> None:
    rows = read_rows(DOCS / "data" / "results.csv")
    measured = {(row.env, row.baseline, row.preset, row.seed, row.commit) for row in rows}
    for _, card in published_agents():
        assert (card.env, card.baseline, card.preset, str(card.seed), card.commit) in measured


def test_a_run_gets_a_row(run_folder: Path, toy_id: str, tmp_path: Path) -> None:
    table, page = tmp_path / "results.csv", tmp_path / "page.md"
    page.write_text(PLACE)
    other = Row("BulletArm/CloseLoopOther-v0", "", "sac", "quick", "0", "1", "", "", "2", "3")
    write_rows(table, [other])
    words = [str(run_folder), "-o", str(table), "-n", "2", "--device", "cpu", "--commit", "abc1234"]
    for _ in range(2):  # the second time it is replaced
        assert main(["results", *words, "--page", str(page)]) == 0
        first, row = read_rows(table)
    assert first == other
    assert (row.env, row.baseline, row.preset, row.seed) == (toy_id, "equi_sacfd", "quick", "0")
    assert {row.best, row.last} <= {"0", "0.5", "1"}
    assert (row.episodes, row.updates, row.steps, row.commit) == ("2", "2", "12", "abc1234")
    assert "batch_size:4" in row.options
    assert "| Toy (" in page.read_text()
    assert "| Other |" in page.read_text()


def test_rows_become_cells() -> None:
    page = render_page(PLACE, [ROW, Row(*ROW.key[:3], "cpu", "0")])
    assert "| Toy | `sacfd` | 300 with noise, 500, 1,500 | 1.00 | 0.95 |  |  |  |" in page
    assert page.count("`sacfd`") == 1  # the other preset has no place
    assert render_page(page, [ROW]) == page


def test_a_row_is_replaced_where_it_stands() -> None:
    others = [Row("a", "", "b", "c", "0"), Row("d", "", "e", "f", "0")]
    new = Row("a", "", "b", "c", "0", best="1")
    assert merge(others, new) == [new, others[1]]
    assert merge(others, ROW) == [*others, ROW]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["-o", "a.csv"], "name run folders"),
        (["nowhere", "-o", "a.csv"], "nowhere is no run folder"),
        (["-o", "/dev/null/a.csv", "--page", "b.md"], "cannot be written"),
        (["-o", "a.csv", "--page", "b.md"], "b.md"),
    ],
)
def test_what_cannot_be_tabled(words: list[str], message: str, refuse: Refuse) -> None:
    assert message in refuse("results", *words)


def test_a_page_without_a_place(refuse: Refuse, tmp_path: Path) -> None:
    (tmp_path / "page.md").write_text("# Page\n")
    assert "has no comment <!-- results" in refuse("results", "-o", "a.csv", "--page", "page.md")
