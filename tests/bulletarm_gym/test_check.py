"""``python -m bulletarm_gym.check`` reports findings with advice."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from bulletarm_gym.check import __main__ as command
from bulletarm_gym.check import environments
from bulletarm_gym.check.machine import Finding
from bulletarm_gym.robots import ROBOTS

ROOT = Path(__file__).parents[2]


def test_looks_at_everything_without_the_learners() -> None:
    """In a process of its own, in which nothing but the environments can be imported."""
    code = (
        "import sys; blocked = ('torch', 'stable_baselines3', 'rl_zoo3', 'zoo_configs', 'sb3_extensions');"
        "sys.modules.update(dict.fromkeys(blocked));"
        "from bulletarm_gym.check.__main__ import main; sys.exit(main(['--seconds', '0.1']))"
    )
    result = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stderr
    looked_at = [line.split(":")[0].split()[-1] for line in result.stdout.splitlines() if "->" not in line]
    names = [env_id.rpartition("/")[2] for env_id in environments.MAX_RATIO]
    before = ["versions", "processor", "threads", "display"]
    assert looked_at == [*before, *ROBOTS, "cache", *names]
    assert result.stdout.count("picked a block in") == len(ROBOTS)


def test_what_does_not_work_fails(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def look_at(_: float) -> list[Finding]:
        return [Finding("legs", "two"), environments.robot("octopus")]

    monkeypatch.setattr(command, "check_environments", look_at)
    assert command.main([]) == 2
    out, err = capsys.readouterr()
    assert out.startswith("ok      legs: two\nFAILED  octopus: ") and "got 'octopus'" in out
    assert "octopus" in err


def test_threads_are_advised_where_they_are_not_set(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(environments.THREADS, "2")
    assert environments.threads() == Finding("threads", "OMP_NUM_THREADS=2")
    monkeypatch.delenv(environments.THREADS)
    assert "export OMP_NUM_THREADS=1" in environments.threads().advice


def test_a_busy_machine_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    for load, is_told in ((0.0, False), (1e6, True)):
        monkeypatch.setattr("os.getloadavg", lambda load=load: (load, load, load))
        assert bool(environments.processor().advice) == is_told


@pytest.mark.parametrize(("step_ms", "is_slow"), [(0.01, False), (1000.0, True)])
def test_speed_is_beside_the_yardstick(step_ms: float, is_slow: bool) -> None:
    found = environments.speed(environments.CLOSE_LOOP, step_ms, 50.0)
    assert f"{step_ms * 20:.0f} simulation steps" in found.value
    assert bool(found.advice) == is_slow


def test_compiled_code_without_a_cache_is_advised(monkeypatch: pytest.MonkeyPatch) -> None:
    assert environments.robot("kuka").value.startswith("picked a block")
    kept = environments.compiled_code()
    assert kept.what == "numba cache" and "read" in kept.value
    monkeypatch.setattr(environments, "_compiled_functions", lambda: iter(()))
    assert "NUMBA_CACHE_DIR" in environments.compiled_code().advice


@pytest.mark.parametrize("seconds", ["0", "nan", "inf"])
def test_seconds_must_be_positive(seconds: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        command.main(["--seconds", seconds])
    assert "--seconds must be positive" in capsys.readouterr().err
