"""Machine and commit of a result."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
import torch

from bulletarm_gym.check.machine import describe_processor
from zoo_configs import provenance


def test_a_gpu_is_named_with_what_it_computes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: f"GPU {device.index or 0}")
    processor = describe_processor()
    machines = [provenance.describe_hardware(device) for device in ("cpu", "cuda", "cuda:1")]
    assert machines == [processor, f"{processor}, GPU 0", f"{processor}, GPU 1"]


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
