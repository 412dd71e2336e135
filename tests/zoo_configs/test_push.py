"""Agents go to the hub, or into a folder, with a card; the hub is not the real one."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import pytest
import yaml

from zoo_configs.cli import main
from zoo_configs.publishing.published import read_card

Refuse = Callable[..., str]
FILE = "sacfd-BulletArm-CloseLoopToy-v0.zip"
SNIPPET = re.compile(r"```python\n(.*?)```", re.DOTALL)


class Hub:
    """What ``huggingface_hub.HfApi`` would be asked."""

    uploaded: ClassVar[dict[str, Any]] = {}
    reachable = True

    def __init__(self, token: str) -> None:
        self.token = token

    def whoami(self) -> dict[str, str]:
        if not self.reachable:
            raise ConnectionError("Name or service not known")
        return {"name": "someone"}

    def create_repo(self, repo_id: str, exist_ok: bool) -> str:
        assert exist_ok
        return f"https://huggingface.co/{repo_id}"

    def upload_folder(self, repo_id: str, folder_path: Path, commit_message: str) -> None:
        files = {path.name: path.read_bytes() for path in Path(folder_path).iterdir()}
        self.uploaded.update(repo_id=repo_id, message=commit_message, files=files)


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch) -> type[Hub]:
    monkeypatch.setenv("HF_TOKEN", "hf_secret")
    monkeypatch.setattr("huggingface_hub.HfApi", Hub)
    monkeypatch.setattr(Hub, "uploaded", {})
    return Hub


@pytest.fixture(scope="module")
def pushed(run_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("agents") / "toy"
    words = ["push", str(run_folder), "--folder", str(folder), "-n", "4", "--device", "cpu"]
    assert main([*words, "--no-progress"]) == 0
    return folder


def test_a_folder_holds_agent_card_and_page(pushed: Path) -> None:
    assert {path.name for path in pushed.iterdir()} == {FILE, "card.json", "README.md"}
    assert [path.name for path in pushed.parent.iterdir()] == ["toy"]  # nothing half-written


def test_a_card_says_what_was_measured(pushed: Path, toy_id: str) -> None:
    card = json.loads((pushed / "card.json").read_text())
    assert card["env"] == toy_id
    assert card["env_kwargs"] == {"action_sequence": "pxyzr", "obs_size": 48}
    assert (card["baseline"], card["algo"], card["preset"]) == ("equi_sacfd", "sacfd", "quick")
    assert (card["seed"], card["episodes"]) == (0, 4)
    assert len(card["outcomes"]) == 4
    assert card["success"] == card["outcomes"].count("1") / 4
    assert card["interval"][0] <= card["success"] <= card["interval"][1]
    assert card["evaluations"]["timesteps"] == [0, 6, 12]
    assert card["versions"]["torch"]
    assert card["command"].startswith("bulletarm-zoo train ")
    assert card["date"] <= card["measured"]["date"]


def test_the_card_agrees_with_enjoy(
    pushed: Path, run_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said = []
    for source in ("--published", str(pushed)), (str(run_folder),):
        assert main(["enjoy", *source, "-n", "4", "--device", "cpu"]) == 0
        said.append(capsys.readouterr().out.splitlines()[-1])
    assert said[0] == f"success_rate={read_card(pushed).success:.2f} episodes=4"
    assert said[1] == said[0]


def test_the_page_has_huggingfaces_head(pushed: Path, toy_id: str) -> None:
    _, head, _ = (pushed / "README.md").read_text().split("---\n", 2)
    metadata = yaml.safe_load(head)
    assert metadata["library_name"] == "stable-baselines3"
    assert {toy_id, "reinforcement-learning", "stable-baselines3"} <= set(metadata["tags"])
    [result] = metadata["model-index"][0]["results"]
    measured = {metric["type"]: metric["value"] for metric in result["metrics"]}
    assert measured["success_rate"] == read_card(pushed).success
    assert "+/-" in measured["mean_reward"]


def test_the_snippet_of_the_page_runs(
    pushed: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(pushed)
    [snippet] = SNIPPET.findall((pushed / "README.md").read_text())
    exec(compile(snippet, "README.md", "exec"), {})
    assert capsys.readouterr().out.split()[-1] in ("True", "False")


def test_an_agent_is_filmed_from_its_folder(pushed: Path, tmp_path: Path) -> None:
    film = tmp_path / "film.gif"
    assert main(["record", "--published", str(pushed), "-n", "1", "-o", str(film), "--device", "cpu"]) == 0
    assert film.stat().st_size > 0


def test_an_upload_holds_the_folder_and_a_film(run_folder: Path, hub: type[Hub]) -> None:
    words = ["push", str(run_folder), "-orga", "arms", "-m", "A toy", "-n", "2", "--device", "cpu"]
    assert main(words) == 0
    assert hub.uploaded["repo_id"] == "arms/equi_sacfd-BulletArm-CloseLoopToy-v0"
    assert hub.uploaded["message"] == "A toy"
    files = hub.uploaded["files"]
    assert set(files) == {FILE, "card.json", "README.md", "replay.mp4"}
    assert f'load_from_hub("{hub.uploaded["repo_id"]}", "{FILE}")' in files["README.md"].decode()


def test_an_upload_can_be_named_and_go_without_a_film(
    run_folder: Path, hub: type[Hub], capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["push", str(run_folder), "-orga", "arms", "-name", "toy", "--no-render", "-n", "1"]
    assert main([*words, "--device", "cpu", "--load-last"]) == 0
    assert "Uploaded to https://huggingface.co/arms/toy" in capsys.readouterr().out
    assert set(hub.uploaded["files"]) == {FILE, "card.json", "README.md"}
    assert json.loads(hub.uploaded["files"]["card.json"])["model"] == "last"


def test_an_agent_is_replaced_and_nothing_else(pushed: Path, run_folder: Path, tmp_path: Path) -> None:
    folder = tmp_path / "toy"
    shutil.copytree(pushed, folder)
    (folder / "old.txt").touch()
    assert main(["push", str(run_folder), "--folder", str(folder), "-n", "1", "--device", "cpu"]) == 0
    assert {path.name for path in folder.iterdir()} == {FILE, "card.json", "README.md"}
    assert read_card(folder).episodes == 1


def test_weights_that_change_too_much_are_not_halved(
    run_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The written file fails always, the run's own model never."""
    from zoo_configs.publishing import packing

    def evaluate(agent: Any, options: Any) -> Any:
        rounded = agent.model.actor.mu.linear.weights["0_0"]
        halved = bool((rounded == rounded.half().float()).all())
        return packing.Outcome([not halved] * 20, [0.0] * 20)

    monkeypatch.setattr(packing, "evaluate_agent", evaluate)
    assert main(["push", str(run_folder), "--folder", str(tmp_path / "toy"), "--device", "cpu"]) == 0
    assert "the weights are stored in float32" in capsys.readouterr().out
    card = read_card(tmp_path / "toy")
    assert (card.weights, card.success) == ("float32", 1.0)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["RUN"], "either --organization or --folder"),
        (["RUN", "-orga", "a", "--folder", "b"], "either --organization or --folder"),
        (["RUN", "--folder", "b", "-name", "c"], "--repo-name"),
        (["nowhere", "--folder", "b"], "nowhere is not a run folder"),
        (["--env", "TOY", "--baseline", "sac", "--folder", "b"], "no run of sac"),
        (["RUN", "--folder", "RUN"], "card.json"),
        (["RUN", "--folder", "/dev/null/b"], "cannot be written"),
        (["RUN", "-orga", "a/b"], "--organization"),
        (["RUN", "-orga", "arms", "-n", "0"], "at least 1"),
    ],
)
def test_what_cannot_be_pushed(
    words: list[str], message: str, run_folder: Path, refuse: Refuse, hub: type[Hub]
) -> None:
    assert message in refuse("push", *(str(run_folder) if word == "RUN" else word for word in words))


def test_no_token(
    run_folder: Path,
    refuse: Refuse,
    tmp_path_factory: pytest.TempPathFactory,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("huggingface_hub.get_token", lambda: None)
    assert "no token of the Hugging Face hub" in refuse("push", str(run_folder), "-orga", "arms")


def test_no_network(
    run_folder: Path, refuse: Refuse, hub: type[Hub], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hub, "reachable", False)
    line = refuse("push", str(run_folder), "-orga", "arms")
    assert "the Hugging Face hub cannot be used" in line
    assert not hub.uploaded


def test_an_agent_behind_wrappers_is_refused(run_folder: Path, refuse: Refuse, tmp_path_factory: Any) -> None:
    copy = tmp_path_factory.mktemp("logs") / run_folder.name
    shutil.copytree(run_folder, copy)
    content = yaml.safe_load((copy / "hyperparams.yml").read_text())
    content["BulletArm/CloseLoopToy-v0"]["frame_stack"] = 2
    (copy / "hyperparams.yml").write_text(yaml.safe_dump(content))
    assert "frame_stack" in refuse("push", str(copy), "--folder", "b")
