"""Checks that environments work on this machine and how fast they are."""

import itertools
import os
import time
import timeit
from collections.abc import Iterator
from contextlib import closing
from statistics import median
from typing import Any

import gymnasium
import pybullet_data

import bulletarm_gym  # noqa: F401 (registers the environments)
from bulletarm_gym.check.machine import Finding, describe_machine, load_average, versions
from bulletarm_gym.geometry.compilation import MONITOR
from bulletarm_gym.registry import ROBOTS
from bulletarm_gym.simulation import has_display
from bulletarm_gym.simulation.client import Client


def measure_calibration() -> float:
    """Return the duration (microseconds) of the reference: a step with a KUKA arm and four resting cubes."""
    client, steps = Client(), 2000
    try:
        client.setAdditionalSearchPath(pybullet_data.getDataPath())
        client.setGravity(0, 0, -10)
        client.loadURDF("plane.urdf")
        client.loadSDF("kuka_iiwa/kuka_with_gripper2.sdf")
        for index in range(4):
            client.loadURDF("cube_small.urdf", [0.4 + 0.08 * index, 0.08 * index, 0.03])
        for _ in range(300):  # until the cubes rest
            client.stepSimulation()
        return 1e6 * median(timeit.repeat(client.stepSimulation, number=steps, repeat=5)) / steps
    finally:
        client.close()


CLOSE_LOOP = "BulletArm/CloseLoopBlockPicking-v0"
OPEN_LOOP = "BulletArm/OpenLoopBlockStacking-v0"
MAX_RATIO = {CLOSE_LOOP: 40.0, OPEN_LOOP: 200.0}
"""Maximum duration of a step with the expert's action, in simulation steps of PyBullet."""
EPISODES = 3
"""Maximum number of episodes in which the expert of a robot must succeed once."""
THREADS = "OMP_NUM_THREADS"


def check_environments(seconds: float) -> Iterator[Finding]:
    """Yield the findings on the machine, the robots and, measured for some seconds each, the speed."""
    yield Finding("versions", ", ".join(f"{name} {version}" for name, version in versions().items()))
    advice = "the load average must be at most the number of cores. Trainings and this check are slower"
    is_busy = load_average() > (os.cpu_count() or 1)
    yield Finding("processor", describe_machine(), advice if is_busy else "")
    threads = os.environ.get(THREADS)
    advice = f"export {THREADS}=1 before you run several trainings or worker processes at the same time"
    yield Finding("threads", f"{THREADS}={threads or 'not set'}", "" if threads else advice)
    missing = "none: render_mode='rgb_array' works, 'human' does not"
    yield Finding("display", "found" if has_display() else missing)
    yield from map(robot, ROBOTS.builtin)
    yield compiled_code()
    step_us = measure_calibration()
    for env_id in MAX_RATIO:
        yield speed(env_id, seconds, step_us)


def robot(name: str) -> Finding:
    """Check that the expert picks a block with a robot."""
    value = f"failed in {EPISODES} of {EPISODES} episodes"
    try:
        with closing(gymnasium.make(CLOSE_LOOP, robot=name)) as env:
            for seed in range(EPISODES):
                steps, _, success = play_episode(env, seed)
                if success:
                    return Finding(name, f"picked a block in {steps} steps")
    except Exception as error:  # every error is a finding
        value = f"{type(error).__name__}: {error}"
    return Finding(name, value, "report this output to the maintainers", fails=True)


def play_episode(env: gymnasium.Env[Any, Any], seed: int) -> tuple[int, float, bool]:
    """Run an episode of the expert; return the number of steps, their duration (s), and the success."""
    env.reset(seed=seed)
    start, steps, is_over = time.perf_counter(), 0, False
    while not is_over:
        action = env.unwrapped.expert_action()  # type: ignore[attr-defined]
        _, _, terminated, truncated, info = env.step(action)
        steps, is_over = steps + 1, terminated or truncated
    return steps, time.perf_counter() - start, bool(info["is_success"])


def compiled_code() -> Finding:
    """Check where the compiled functions that this process has called are cached."""
    statistics = [function.stats for function in MONITOR.functions]
    folders = sorted({stats.cache_path for stats in statistics if stats.cache_path})
    if not folders:
        advice = "set NUMBA_CACHE_DIR to a writable folder, or every process compiles again"
        return Finding("numba cache", "none", advice)
    hits = sum(sum(stats.cache_hits.values()) for stats in statistics)
    misses = sum(sum(stats.cache_misses.values()) for stats in statistics)
    value = f"{hits} read, {misses} compiled, {os.path.commonpath(folders)}"
    advice = "compiled now, once for this machine. Run this check again to see that the cache is used"
    return Finding("numba cache", value, advice if misses else "")


def speed(env_id: str, seconds: float, step_us: float) -> Finding:
    """Compare a step with the expert's action, without resets, with a simulation step of PyBullet.

    :param seconds: minimum duration (s) of the measurement, in whole episodes
    :param step_us: duration of a simulation step on this machine (microseconds)
    """
    with closing(gymnasium.make(env_id)) as env:
        play_episode(env, 0)  # compiles, fills caches
        seeds, steps, duration = itertools.count(1), 0, 0.0
        while steps == 0 or duration < seconds:
            more, longer, _ = play_episode(env, next(seeds))
            steps, duration = steps + more, duration + longer
    ratio, limit = 1e6 * duration / steps / step_us, MAX_RATIO[env_id]
    value = (
        f"{steps / duration:.0f} steps/s, {ratio:.0f} simulation steps of PyBullet per step "
        f"(at most {limit:.0f}, {step_us:.0f} us each)"
    )
    advice = "see processor, threads and numba cache above" if ratio > limit else ""
    return Finding(env_id.rpartition("/")[2], value, advice)
