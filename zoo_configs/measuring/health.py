"""What decides whether environments and trainings run well on a machine, looked at one by one."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import closing
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

from zoo_configs.environments import make_env
from zoo_configs.errors import reason
from zoo_configs.measuring.machine import describe_machine, versions
from zoo_configs.measuring.throughput import Throughput, load_reference, measure_env

CLOSE_LOOP = "BulletArm/CloseLoopBlockPicking-v0"
OPEN_LOOP = "BulletArm/OpenLoopBlockStacking-v0"
ARMS = ("kuka", "panda", "ur5", "ur5_robotiq")
EPISODES = 3  # begun with an arm until its expert succeeds once
THREADS = "OMP_NUM_THREADS"
SHIPPED_REFERENCE = "data/reference_rates.csv"
LEAST_RATIO = 10.0  # to the earlier implementation; the measured ones are above 20


class Finding(NamedTuple):
    """
    What a look has found.

    :param what: What was looked at
    :param value: How it is
    :param advice: What to do about it; nothing where all is well
    :param fails: Whether environments do not work like this
    """

    what: str
    value: str
    advice: str = ""
    fails: bool = False


def look_at(seconds: float) -> Iterator[Finding]:
    """
    Look at everything.

    :param seconds: How long to measure the speed of each of two environments
    :return: The findings, one after the other
    """
    found = versions()
    yield Finding("versions", ", ".join(f"{name} {version}" for name, version in found.items()))
    yield processor()
    yield threads()
    yield gpu()
    yield display()
    yield from map(arm, ARMS)
    yield compiled_code()
    for env_id in (CLOSE_LOOP, OPEN_LOOP):
        yield speed(measure_env(env_id, seconds, 0, lambda _: None, {}))


def processor() -> Finding:
    """
    The processor, and whether something else keeps it busy.

    :return: The finding
    """
    busy = os.getloadavg()[0] > (os.cpu_count() or 1)
    advice = "other programs want more cores than there are: trainings will be slow, and so is what follows"
    return Finding("processor", describe_machine(), advice if busy else "")


def threads() -> Finding:
    """
    Threads of PyTorch, and the environment variable that sets them in every process.

    :return: The finding
    """
    import torch

    asked = os.environ.get(THREADS)
    value = f"{torch.get_num_threads()} of PyTorch, {THREADS}={asked or 'not set'}"
    advice = (
        f"export {THREADS}=1, or give train --num-threads 1, before several trainings or processes of "
        "environments run at once: each takes all cores otherwise, and they wait for each other"
    )
    return Finding("threads", value, "" if asked or torch.get_num_threads() == 1 else advice)


def gpu() -> Finding:
    """
    The GPU, on which the preset ``paper`` wants to train.

    :return: The finding
    """
    import torch

    if torch.cuda.is_available():
        return Finding("GPU", torch.cuda.get_device_name())
    return Finding("GPU", "none: the default preset is cpu")


def display() -> Finding:
    """
    Whether windows can be opened.

    :return: The finding
    """
    with closing(make_env(CLOSE_LOOP, {})) as env:
        if "human" in env.metadata["render_modes"]:
            return Finding("display", "found")
    return Finding(
        "display", "none: render_mode='rgb_array' and play without a window work, 'human' does not"
    )


def arm(name: str) -> Finding:
    """
    Whether an arm's expert picks a block.

    :param name: Name of the arm
    :return: The finding
    """
    advice = "tell the maintainers, with the lines above"
    try:
        with closing(make_env(CLOSE_LOOP, {"robot": name})) as env:
            for episode in range(EPISODES):
                steps, success = _play(env, episode)
                if success:
                    return Finding(name, f"picked a block in {steps} steps")
    except Exception as error:  # whatever goes wrong on this machine is what is looked for
        return Finding(name, reason(error), advice, fails=True)
    return Finding(name, f"failed in {EPISODES} episodes", advice, fails=True)


def _play(env: Any, seed: int) -> tuple[int, bool]:
    env.reset(seed=seed)
    steps, over = 0, False
    while not over:
        _, _, terminated, truncated, info = env.step(env.unwrapped.expert_action())
        steps, over = steps + 1, terminated or truncated
    return steps, bool(info["is_success"])


def compiled_code() -> Finding:
    """
    Where the compiled loops are kept that have run so far in this process.

    :return: The finding
    """
    statistics = [function.stats for function in _compiled_functions()]
    folders = {stats.cache_path for stats in statistics if stats.cache_path}
    hits = sum(sum(stats.cache_hits.values()) for stats in statistics)
    misses = sum(sum(stats.cache_misses.values()) for stats in statistics)
    if not folders:
        advice = "set NUMBA_CACHE_DIR to a folder that can be written, or every process compiles anew"
        return Finding("numba cache", "none", advice)
    advice = "compiled just now, once for this machine; call it again to see that it is kept"
    parent = os.path.commonpath(sorted(folders))
    return Finding("numba cache", f"{hits} read, {misses} compiled, {parent}", advice if misses else "")


def _compiled_functions() -> Iterator[Any]:
    """Functions of the environments that numba has compiled, each once."""
    from numba.core.registry import CPUDispatcher

    modules = [module for name, module in sys.modules.items() if name.startswith("bulletarm_gym.")]
    members = {id(value): value for module in modules for value in vars(module).values()}
    return (value for value in members.values() if isinstance(value, CPUDispatcher))


def speed(measured: Throughput) -> Finding:
    """
    Compare an environment's speed with that of the earlier implementation, scaled to this machine and hour.

    :param measured: What was measured
    :return: The finding
    """
    reference = load_reference(Path(str(resources.files("zoo_configs") / SHIPPED_REFERENCE)))
    ratio = measured.steps_per_second / reference[measured.env_id].scaled_to(measured.yardstick)
    value = (
        f"{measured.steps_per_second:.0f} steps/s, {ratio:.0f} times the earlier implementation "
        f"(a step of plain PyBullet: {measured.yardstick.step_us:.0f} us)"
    )
    advice = "slower than it should be: see processor, threads, numba cache; bulletarm-zoo speed tells more"
    name = measured.env_id.rpartition("/")[2]
    return Finding(name, value, advice if ratio < LEAST_RATIO else "")
