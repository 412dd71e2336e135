"""Tasks and rewards of a user, in the folder that a command is called in."""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Callable, Iterator
from pathlib import Path

import gymnasium as gym
import pytest
import yaml

from zoo_configs.cli import main

Train = Callable[..., int]
MODULE = "my_own_tasks"
ENV_ID = "BulletArm/CloseLoopOwnReaching-v0"
TASKS = """
    import bulletarm_gym
    from bulletarm_gym.tasks.picking import BlockReaching

    class OwnReaching(BlockReaching):
        pass

    def steps(scene, outcome):
        return -1.0

    bulletarm_gym.register_task("OwnReaching", OwnReaching)
"""


def forget() -> None:
    """As in a new process."""
    gym.registry.pop(ENV_ID, None)
    sys.modules.pop(MODULE, None)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The working directory, with the module in it."""
    (tmp_path / f"{MODULE}.py").write_text(textwrap.dedent(TASKS))
    monkeypatch.chdir(tmp_path)
    forget()
    yield tmp_path
    forget()
    assert str(tmp_path) not in sys.path


@pytest.mark.parametrize("by_id", [False, True], ids=["--gym-packages", "package:id"])
def test_a_run_remembers_where_its_task_comes_from(
    by_id: bool, folder: Path, train_tiny: Train, capsys: pytest.CaptureFixture[str]
) -> None:
    named = ["--env", f"{MODULE}:{ENV_ID}"] if by_id else ["--env", ENV_ID, "--gym-packages", MODULE]
    assert train_tiny(folder / "logs", *named, "--baseline", "sacfd", "--eval-episodes", "1") == 0
    [run] = (folder / "logs" / "sacfd").iterdir()
    assert yaml.safe_load((run / "hyperparams.yml").read_text())["run"]["gym_packages"] == [MODULE]
    acting = ["-n", "1", "--device", "cpu"]
    assert main(["push", str(run), "--folder", "agent", "-n", "1"]) == 0
    assert f"import {MODULE}" in (folder / "agent" / "README.md").read_text()
    forget()
    assert main(["enjoy", "--published", "agent", *acting]) == 0
    for command in (
        ["enjoy", str(run), *acting],
        ["enjoy", "--env", ENV_ID, "--baseline", "sacfd", *acting, "--n-envs", "1" if by_id else "2"],
        ["record", str(run), *acting, "-o", "film.gif"],
        ["train", "--resume", str(run), "-n", "20", "--no-progress"],
    ):
        forget()
        assert main(command) == 0, capsys.readouterr().err


def test_commands_find_tasks_and_rewards(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small = ["--env-kwargs", "obs_size:32"]
    assert main(["demos", "--env", f"{MODULE}:{ENV_ID}", "-n", "1", *small]) == 0
    forget()
    reaching = "BulletArm/CloseLoopBlockReaching-v0"
    rewarded = [*small, f"reward:'{MODULE}:steps'"]
    assert main(["demos", "--env", reaching, "-n", "1", *rewarded]) == 0
    assert main(["list", "--env", f"{MODULE}:{ENV_ID}"]) == 0
    capsys.readouterr()
    assert main(["demos", "--env", reaching, "-n", "1", *small, f"reward:'{MODULE}:stepz'"]) == 2
    assert "stepz" in capsys.readouterr().err


def test_a_module_that_fails_is_told(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / f"{MODULE}.py").write_text("def")
    assert main(["enjoy", "--gym-packages", MODULE]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert f"package '{MODULE}' cannot be imported: SyntaxError: invalid syntax" in line
