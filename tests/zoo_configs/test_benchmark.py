"""``benchmark``: experiments, sizes and status, runs in processes of this machine and on a Ray cluster."""

import os
import random
import signal
import socket
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import sweeps
import yaml
from sweeps import TINY, is_running, jobs_of, same, start, wait_for

from bulletarm_gym.benchmarks import BENCHMARKS
from zoo_configs.benchmarking import cluster
from zoo_configs.benchmarking.plan import Plan, build_jobs, read_plan
from zoo_configs.benchmarking.process import ExitCode
from zoo_configs.benchmarking.run import Overview, shown, size_of
from zoo_configs.errors import CommandError
from zoo_configs.provenance import versions
from zoo_configs.training.runs import find_runs, write_resolved
from zoo_configs.training.state import State, run_lock, run_status, set_status
from zoo_configs.training.train import train_run

PICKING, HERE = "BulletArm/CloseLoopBlockPicking-v0", Path()
EXAMPLES = sorted((sweeps.ROOT / "examples" / "benchmarks").glob("*.yml"))
pytestmark = pytest.mark.usefixtures("toys")


def test_files_of_the_examples_are_plans():
    for path in EXAMPLES:
        plan = read_plan(str(path))
        assert {job.experiment.label for job in build_jobs(plan, path)} == set(plan.baselines), path


def test_the_benchmarks_of_the_paper_have_its_baselines():
    plan = read_plan("close_loop_4d")
    assert (len(plan.tasks), len(plan.baselines), plan.seeds) == (10, 11, 4)
    jobs = build_jobs(plan, HERE)
    assert len(jobs) == 10 * 11 * 4 and "equi_tqc" not in plan.baselines
    assert {job.experiment.benchmark for job in jobs} == {"close_loop_4d"}
    assert str(jobs[0].folder) == "CloseLoopBlockReaching/sac/seed_0"
    six = read_plan("open_loop_6d")
    assert (len(six.tasks), len(six.baselines)) == (9, 8)


def test_a_plan_names_tasks_and_baselines_by_patterns():
    plan = Plan([PICKING, "CloseLoopBlockReaching", "CloseLoop*Pu[ls]*"], ["*equi_sacfd", "sac"], seeds=[3])
    assert {str(job.folder) for job in build_jobs(plan, HERE)} == {
        f"CloseLoopBlock{task}/{baseline}/seed_3"
        for task in ("Picking", "Reaching", "Pushing", "Pulling")
        for baseline in ("equi_sacfd", "sac")
    }
    plan = Plan(["OpenLoopBlockStacking", "OpenLoopRampBlockStacking"], ["sdqfd_*cnn_asr*"], seeds=1)
    rows = [str(job.folder.parent) for job in build_jobs(plan, HERE)]
    assert rows == ["OpenLoopBlockStacking/sdqfd_cnn_asr", "OpenLoopRampBlockStacking/sdqfd_cnn_asr_6d"]
    plan = replace(read_plan("close_loop_4d"), tasks=["CloseLoopBlock*"], baselines=["sacfd"], seeds=1)
    known = {row.env_id for row in BENCHMARKS["close_loop_4d"].environments if "LoopBlock" in row.env_id}
    assert {job.experiment.env_id for job in build_jobs(plan, HERE)} == known
    for job in build_jobs(Plan(["toy_tasks:CloseLoopToy", "toy_tasks:*Toy"], ["sacfd"], seeds=1), HERE):
        assert job.experiment.env_id == "BulletArm/CloseLoopToy-v0" and job.gym_packages == ("toy_tasks",)


def test_each_baseline_has_one_run_a_variant():
    variants = {"whole": {}, "one_step": {"n_steps": 1}}
    plan = Plan([PICKING], ["sacfd"], "cpu", 1, hyperparams={"gamma": 0.5}, variants=variants)
    jobs = build_jobs(plan, HERE)
    found = [(job.folder.parent.name, job.experiment.hyperparams) for job in jobs]
    returns = [(name, hyperparams["n_steps"], hyperparams["gamma"]) for name, hyperparams in found]
    assert returns == [("sacfd-whole", 10, 0.5), ("sacfd-one_step", 1, 0.5)]


def test_runs_that_start_together_do_not_share_demonstrations():
    jobs = jobs_of(HERE, baselines=["sacfd", "sac"], tasks=["CloseLoopToy", "CloseLoopToySlow"])
    keys = [(job.experiment.env_id, job.seed) for job in jobs]
    assert len(set(keys[:4])) == len(set(keys[4:])) == 4


def test_a_dry_run_lists_sizes_and_writes_nothing(bench, tmp_path, capsys):
    for flag in "--seeds", "--seed":
        assert bench("--dry-run", flag, "0", "7", baselines=["sacfd", "sac"]) == 0
        lines = capsys.readouterr().out.splitlines()
        assert lines[1].split()[:4] == ["CloseLoopToy/sac", "0", "7", "1.0"]
        assert lines[3].startswith("2 experiments, 4 runs") and not (tmp_path / "out").exists()
    for kwargs in None, "dict()":
        assert bench("--dry-run", hyperparams={**TINY["hyperparams"], "replay_buffer_kwargs": kwargs}) == 0
    [job] = build_jobs(Plan(["CloseLoopBlockPulling"], ["sacfd"], seeds=1), HERE)
    size = size_of(job)
    assert 0.12 < size.memory - 1.0 < 0.13  # 30,000 heightmaps of 64 x 64 bytes
    assert size.disk == 0.0 or size.disk == pytest.approx(3 * (size.memory - 1.0))


def test_a_folder_that_is_locked_or_has_other_runs_is_refused(bench, tmp_path, capsys):
    write_resolved(*jobs_of(tmp_path / "out", seeds=1))
    assert bench(hyperparams={**TINY["hyperparams"], "gamma": 0.5}) == 2
    assert "hyperparams" in capsys.readouterr().err
    for name in "n_timesteps", "eval_freq", "eval_episodes", "n_eval_envs":
        assert bench("--dry-run", options={**TINY["options"], name: 30}) == 2
        assert f"{name} " in capsys.readouterr().err
    assert bench("--dry-run", options={**TINY["options"], "verbose": 1}) == 0
    with run_lock(tmp_path / "out"):
        assert bench() == 2
    assert str(tmp_path / "out") in capsys.readouterr().err


def test_the_overview_is_read_from_the_folders(tmp_path, capsys):
    jobs = jobs_of(tmp_path, seeds=3)
    running, failed, _ = (job.folder for job in jobs)
    set_status(failed, State.FAILED, "the block is lost")
    running.mkdir()
    overview = Overview(jobs, tmp_path)
    with run_lock(running), shown(overview, progress=True) as look:
        np.savez(running / "evaluations.npz", timesteps=[6], results=[[0.0, 1.0]], successes=[[0.0, 1.0]])
        look()
        assert overview.counts() == "0 done, 1 running, 1 waiting, 1 failed"
    printed = capsys.readouterr().err
    assert "running CloseLoopToy/sacfd/seed_0, success 0.50 at 6" in printed and "1 waiting" in printed
    assert "failed CloseLoopToy/sacfd/seed_1, the block is lost" in printed
    set_status(running, State.FAILED, "a run that is done stays done")
    overview.update()
    assert overview.counts() == "1 done, 0 running, 1 waiting, 1 failed"


def test_a_run_has_one_process_at_a_time(tmp_path):
    with run_lock(tmp_path):
        assert run_status(tmp_path).state is State.RUNNING
        with pytest.raises(CommandError, match="process"), run_lock(tmp_path):
            pass
    assert run_status(tmp_path).state is State.DONE
    with pytest.raises(RuntimeError), run_lock(tmp_path):
        try:
            raise KeyboardInterrupt
        finally:
            raise RuntimeError("unexpected pos 64 vs 0")  # as from torch.save during Ctrl-C
    assert run_status(tmp_path).state is State.KILLED
    (tmp_path / "state.yml").write_text("state: dancing")
    with pytest.raises(CommandError, match=r"state\.yml"):
        run_status(tmp_path)


def test_the_time_of_a_killed_process_counts_up_to_the_checkpoint(tmp_path):
    with run_lock(tmp_path):
        (checkpoint := tmp_path / "checkpoint").mkdir()
    how = run_status(tmp_path)
    assert how.until == how.since + how.seconds
    how = how._replace(state=State.RUNNING, until=0.0, seconds=5.0)
    os.utime(checkpoint, (how.since + 100.0, how.since + 100.0))
    (tmp_path / "state.yml").write_text(yaml.safe_dump({**how._asdict(), "state": how.state.value}))
    with run_lock(tmp_path, checkpoint):
        assert run_status(tmp_path).seconds == pytest.approx(105.0)
    # Ctrl-C after 300 s: what follows the checkpoint is trained again.
    ended = how._replace(state=State.KILLED, until=how.since + 300.0, seconds=305.0)
    for last, expected in ((checkpoint, 105.0), (None, 0.0)):
        (tmp_path / "state.yml").write_text(yaml.safe_dump({**ended._asdict(), "state": "killed"}))
        with run_lock(tmp_path, last):
            assert run_status(tmp_path).seconds == pytest.approx(expected)


def test_runs_that_fail_do_not_stop_the_others(bench, tmp_path, capsys):
    tasks = ["CloseLoopToyFailing", "CloseLoopToyCrashing", "CloseLoopToy"]
    failing, crashing, good = (tmp_path / "out" / task / "sacfd" / "seed_0" for task in tasks)

    def times():
        return [(folder / "state.yml").stat().st_mtime_ns for folder in (failing, crashing, good)]

    assert bench("-j", "2", tasks=tasks, seeds=1) == 2
    out, err = capsys.readouterr()
    assert out.splitlines()[0] == "1 done, 0 running, 0 waiting, 2 failed"
    assert "2 of 3 runs failed" in err.splitlines()[-1] and "CloseLoopToyFailing/" in err.splitlines()[-1]
    assert "the block is lost" in run_status(failing).error and "SIGSEGV" in run_status(crashing).error
    assert "RuntimeError: the block is lost" in (failing / "log.txt").read_text()
    before = times()
    assert bench("-j", "2", tasks=tasks, seeds=1) == 2
    assert times() == before  # failed runs are repeated with --retry-failed only
    assert bench("--retry-failed", "--env", "CloseLoopToyFailing", tasks=tasks, seeds=1) == 2
    assert [old == new for old, new in zip(before, times(), strict=True)] == [False, True, True]


def test_a_full_disk_ends_the_benchmark_and_no_run(bench, tmp_path, capsys):
    assert bench("-j", "1", tasks=["CloseLoopToyFull"]) == 2
    assert str(tmp_path / "out") in capsys.readouterr().err.splitlines()[-1]
    out = tmp_path / "out"
    overview = Overview(jobs_of(out, tasks=["CloseLoopToyFull"]), out)
    overview.update()
    assert overview.counts() == "0 done, 0 running, 2 waiting, 0 failed"


@pytest.mark.parametrize(
    ("seed", "kills", "how"),
    [
        (0, 1, signal.SIGKILL),
        pytest.param(0, 1, signal.SIGINT, marks=pytest.mark.slow),
        *(pytest.param(seed, 5, signal.SIGKILL, marks=pytest.mark.slow) for seed in range(1, 6)),
    ],
)
def test_a_killed_benchmark_loses_nothing(seed, kills, how, bench, tmp_path):
    plan = {"tasks": ["CloseLoopToySlow"], "options": {**TINY["options"], "n_timesteps": 24}}
    plan |= {"seeds": 1} if kills == 1 else {"seeds": 2, "baselines": ["sacfd", "equi_sacfd"]}
    rng, out = random.Random(seed), tmp_path / "out"
    for _ in range(kills):
        process = start(tmp_path, {**TINY, **plan}, "-j", "2")
        wait_for(lambda: any(out.glob("*/*/*/log.txt")))
        time.sleep(rng.uniform(0.0, 4.0))
        process.send_signal(how)
        assert process.wait(90) == (130 if how is signal.SIGINT else -how)
        wait_for(lambda: not any(is_running(folder) for folder in out.glob("*/*/seed_*")))
    assert bench("-j", "2", **plan) == 0
    jobs = jobs_of(out, **plan)
    assert {run.folder for run in find_runs(out)} == {job.folder for job in jobs}
    for job, whole in zip(jobs, jobs_of(tmp_path / "whole", **plan), strict=True):
        assert job.status.state is State.DONE and same(job.folder, train_run(whole).folder)


NODE = {"num_cpus": 1, "object_store_memory": 80 * 2**20, "memory": 4 * 10**9}
SLOW = {"tasks": ["CloseLoopToySlow", "CloseLoopToyFailing"], "seeds": 1, "baselines": ["sacfd", "sac"]}


@pytest.fixture(scope="module")
def ray_cluster():
    """A head with one core; tests add other nodes."""
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    before = dict(os.environ)
    os.environ.update(PYTHONPATH=sweeps.PATH, RAY_DEDUP_LOGS="0")
    found = Cluster(initialize_head=True, head_node_args={**NODE, "include_dashboard": False})
    yield found
    found.shutdown()
    os.environ.clear()
    os.environ.update(before)


def test_a_machine_must_share_the_folder_and_the_versions(tmp_path, monkeypatch):
    monkeypatch.setattr(cluster, "SETTLING_SECONDS", 0.0)
    (tmp_path / "token").touch()
    cluster.check_machine(tmp_path / "token", (), versions())
    for token, packages, required, text in (
        ("other", (), versions(), str(tmp_path)),
        ("token", ["frobnicate"], versions(), "frobnicate"),
        ("token", (), {**versions(), "torch": "0.1"}, "torch .*0.1"),
    ):
        with pytest.raises(CommandError, match=text):
            cluster.check_machine(tmp_path / token, packages, required)
    with pytest.raises(CommandError, match=socket.gethostname()):
        cluster.train(jobs_of(tmp_path)[0], tmp_path / "other", tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["token"]


def test_a_run_that_is_lost_again_and_again_fails(tmp_path, monkeypatch):
    monkeypatch.chdir("/")

    def lost(*_):
        assert Path.cwd() == tmp_path  # that of the benchmark, for relative paths
        ended = {"wait": lambda _=None: True, "exit_code": lambda: ExitCode.INTERRUPTED}
        return SimpleNamespace(**ended, interrupt=lambda: None, kill=lambda: None)

    monkeypatch.setattr(cluster, "JobProcess", lost)
    monkeypatch.setattr(cluster, "MAX_STARTS", 3)
    (token := tmp_path / "token").touch()
    job = jobs_of(tmp_path)[0]
    codes = [cluster.train(job, token, tmp_path) for _ in range(4)]
    assert codes == [ExitCode.INTERRUPTED] * 3 + [ExitCode.FAILED]
    assert "3 times" in job.status.error
    (job.checkpoint_folder / "checkpoint_6").mkdir(parents=True)
    assert cluster.train(job, token, tmp_path / "missing") == ExitCode.INTERRUPTED  # it has progressed


def test_a_dead_address_is_reported_soon(bench, tmp_path, capsys, monkeypatch):
    """Of a listener that never answers: connecting hangs."""
    pytest.importorskip("ray")
    monkeypatch.setattr(cluster, "CONNECTING_SECONDS", 2.0)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"127.0.0.1:{silent.getsockname()[1]}"
        assert bench("--ray", address) == 2
    assert address in capsys.readouterr().err and not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_killed_caller_or_node_loses_nothing(ray_cluster, bench, tmp_path, capsys):
    assert bench("--ray", ray_cluster.address, "--memory", "1000") == 2  # more than any machine has
    assert "CloseLoopToy/sacfd/seed_0" in capsys.readouterr().err and not (tmp_path / "out").exists()
    out, plan = tmp_path / "out", {**SLOW, "options": {**TINY["options"], "n_timesteps": 48}}
    for how, code in ((signal.SIGINT, 130), (signal.SIGKILL, -9)):
        caller = start(tmp_path, {**TINY, **plan}, "--ray", ray_cluster.address)
        wait_for(lambda: any(is_running(folder) for folder in out.glob("*/*/seed_*")))
        caller.send_signal(how)
        assert caller.wait(120) == code
        wait_for(lambda: not any(is_running(folder) for folder in out.glob("*/*/seed_*")))
    node = ray_cluster.add_node(**NODE)

    def kill():
        """When every node trains."""
        wait_for(lambda: any(out.glob("CloseLoopToySlow/*/*/checkpoints/checkpoint_*")))
        wait_for(lambda: len(list(out.glob("CloseLoopToySlow/*/*/state.yml"))) > 1)
        ray_cluster.remove_node(node, allow_graceful=False)

    killer = threading.Thread(target=kill)
    killer.start()
    assert bench("--ray", ray_cluster.address, **plan) == 2
    killer.join()
    assert "2 done, 0 running, 0 waiting, 2 failed" in capsys.readouterr().out.splitlines()
    assert len(list(out.glob(".benchmark-*"))) <= 1  # of the killed caller
    plan |= {"tasks": ["CloseLoopToySlow"], "baselines": ["sacfd"]}
    [job], [whole] = (jobs_of(folder, **plan) for folder in (out, tmp_path / "whole"))
    assert same(job.folder, train_run(whole).folder)
