"""The pages that are made from the environments, without building the site."""

import itertools
import json
import re
from pathlib import Path

import pytest

import bulletarm_gym
from bulletarm_gym.config import PARAMETERS
from website import agents, figures, gallery, measured, task_page
from website.catalogue import SHOWN, grouped, relatives
from website.docstrings import LABELS
from website.markdown import table

BY_NAME = {one.name: one for one in SHOWN}
PICKING = "CloseLoopBlockPicking"
LINK = re.compile(r"\]\(([\w./-]+)(?:#([\w-]+))?\)")
CARD = {
    "env": f"BulletArm/{PICKING}-v0",
    "baseline": "equi_sacfd",
    "preset": "quick",
    "seed": 3,
    "success": 0.97,
    "episodes": 100,
    "interval": [0.916, 0.99],
    "command": "bulletarm-zoo train",
    "machine": "a laptop",
    "date": "2026-01-31",
    "commit": "0123456",
}


@pytest.fixture
def data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(measured, "DATA", tmp_path)
    monkeypatch.setattr(measured, "AGENTS", tmp_path / "published")
    return tmp_path


def test_every_environment_has_its_pictures() -> None:
    assert [one.entry.env_id for one in SHOWN] == list(bulletarm_gym.ENV_IDS)
    folder = measured.ROOT / "docs" / "images" / "tasks"
    wanted = {f"{one.picture}{suffix}.webp" for one in SHOWN for suffix in ("", "-heightmap")}
    assert {path.name for path in folder.iterdir()} == wanted


def test_home_counts_the_environments() -> None:
    home = (measured.ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    assert f"{len(bulletarm_gym.ENV_IDS)} tasks," in home


def test_gallery_leads_to_every_page_once() -> None:
    targets = re.findall(r"\]\((\w+)\.md\)", gallery.page())
    assert sorted(targets) == sorted(BY_NAME)
    shown = [one.stem for members in grouped().values() for one in members]
    assert len([*itertools.groupby(shown)]) == len(set(shown))  # a task's environments stand together


@pytest.mark.parametrize("name", BY_NAME)
def test_page_of_every_environment(name: str) -> None:
    one = BY_NAME[name]
    text = task_page.page(one)
    heads = re.findall(r"^## (.*)$", text, re.MULTILINE)
    assert heads[:4] == ["Task", "Observation", "Action", "Parameters"]
    assert one.entry.env_id in text and ":class:" not in text and ":attr:" not in text
    docs = measured.ROOT / "docs" / "tasks"
    for target, _ in LINK.findall(text):
        known = target.removesuffix(".md") in BY_NAME or (docs / target).resolve().exists()
        assert known, target


def test_page_tells_what_the_class_and_the_spaces_tell() -> None:
    text = task_page.page(BY_NAME["OpenLoopRampHouseBuilding2"])
    facts = BY_NAME["OpenLoopRampHouseBuilding2"].facts
    assert tuple(facts) == LABELS and "roof" in facts["Description"]
    assert "at least 4.2 cm" in facts["Randomisation"]  # from the class that it extends
    assert "`Box(0, 0.4, (3, 24, 24), float32)`" in text and "`Box(-1, 1, (7,), float32)`" in text
    assert "| 5 | `r` | tilt about its turned y axis | -0.785 rad (-45°) | 0.785 rad (45°) |" in text
    assert "| 0 | `p` | pick below 0, place from 0 on | pick | place |" in text
    assert all(f"| `{parameter}` |" in text for parameter in ("in_hand_size", "half_rotation"))
    assert "| `view` |" not in text and {"in_hand_size", "view"} <= set(PARAMETERS)


def test_parameters_tell_what_a_task_takes() -> None:
    text = task_page.page(BY_NAME["CloseLoopObjectGrasping"])
    assert re.search(r"\| `close_loop_tray` \| `True` \| .* \| True with this task: ", text)


def test_relatives_are_of_the_same_task() -> None:
    names = {other.name for other in relatives(BY_NAME["CloseLoopHouseBuilding"])}
    assert names == {"OpenLoopHouseBuilding1", "OpenLoopRampHouseBuilding1", "CloseLoopHouseBuilding1"}
    assert not relatives(BY_NAME["CloseLoopDrawerOpening"])


def test_figures_are_left_out_where_there_are_none(data: Path) -> None:
    assert not [*figures.expert(PICKING), *figures.speed(PICKING), *figures.agents(PICKING)]
    assert agents.filled("a\n<!-- agents: * -->\nb") == "a\n\nb"


def test_expert_and_speed_are_read_from_their_tables(data: Path) -> None:
    told = "a laptop,2026-01-31,0123456,bulletarm-zoo check"
    (data / "experts.csv").write_text(
        "env,robot,env_kwargs,snap,episodes,first_seed,success,mean_steps,machine,date,commit,command\n"
        f"{PICKING},panda,,,50,0,0.98,7.04,{told}\n{PICKING},kuka,,,200,0,1.0,7,{told}\n"
        f"{PICKING},kuka,obs_size:64,,10,0,0.9,,{told}\n{PICKING},kuka,,yes,10,0,0.4,,{told}\n"
        f"OpenLoopBinPacking,kuka,,,200,0,0.5,16,{told}\n"
    )
    (data / "speed.csv").write_text(
        f"env,steps_per_second,times_reference,machine,date,commit,command\n{PICKING},1234.5,29.31,{told}\n"
    )
    text = "\n".join(figures.expert(PICKING))
    assert text.index("| KUKA |  | 1.000 | 7.0 | 200 |") < text.index("| Panda |  | 0.98 | 7.0 | 50 |")
    assert "| KUKA | `obs_size:64` | 0.90 |  | 10 |" in text
    assert "0.40" not in text and "0.500" not in text and text.count("commit 0123456") == 1
    rate = "**1,234 steps a second** in one process, the expert acting, 29.3 times"
    assert rate in "\n".join(figures.speed(PICKING))


def test_agents_are_read_from_their_cards(data: Path) -> None:
    folder = data / "published" / PICKING / "equi_sacfd"
    folder.mkdir(parents=True)
    (folder / "card.json").write_text(json.dumps(CARD))
    text = "\n".join(figures.agents(PICKING))
    assert "success **0.97** over 100 episodes (0.92 to 0.99)" in text
    assert f"bulletarm-zoo enjoy --published BulletArm/{PICKING}-v0 --baseline equi_sacfd" in text
    assert not figures.agents("CloseLoopBlockPulling")
    link = f"[{PICKING}](../tasks/{PICKING}.md#trained-agents)"
    assert link in agents.filled("<!-- agents: sacfd, equi_* -->")
    assert agents.filled("<!-- agents: ferm_* -->") == ""


def test_cells_of_tables_stay_cells() -> None:
    assert (
        table(["a", "b"], [["x | y", "1\n2"]], numbers=1) == "| a | b |\n| --- | ---: |\n| x \\| y | 1 2 |\n"
    )
