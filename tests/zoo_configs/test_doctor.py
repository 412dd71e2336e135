"""``bulletarm-zoo doctor`` tells what is well, and what to do about the rest."""

from __future__ import annotations

import pytest

from zoo_configs.cli import main
from zoo_configs.environments import register_environments
from zoo_configs.measuring import health
from zoo_configs.measuring.machine import Yardstick
from zoo_configs.measuring.throughput import Throughput


def test_looks_at_everything(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--seconds", "0.1"]) == 0
    said = capsys.readouterr().out
    looked_at = [line.split(":")[0].split()[-1] for line in said.splitlines() if "->" not in line]
    environments = [env_id.rpartition("/")[2] for env_id in (health.CLOSE_LOOP, health.OPEN_LOOP)]
    before = ["versions", "processor", "threads", "GPU", "display"]
    assert looked_at == [*before, *health.ARMS, "cache", *environments]
    assert said.count("picked a block in") == len(health.ARMS)


def test_what_does_not_work_fails(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def look_at(_: float) -> list[health.Finding]:
        return [health.Finding("legs", "two"), health.arm("octopus")]

    monkeypatch.setattr(health, "look_at", look_at)
    assert main(["doctor"]) == 2
    out, err = capsys.readouterr()
    assert out.startswith("ok      legs: two\nFAILED  octopus: ") and "got 'octopus'" in out
    assert err.endswith("does not work here: octopus\n")


def test_threads_are_advised_where_they_are_not_set(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.get_num_threads", lambda: 8)
    monkeypatch.setenv(health.THREADS, "2")
    assert health.threads() == health.Finding("threads", "8 of PyTorch, OMP_NUM_THREADS=2")
    monkeypatch.delenv(health.THREADS)
    assert "export OMP_NUM_THREADS=1" in health.threads().advice


def test_a_busy_machine_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    for load, is_told in ((0.0, False), (1e6, True)):
        monkeypatch.setattr("os.getloadavg", lambda load=load: (load, load, load))
        assert bool(health.processor().advice) == is_told


@pytest.mark.parametrize(("step_ms", "is_slow"), [(0.01, False), (1000.0, True)])
def test_speed_is_beside_the_yardstick(step_ms: float, is_slow: bool) -> None:
    times = {"expert_ms": 0.0, "physics_ms": 0.0, "rendering_ms": 0.0, "reset_ms": 1.0}
    measured = Throughput(health.CLOSE_LOOP, Yardstick(50.0, 1.0), 10, 1, 1.0, step_ms, **times)
    assert bool(health.speed(measured).advice) == is_slow


def test_compiled_code_without_a_cache_is_advised(monkeypatch: pytest.MonkeyPatch) -> None:
    register_environments()
    assert health.arm("kuka").value.startswith("picked a block")
    kept = health.compiled_code()
    assert kept.what == "numba cache" and "read" in kept.value
    monkeypatch.setattr(health, "_compiled_functions", lambda: iter(()))
    assert "NUMBA_CACHE_DIR" in health.compiled_code().advice


def test_seconds_must_be_positive(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--seconds", "0"]) == 2
    assert "--seconds must be positive" in capsys.readouterr().err
