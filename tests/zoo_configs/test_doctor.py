"""``bulletarm-zoo doctor`` looks at the learners, then at what ``bulletarm_gym.check`` looks at."""

from __future__ import annotations

import pytest

from bulletarm_gym.check import environments
from bulletarm_gym.check.machine import Finding
from zoo_configs.cli import main
from zoo_configs.measuring import health


@pytest.mark.parametrize("fails", [False, True])
def test_looks_at_the_learners_then_at_the_environments(
    fails: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = []

    def look_at(seconds: float) -> list[Finding]:
        asked.append(seconds)
        return [Finding("legs", "two", "walk", fails)]

    monkeypatch.setattr(environments, "check_environments", look_at)
    assert main(["doctor", "--seconds", "0.1"]) == (2 if fails else 0)
    out, err = capsys.readouterr()
    looked_at = [line[8:].partition(":")[0] for line in out.splitlines()]
    assert looked_at == ["learners", "PyTorch", "GPU", "legs", "-> walk"] and asked == [0.1]
    assert ("does not work here: legs\n" in err) == fails


def test_threads_are_advised_where_they_are_not_set(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.get_num_threads", lambda: 8)
    monkeypatch.setenv(environments.THREADS, "2")
    assert health.compute_threads() == Finding("PyTorch", "8 threads")
    monkeypatch.delenv(environments.THREADS)
    assert "--num-threads 1" in health.compute_threads().advice


def test_seconds_must_be_positive(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--seconds", "0"]) == 2
    assert "--seconds must be positive" in capsys.readouterr().err
