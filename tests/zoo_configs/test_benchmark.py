"""``benchmark``: what its experiments are and cost, what it refuses, and runs in processes of this machine."""

from __future__ import annotations

import random
import re
import signal
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import yaml
from sweeps import FLAGS, TINY, is_running, jobs_of, same, start, wait_for

from bulletarm_gym.benchmarks import BENCHMARKS
from sb3_extensions.replay.buffer import ExpertReplayBuffer
from zoo_configs.benchmarking.plan import Plan, build_jobs, read_plan
from zoo_configs.benchmarking.process import ExitCode, JobProcess
from zoo_configs.benchmarking.run import size_of
from zoo_configs.benchmarking.status import Overview, Status, shown
from zoo_configs.cli import main
from zoo_configs.training.runs import find_runs
from zoo_configs.training.state import State, run_lock, run_status, set_status

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples" / "benchmarks"
PICKING = "BulletArm/CloseLoopBlockPicking-v0"
Bench = Callable[..., int]
pytestmark = pytest.mark.usefixtures("toys")
# ---- Cells


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.yml")), ids=lambda path: path.stem)
def test_files_of_the_examples_can_be_followed(path: Path) -> None:
    plan = read_plan(str(path))
    jobs = build_jobs(plan)
    assert {job.experiment.label for job in jobs} == set(plan.baselines)
    assert {f"BulletArm/{task}-v0" for task in plan.tasks} == {job.experiment.env_id for job in jobs}


def test_the_papers_benchmarks_have_its_rows() -> None:
    plan = read_plan("close_loop_4d")
    assert len(plan.tasks) == 10 and plan.seeds == 4
    assert len(plan.baselines) == 11 and "equi_tqc" not in plan.baselines
    jobs = build_jobs(plan)
    assert len(jobs) == 10 * 11 * 4
    assert {job.experiment.benchmark for job in jobs} == {"close_loop_4d"}
    assert jobs[0].name == "CloseLoopBlockReaching/sac/seed_0"
    six = read_plan("open_loop_6d")
    assert len(six.tasks) == 9 and len(six.baselines) == 8


def test_a_yaml_names_tasks_by_id_name_or_pattern() -> None:
    plan = Plan([PICKING, "CloseLoopBlockReaching", "CloseLoop*Pu[ls]*"], ["*equi_sacfd", "sac"], seeds=[3])
    jobs = build_jobs(plan)
    tasks = {job.experiment.env_id.removeprefix("BulletArm/CloseLoop") for job in jobs}
    assert tasks == {"BlockPicking-v0", "BlockReaching-v0", "BlockPushing-v0", "BlockPulling-v0"}
    assert {job.experiment.label for job in jobs} == {"equi_sacfd", "sac"}
    assert {job.seed for job in jobs} == {3}


def test_numbers_have_exponents_without_a_point(tmp_path: Path) -> None:
    path = tmp_path / "own.yml"
    path.write_text(
        "tasks: [CloseLoopBlockReaching]\nbaselines: [sacfd]\nhyperparams: {learning_rate: 1e-3}\n"
    )
    assert read_plan(str(path)).hyperparams == {"learning_rate": 0.001}


def test_a_pattern_takes_the_baselines_that_fit_the_task() -> None:
    plan = Plan(["OpenLoopBlockStacking", "OpenLoopRampBlockStacking"], ["sdqfd_*cnn_asr*"])
    rows = {(job.experiment.env_id[10:], job.experiment.label) for job in build_jobs(plan)}
    assert rows == {
        ("OpenLoopBlockStacking-v0", "sdqfd_cnn_asr"),
        ("OpenLoopRampBlockStacking-v0", "sdqfd_cnn_asr_6d"),
    }


def test_runs_that_begin_together_do_not_share_demonstrations() -> None:
    jobs = jobs_of(baselines=["sacfd", "sac"], tasks=["CloseLoopToy", "CloseLoopToySlow"])
    keys = [(job.experiment.env_id, job.seed) for job in jobs]
    assert len(set(keys[:4])) == len(set(keys[4:])) == 4


def test_memory_follows_from_the_replay_buffer() -> None:
    plan = Plan(["CloseLoopBlockPulling"], ["sacfd"], options={"eval_freq": 0})
    size = size_of(build_jobs(plan)[0])
    assert 0.12 < size.memory - 1.0 < 0.13  # 30,000 heightmaps of 64 x 64 bytes
    assert size.disk == 0.0 or size.disk == pytest.approx(3 * (size.memory - 1.0))


@pytest.mark.parametrize("benchmark", BENCHMARKS)
def test_all_baselines_of_a_benchmark_have_a_size(benchmark: str) -> None:
    plan = read_plan(benchmark)
    for job in build_jobs(replace(plan, tasks=plan.tasks[:1], seeds=1)):
        assert size_of(job).memory > 1.0


def test_a_pattern_takes_the_tasks_of_the_benchmark() -> None:
    plan = replace(read_plan("close_loop_4d"), tasks=["CloseLoopBlock*"], baselines=["sacfd"], seeds=1)
    tasks = {job.experiment.env_id for job in build_jobs(plan)}
    known = {row.env_id for row in BENCHMARKS["close_loop_4d"].environments}
    assert tasks == {env_id for env_id in known if "CloseLoopBlock" in env_id} != known


def test_a_buffer_tells_its_size_before_it_takes_it() -> None:
    space = gym.spaces.Box(0, 1, (1, 8, 8), np.float32)
    buffer = ExpertReplayBuffer(100, space, gym.spaces.Box(-1, 1, (2,)), "cpu", seed=0)
    announced = buffer.table.nbytes
    image, action, one = np.zeros((1, 1, 8, 8), np.float32), np.zeros((1, 2), np.float32), np.zeros(1)
    buffer.add(image, image, action, one, one, [{}])
    held_bytes = sum(
        array.nbytes for array in (*buffer.table.columns.values(), *buffer.table.observations.values())
    )
    assert held_bytes == announced


@pytest.mark.parametrize("flag", ["--seeds", "--seed"])
def test_seeds_are_given_by_either_name(flag: str, bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    assert bench("--dry-run", flag, "7") == 0
    printed = capsys.readouterr().out
    assert re.search(r"CloseLoopToy/sacfd +7 ", printed) and "1 experiments, 1 runs" in printed
    with pytest.raises(SystemExit):
        main(["benchmark", "--help"])
    assert re.search(rf"{flag}\b", capsys.readouterr().out)


# ---- Refusals


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"task": ["a"]}, "unknown key of bench.yml 'task', did you mean 'tasks'?"),
        ({**TINY, "tasks": []}, "tasks of bench.yml must be a list of names, got []"),
        ({**TINY, "tasks": "CloseLoopToy"}, "tasks of bench.yml must be a list of names"),
        ({**TINY, "tasks": ["CloseLoopBlockPickin"]}, "did you mean 'BulletArm/CloseLoopBlockPicking-v0'?"),
        ({**TINY, "tasks": ["CloseLoopNothing*"]}, "no task fits the pattern 'CloseLoopNothing*'"),
        ({**TINY, "baselines": ["sacdf"]}, "unknown baseline 'sacdf', did you mean 'sacfd'?"),
        ({**TINY, "baselines": ["x*"]}, "no baseline of BulletArm/CloseLoopToy-v0 fits x*"),
        ({**TINY, "preset": "cpuu"}, "unknown preset 'cpuu', did you mean 'cpu'?"),
        ({**TINY, "benchmark": "close_loop_4D"}, "did you mean 'close_loop_4d'?"),
        ({**TINY, "seeds": 0}, "seeds must be a positive number of seeds"),
        ({**TINY, "seeds": [-1]}, "seeds must be a positive number"),
        ({**TINY, "options": {"eval_frq": 1}}, "did you mean 'eval_freq'?"),
        ({**TINY, "options": 3}, "options of bench.yml must be a mapping, got 3"),
        ({**TINY, "hyperparams": {"gama": 1}}, "did you mean 'gamma'?"),
        ({**TINY, "hyperparams": {"gamma": 2}}, "gamma must be a number from 0 to 1, got 2"),
        ({**TINY, "hyperparams": {"env_kwargs": {"obs_size": 8}}}, "obs_size must be at least 48, got 8"),
        (["CloseLoopToy"], "bench.yml must contain a mapping"),
        ("tasks: [", "bench.yml cannot be read"),
    ],
    ids=range(18),
)
def test_a_plan_that_cannot_be_followed(
    content: Any, message: str, refuse: Callable[..., str], tmp_path: Path
) -> None:
    text = content if content == "tasks: [" else yaml.safe_dump(content)
    (tmp_path / "bench.yml").write_text(text)
    assert message in refuse("benchmark", "bench.yml", "--device", "cpu")


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["close_loop_4", "--dry-run"], "unknown benchmark 'close_loop_4', did you mean 'close_loop_4d'?"),
        (["none.yml"], "none.yml does not exist"),
        (["tiny.yml", "-f", "tiny.yml"], "--log-folder must be a folder, got the file tiny.yml"),
        (["tiny.yml", "-f", "/dev/null/folder"], "cannot be written"),
        (["tiny.yml", "-f", "/proc/folder"], "cannot be written"),
        (["tiny.yml", "--cpus", "0"], "must be greater than 0"),
        (["tiny.yml", "--gpus", "1"], "--gpus and --memory need --ray"),
        (["tiny.yml", "--ray", "-j", "2"], "-j cannot be combined with --ray"),
        (["tiny.yml", "--gym-packages", "frobnicate"], "package 'frobnicate' cannot be imported"),
        (["tiny.yml", "--device", "gpu0"], "'gpu0'"),
        (["tiny.yml", "--baseline", "safcd"], "did you mean 'sacfd'?"),
    ],
    ids=range(11),
)
def test_flags_that_cannot_be_followed(
    flags: list[str], message: str, refuse: Callable[..., str], tmp_path: Path
) -> None:
    (tmp_path / "tiny.yml").write_text(yaml.safe_dump(TINY))
    assert message in refuse("benchmark", *flags)


def test_a_folder_with_other_runs_is_refused(bench: Bench, tmp_path: Path, capsys: Any) -> None:
    from zoo_configs.training.runs import Run, write_resolved

    [job] = jobs_of(seeds=1)
    write_resolved(Run(tmp_path / "out" / job.name, job.experiment, 0))
    assert bench(hyperparams={**TINY["hyperparams"], "gamma": 0.5}) == 2
    assert "hyperparams" in capsys.readouterr().err


def test_one_benchmark_at_a_time_works_in_a_folder(bench: Bench, tmp_path: Path, capsys: Any) -> None:
    (tmp_path / "out").mkdir()
    with run_lock(tmp_path / "out"):
        assert bench() == 2
    assert "is being trained by another process" in capsys.readouterr().err


def test_a_dry_run_writes_nothing(bench: Bench, tmp_path: Path, capsys: Any) -> None:
    assert bench("--dry-run", baselines=["sacfd", "sac"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].split()[:4] == ["CloseLoopToy/sac", "0", "1", "1.0"]
    assert lines[3].startswith("2 experiments, 4 runs")
    assert not (tmp_path / "out").exists()


# ---- Overview


def test_the_overview_is_read_from_the_folders(tmp_path: Path, capsys: Any) -> None:
    jobs = jobs_of(seeds=4)
    overview = Overview(jobs, tmp_path)
    first, second, third, _ = (tmp_path / job.name for job in jobs)
    set_status(second, State.FAILED, "the block is lost")
    third.mkdir()
    with run_lock(third):
        pass
    first.mkdir()
    with run_lock(first), shown(overview) as look:
        results = [[0.0, 1.0]]
        np.savez(first / "evaluations.npz", timesteps=[6], results=results, successes=results)
        look()
        told = capsys.readouterr().err
        assert overview.counts() == "1 done, 1 running, 1 waiting, 1 failed"
    assert "running CloseLoopToy/sacfd/seed_0, success 0.50 at 6" in told
    assert "failed CloseLoopToy/sacfd/seed_1: the block is lost" in told
    set_status(third, State.FAILED, "what is done stays done")
    assert [entry.name for entry in Overview(jobs, tmp_path).of(Status.DONE)] == []
    overview.update()
    assert [entry.name for entry in overview.of(Status.DONE)] == [m.name for m in jobs if m.seed in (0, 2)]


def test_a_progress_bar_shows_the_counts(tmp_path: Path, capsys: Any) -> None:
    with shown(Overview(jobs_of(), tmp_path), progress=True) as update:
        update()
    assert "2 waiting" in capsys.readouterr().err


# ---- Runs


def test_runs_that_fail_do_not_stop_the_others(bench: Bench, tmp_path: Path, capsys: Any) -> None:
    tasks = ["CloseLoopToyFailing", "CloseLoopToyCrashing", "CloseLoopToy"]
    assert bench("-j", "2", tasks=tasks, seeds=1) == 2
    out, err = capsys.readouterr()
    assert out.splitlines()[0] == "1 done, 0 running, 0 waiting, 2 failed"
    assert "2 of 3 runs failed. Use --retry-failed to restart; CloseLoopToyFailing/" in err.splitlines()[-1]
    failing, crashing, good = (tmp_path / "out" / task / "sacfd" / "seed_0" for task in tasks)
    assert "the block is lost" in run_status(failing).error  # type: ignore[union-attr]
    assert run_status(crashing).error == "its process was ended by SIGSEGV, see log.txt"  # type: ignore[union-attr]
    assert "RuntimeError: the block is lost" in (failing / "log.txt").read_text()
    # A second start leaves both what is done and what has failed
    before = {path: path.stat().st_mtime_ns for path in (good / "state.yml", failing / "state.yml")}
    assert bench("-j", "2", tasks=tasks, seeds=1) == 2
    assert {path: path.stat().st_mtime_ns for path in before} == before
    # ... unless it is wanted
    assert bench("--retry-failed", "--env", "CloseLoopToyFailing", tasks=tasks, seeds=1) == 2
    assert (failing / "state.yml").stat().st_mtime_ns != before[failing / "state.yml"]
    assert (good / "state.yml").stat().st_mtime_ns == before[good / "state.yml"]


def test_a_full_disk_ends_the_benchmark_and_no_run(bench: Bench, tmp_path: Path, capsys: Any) -> None:
    assert bench("-j", "1", tasks=["CloseLoopToyFull"]) == 2
    [line] = [line for line in capsys.readouterr().err.splitlines() if "error" in line]
    assert f"{tmp_path / 'out'} is full or not writable" in line
    entries = Overview(jobs_of(tasks=["CloseLoopToyFull"]), tmp_path / "out")
    entries.update()
    assert entries.counts() == "0 done, 0 running, 2 waiting, 0 failed"


def test_an_interrupted_run_goes_on(tmp_path: Path) -> None:
    options = {**TINY["options"], "n_timesteps": 60, "save_freq": 6}
    [job] = jobs_of(tasks=["CloseLoopToySlow"], seeds=1, options=options)
    process, folder = JobProcess(job, tmp_path), tmp_path / job.name
    wait_for(lambda: any(folder.glob("checkpoints/checkpoint_*")))
    process.interrupt()
    assert process.wait(60) and process.exit_code() is ExitCode.INTERRUPTED
    assert run_status(folder).state is State.KILLED  # type: ignore[union-attr]


def kill_at_random(bench: Bench, tmp_path: Path, plan: dict[str, Any], kills: int, seed: int) -> None:
    """Kill a benchmark again and again, let it end, and compare it with an uninterrupted one."""
    rng = random.Random(seed)
    out = tmp_path / "out"
    for _ in range(kills):
        process = start(tmp_path, plan, "-j", "2")
        wait_for(lambda: any(out.glob("*/*/*/log.txt")))
        time.sleep(rng.uniform(0.0, 4.0))
        process.send_signal(signal.SIGKILL)
        process.wait()
        wait_for(lambda: not any(is_running(folder) for folder in out.glob("*/*/seed_*")))
    assert bench("-j", "2", **plan) == 0
    jobs = jobs_of(**plan)
    runs = find_runs(out)
    assert sorted(str(run.folder.relative_to(out)) for run in runs) == sorted(m.name for m in jobs)
    (tmp_path / "whole").mkdir()
    whole = main(["benchmark", str(tmp_path / "tiny.yml"), "-f", str(tmp_path / "whole"), *FLAGS, "-j", "2"])
    assert whole == 0
    for run in runs:
        assert run.status.state is State.DONE  # type: ignore[union-attr]
        assert same(run.folder, tmp_path / "whole" / run.folder.relative_to(out))


KILLED = {"tasks": ["CloseLoopToySlow"], "seeds": 2, "options": {**TINY["options"], "n_timesteps": 24}}


def test_a_killed_benchmark_goes_on_as_if_nothing_had_happened(bench: Bench, tmp_path: Path) -> None:
    kill_at_random(bench, tmp_path, {**TINY, **KILLED}, kills=1, seed=0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 6))
def test_a_benchmark_killed_often(seed: int, bench: Bench, tmp_path: Path) -> None:
    plan = {**TINY, **KILLED, "baselines": ["sacfd", "equi_sacfd"]}
    kill_at_random(bench, tmp_path, plan, kills=5, seed=seed)


@pytest.mark.slow
def test_ctrl_c_and_a_second_start_lose_nothing(bench: Bench, tmp_path: Path) -> None:
    plan = {**TINY, **KILLED}
    process = start(tmp_path, plan, "-j", "2")
    wait_for(lambda: any((tmp_path / "out").rglob("checkpoint_*")))
    process.send_signal(signal.SIGINT)
    assert process.wait(90) == 130
    assert not any(is_running(folder) for folder in (tmp_path / "out").glob("*/*/seed_*"))
    assert bench("-j", "2", **plan) == 0


@pytest.mark.slow
def test_two_hundred_runs(bench: Bench, tmp_path: Path) -> None:
    keys = {"seeds": 50, "tasks": ["CloseLoopToy", "CloseLoopToyFailing"], "baselines": ["sacfd", "sac"]}
    assert bench("-j", "2", **keys) == 2  # half of them fail
    overview = Overview(jobs_of(**keys), tmp_path / "out")
    overview.update()
    assert overview.counts() == "100 done, 0 running, 0 waiting, 100 failed"
