"""``benchmark --ray``: on a cluster of several nodes on this machine."""

from __future__ import annotations

import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import sweeps
import yaml
from sweeps import FLAGS, TINY, is_running, jobs_of, same, start, wait_for

from zoo_configs.benchmarking import cluster
from zoo_configs.benchmarking.process import ExitCode
from zoo_configs.benchmarking.status import Overview
from zoo_configs.cli import main
from zoo_configs.errors import CommandError
from zoo_configs.training.state import State, run_status

pytest.importorskip("ray")
Bench = Callable[..., int]
pytestmark = pytest.mark.usefixtures("toys")
NODE = {"num_cpus": 1, "object_store_memory": 80 * 2**20, "memory": 4 * 10**9}
SLOW = {"tasks": ["CloseLoopToySlow", "CloseLoopToyFailing"], "seeds": 1, "baselines": ["sacfd", "sac"]}


@pytest.fixture(scope="module")
def ray_cluster() -> Iterator[Any]:
    """A head with one core; tests add other nodes."""
    from ray.cluster_utils import Cluster

    before = dict(os.environ)
    os.environ.update(PYTHONPATH=sweeps.PATH, RAY_DEDUP_LOGS="0")
    found = Cluster(initialize_head=True, head_node_args={**NODE, "include_dashboard": False})
    yield found
    found.shutdown()
    os.environ.clear()
    os.environ.update(before)


# ---- Checks of machines


def test_a_machine_must_read_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "SETTLING_SECONDS", 0.0)
    (tmp_path / "token").touch()
    versions = {name: metadata.version(name) for name in cluster.PACKAGES}
    assert cluster.find_fault(tmp_path, "token", "seen", (), versions) == ""
    assert (tmp_path / "seen").exists()
    assert str(tmp_path) in cluster.find_fault(tmp_path, "other", "seen", (), versions)
    assert "'frobnicate'" in cluster.find_fault(tmp_path, "token", "seen", ["frobnicate"], versions)
    others = {**versions, "torch": "0.1"}
    assert "torch" in (fault := cluster.find_fault(tmp_path, "token", "seen", (), others)) and "0.1" in fault


def test_a_machine_that_joins_late_must_read_it_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "SETTLING_SECONDS", 0.0)
    with pytest.raises(CommandError, match=socket.gethostname()):
        cluster.train(jobs_of()[0], tmp_path, "token")
    assert not list(tmp_path.iterdir())


def test_a_run_that_is_lost_again_and_again_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trained: list[Any] = []

    def lost(*arguments: Any) -> Any:
        trained.append(arguments)
        ended = {"wait": lambda _=None: True, "exit_code": lambda: ExitCode.INTERRUPTED}
        return SimpleNamespace(**ended, interrupt=lambda: None, kill=lambda: None)

    monkeypatch.setattr(cluster, "JobProcess", lost)
    monkeypatch.setattr(cluster, "MAX_STARTS", 3)
    (tmp_path / "token").touch()
    job = jobs_of()[0]
    codes = [cluster.train(job, tmp_path, "token") for _ in range(4)]
    assert codes == [ExitCode.INTERRUPTED] * 3 + [ExitCode.FAILED]
    assert len(trained) == 3
    assert "lost 3 times" in run_status(tmp_path / job.name).error  # type: ignore[union-attr]
    (tmp_path / job.name / "checkpoints" / "checkpoint_6").mkdir(parents=True)
    assert cluster.train(job, tmp_path, "token") == ExitCode.INTERRUPTED  # it has progressed


# ---- Clusters


def test_a_dead_address_is_reported_soon(
    bench: Bench, tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing listens on port 9; a listener that never answers is a hang."""
    monkeypatch.setattr(cluster, "CONNECTING_SECONDS", 6.0)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        for address in ("127.0.0.1:9", f"127.0.0.1:{silent.getsockname()[1]}"):
            begin = time.monotonic()
            assert bench("--ray", address) == 2
            assert address in capsys.readouterr().err
            assert time.monotonic() - begin < 30.0
    assert not (tmp_path / "out").exists()


def test_a_share_that_no_machine_has(ray_cluster: Any, bench: Bench, tmp_path: Path, capsys: Any) -> None:
    assert bench("--ray", ray_cluster.address, "--memory", "1000") == 2
    told = capsys.readouterr().err.splitlines()[-1]
    assert "CloseLoopToy/sacfd/seed_0: 1 CPU, 0 GPU, 1000.0 GB" in told
    assert not (tmp_path / "out").exists()


def test_a_node_killed_in_the_middle_loses_nothing(
    ray_cluster: Any, bench: Bench, tmp_path: Path, capsys: Any
) -> None:
    node, out = ray_cluster.add_node(**NODE), tmp_path / "out"

    def kill() -> None:
        """As soon as every node trains, the second is gone."""
        wait_for(lambda: len(list(out.glob("CloseLoopToySlow/*/*/checkpoints/checkpoint_*"))) > 0)
        wait_for(lambda: len(list(out.glob("CloseLoopToySlow/*/*/state.yml"))) > 1)
        ray_cluster.remove_node(node, allow_graceful=False)

    killer = threading.Thread(target=kill)
    killer.start()
    plan = {**SLOW, "options": {**TINY["options"], "n_timesteps": 48}}
    assert bench("--ray", ray_cluster.address, **plan) == 2
    killer.join()
    assert "2 done, 0 running, 0 waiting, 2 failed" in capsys.readouterr().out.splitlines()
    assert run_status(out / "CloseLoopToyFailing/sac/seed_0").state is State.FAILED  # type: ignore[union-attr]
    assert not list(out.glob(".benchmark-*"))
    # What is done is the same as without a cluster, and is not done again
    (tmp_path / "tiny.yml").write_text(yaml.safe_dump({**TINY, **plan, "tasks": ["CloseLoopToySlow"]}))
    here = ["benchmark", str(tmp_path / "tiny.yml"), *FLAGS, "-j", "2", "-f"]
    assert main([*here, str(tmp_path / "whole")]) == 0
    for baseline in ("sac", "sacfd"):
        name = f"CloseLoopToySlow/{baseline}/seed_0"
        assert same(out / name, tmp_path / "whole" / name)
    assert main([*here, str(out)]) == 0
    assert "2 done, 0 running, 0 waiting" in capsys.readouterr().err


@pytest.mark.slow
def test_who_calls_may_be_interrupted_or_killed(ray_cluster: Any, bench: Bench, tmp_path: Path) -> None:
    out, plan = tmp_path / "out", {**TINY, "tasks": ["CloseLoopToySlow"], "baselines": ["sacfd", "sac"]}
    for how, code in ((signal.SIGINT, 130), (signal.SIGKILL, -9)):
        caller = start(tmp_path, plan, "--ray", ray_cluster.address)
        wait_for(lambda: any(is_running(folder) for folder in out.glob("*/*/seed_*")))
        caller.send_signal(how)
        assert caller.wait(120) == code
        wait_for(lambda: not any(is_running(folder) for folder in out.glob("*/*/seed_*")))
    assert bench("--ray", ray_cluster.address, **plan) == 0


@pytest.mark.slow
def test_two_hundred_runs_while_nodes_are_lost(ray_cluster: Any, bench: Bench, tmp_path: Path) -> None:
    keys = {"seeds": 50, "tasks": ["CloseLoopToy", "CloseLoopToyFailing"], "baselines": ["sacfd", "sac"]}
    nodes = [ray_cluster.add_node(**NODE) for _ in range(3)]

    def lose() -> None:
        for number, node in enumerate(nodes, start=1):
            at = 20 * number
            wait_for(lambda at=at: len(list(tmp_path.glob("out/*/*/*/BulletArm-*.zip"))) >= at, 3600)
            ray_cluster.remove_node(node, allow_graceful=False)

    loser = threading.Thread(target=lose)
    loser.start()
    assert bench("--ray", ray_cluster.address, **keys) == 2  # half of them fail
    loser.join()
    overview = Overview(jobs_of(**keys), tmp_path / "out")
    overview.update()
    assert overview.counts() == "100 done, 0 running, 0 waiting, 100 failed"
