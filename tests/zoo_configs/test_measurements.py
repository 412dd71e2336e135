"""Files of measurements: what commands put into them, and where it comes from."""

from __future__ import annotations

import re
import shlex
import subprocess
from pathlib import Path

import pytest
import torch

from bulletarm_gym.check.machine import describe_processor
from zoo_configs.cli import main
from zoo_configs.errors import CommandError
from zoo_configs.measuring import provenance
from zoo_configs.measuring.data_files import EXPERTS, DataFile, number

REACHING = "BulletArm/CloseLoopBlockReaching-v0"


def expert_row(env: str, **changes: str) -> dict[str, str]:
    return {**dict.fromkeys(EXPERTS.columns, ""), "env": env, "robot": "kuka", "success": "1", **changes}


def test_a_row_takes_the_place_of_the_one_with_its_key(tmp_path: Path) -> None:
    file = DataFile(tmp_path / "data" / "experts.csv", EXPERTS)
    for row in (
        expert_row("A"),
        expert_row("B"),
        expert_row("A", robot="ur5"),
        expert_row("A", success="0.5"),
    ):
        file.add(row)
    found = [(row["env"], row["robot"], row["success"]) for row in file.read()]
    assert found == [("A", "kuka", "0.5"), ("B", "kuka", "1"), ("A", "ur5", "1")]
    assert [path.name for path in file.path.parent.iterdir()] == ["experts.csv"]


@pytest.mark.parametrize(
    "content", ["a,b\n1,2\n", ",".join(EXPERTS.columns) + "\nA,kuka\n", '"', "\xff"], ids=ascii
)
def test_a_foreign_file_is_refused_and_left_alone(content: str, tmp_path: Path) -> None:
    path = tmp_path / "experts.csv"
    path.write_bytes(content.encode("latin-1"))
    with pytest.raises(CommandError, match=r"--data: .*experts\.csv (is no such file|cannot be read)"):
        DataFile(path, EXPERTS).check("--data")
    assert path.read_bytes() == content.encode("latin-1")


def test_numbers_have_no_idle_digits() -> None:
    assert [number(value, 3) for value in (1.0, 0.5, 0.0, 0.1236, 100.0)] == ["1", "0.5", "0", "0.124", "100"]
    assert number(100.0, 0) == "100" and number(float("nan"), 2) == ""


def test_a_gpu_is_named_with_what_it_computes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: f"GPU {device.index or 0}")
    processor = describe_processor()
    machines = [provenance.provenance([], device)["machine"] for device in ("cpu", "cuda", "cuda:1")]
    assert machines == [processor, f"{processor}, GPU 0", f"{processor}, GPU 1"]


def test_check_keeps_what_the_expert_did(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The command that stands in a row makes the same row."""
    path = tmp_path / "experts.csv"
    kept = ["--data", str(path), "-f", str(tmp_path)]
    wanted = ["--env-kwargs", "robot:'ur5'", "obs_size:32"]
    assert main(["check", REACHING, "-n", "2", "--seed", "3", *wanted, *kept]) == 0
    [row] = DataFile(path, EXPERTS).read()
    named = [row[column] for column in (*EXPERTS.key, "episodes", "first_seed", "success", "mean_steps")]
    assert named == ["CloseLoopBlockReaching", "ur5", "obs_size:32", "", "2", "3", "1", "3"]
    assert row["machine"] == describe_processor() and row["commit"] == provenance.commit()
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", row["date"])
    program, *words = shlex.split(row["command"])
    assert program == "bulletarm-zoo" and str(tmp_path) not in row["command"]
    assert main([*words, *kept]) == 0
    assert DataFile(path, EXPERTS).read() == [row]


def test_the_commit_is_that_of_the_running_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def git(*words: str) -> str:
        who = ["-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false"]
        done = subprocess.run(
            ["git", "-C", str(tmp_path), *who, *words], check=True, capture_output=True, text=True
        )
        return done.stdout.strip()

    code = tmp_path / "provenance.py"
    code.write_text("1")
    monkeypatch.setattr(provenance, "HERE", code)
    commit = provenance.commit.__wrapped__
    assert commit().startswith("version ")  # no checkout
    git("init", "-q")
    git("commit", "-q", "--allow-empty", "-m", "someone's own repository, in whose folder the package lies")
    assert commit().startswith("version ")
    git("add", ".")
    git("commit", "-q", "-m", "ours")
    assert commit() == git("rev-parse", "--short=7", "HEAD")
    code.write_text("2")
    assert commit() == git("rev-parse", "--short=7", "HEAD") + "-dirty"
