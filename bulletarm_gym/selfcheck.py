"""Look whether environments run well on this machine: ``python -m bulletarm_gym.selfcheck``.

It needs nothing but the environments; ``bulletarm-zoo doctor`` looks at the learners besides.
"""

import argparse
import os
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from typing import Any, NamedTuple

import gymnasium

import bulletarm_gym  # noqa: F401 (registers the environments)
from bulletarm_gym.machine import describe_machine, load_average, versions
from bulletarm_gym.simulation import has_display
from bulletarm_gym.simulation.yardstick import Yardstick, measure_yardstick

__all__ = ["Finding", "Yardstick", "look_at", "measure_yardstick", "report"]

CLOSE_LOOP = "BulletArm/CloseLoopBlockPicking-v0"
OPEN_LOOP = "BulletArm/OpenLoopBlockStacking-v0"
MOST_STEPS = {CLOSE_LOOP: 40.0, OPEN_LOOP: 200.0}
"""A step with the expert's action should not take longer than so many simulation steps of plain PyBullet:
twice as long as where it was measured (docs/speed.md)."""
ARMS = ("kuka", "panda", "ur5", "ur5_robotiq")
EPISODES = 3
"""Begun with an arm until its expert succeeds once."""
THREADS = "OMP_NUM_THREADS"
SECONDS = 2.0
"""For which the speed of an environment is measured, unless told."""
FAILED = 2
"""Exit status."""


class Finding(NamedTuple):
    """What a look has found.

    :param what: what was looked at
    :param value: how it is
    :param advice: what to do about it; nothing where all is well
    :param fails: whether environments do not work like this
    """

    what: str
    value: str
    advice: str = ""
    fails: bool = False


def look_at(seconds: float) -> Iterator[Finding]:
    """Yield what is found, one after the other.

    :param seconds: how long to measure the speed of each of two environments
    """
    yield Finding("versions", ", ".join(f"{name} {version}" for name, version in versions().items()))
    yield processor()
    yield threads()
    yield display()
    yield from map(arm, ARMS)
    yield compiled_code()
    yardstick = measure_yardstick()
    for env_id in MOST_STEPS:
        yield speed(env_id, step_ms(env_id, seconds), yardstick)


def processor() -> Finding:
    """Look at the processor, and whether something else keeps it busy."""
    busy = load_average() > (os.cpu_count() or 1)
    advice = "other programs want more cores than there are: trainings will be slow, and so is what follows"
    return Finding("processor", describe_machine(), advice if busy else "")


def threads() -> Finding:
    """Look at the environment variable that sets the threads of each process."""
    asked = os.environ.get(THREADS)
    advice = (
        f"export {THREADS}=1 before several trainings or processes of environments run at once: "
        "each takes all cores otherwise, and they wait for each other"
    )
    return Finding("threads", f"{THREADS}={asked or 'not set'}", "" if asked else advice)


def display() -> Finding:
    """Look whether windows can be opened."""
    missing = "none: render_mode='rgb_array' and play without a window work, 'human' does not"
    return Finding("display", "found" if has_display() else missing)


def arm(name: str) -> Finding:
    """Look whether an arm's expert picks a block."""
    advice = "tell the maintainers, with the lines above"
    try:
        with closing(gymnasium.make(CLOSE_LOOP, robot=name)) as env:
            for seed in range(EPISODES):
                steps, _, success = _play(env, seed)
                if success:
                    return Finding(name, f"picked a block in {steps} steps")
    except Exception as error:  # whatever goes wrong on this machine is what is looked for
        return Finding(name, f"{type(error).__name__}: {' '.join(str(error).split())}", advice, fails=True)
    return Finding(name, f"failed in {EPISODES} episodes", advice, fails=True)


def _play(env: Any, seed: int) -> tuple[int, float, bool]:
    """Let the expert act; return steps, the seconds that they took, and whether it succeeded."""
    env.reset(seed=seed)
    start, steps, over = time.perf_counter(), 0, False
    while not over:
        _, _, terminated, truncated, info = env.step(env.unwrapped.expert_action())
        steps, over = steps + 1, terminated or truncated
    return steps, time.perf_counter() - start, bool(info["is_success"])


def compiled_code() -> Finding:
    """Look where the compiled loops are kept that have run so far in this process."""
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
    """Yield the functions of the environments that numba has compiled, each once."""
    from numba.core.registry import CPUDispatcher

    modules = [module for name, module in sys.modules.items() if name.startswith("bulletarm_gym.")]
    members = {id(value): value for module in modules for value in vars(module).values()}
    return (value for value in members.values() if isinstance(value, CPUDispatcher))


def step_ms(env_id: str, seconds: float) -> float:
    """Return how long a step with the expert's action takes (ms), resets not counted.

    :param seconds: for which whole episodes are played
    """
    with closing(gymnasium.make(env_id)) as env:
        _play(env, 0)  # fills caches, compiles
        steps, taken, seed = 0, 0.0, 0
        while taken < seconds:
            seed += 1
            more, time_of_them, _ = _play(env, seed)
            steps, taken = steps + more, taken + time_of_them
    return 1e3 * taken / steps


def speed(env_id: str, step_ms: float, yardstick: Yardstick) -> Finding:
    """Compare a step of an environment with a simulation step of plain PyBullet on this machine."""
    ratio = 1e3 * step_ms / yardstick.step_us
    value = (
        f"{1e3 / step_ms:.0f} steps/s; one takes as long as {ratio:.0f} simulation steps "
        f"of plain PyBullet ({yardstick.step_us:.0f} us each)"
    )
    advice = (
        f"slower than it should be, at most {MOST_STEPS[env_id]:.0f}: see processor, threads, numba cache"
    )
    return Finding(env_id.rpartition("/")[2], value, advice if ratio > MOST_STEPS[env_id] else "")


def report(findings: Iterable[Finding]) -> list[str]:
    """Print what is found, and what to do about it; return what does not work."""
    failed = []
    for finding in findings:
        mark = "FAILED" if finding.fails else "note" if finding.advice else "ok"
        print(f"{mark:<6}  {finding.what}: {finding.value}", flush=True)
        if finding.advice:
            print(f"        -> {finding.advice}")
        failed += [finding.what] * finding.fails
    return failed


def main(argv: Sequence[str] | None = None) -> int:
    """Look at everything; return the exit status, 2 if something does not work."""
    parser = argparse.ArgumentParser("python -m bulletarm_gym.selfcheck", description=__doc__)
    help_text = f"how long to measure each speed (default: {SECONDS:g})"
    parser.add_argument("--seconds", type=float, default=SECONDS, help=help_text)
    args = parser.parse_args(argv)
    if not 0.0 < args.seconds < float("inf"):
        parser.error(f"--seconds must be positive, got {args.seconds}")
    failed = report(look_at(args.seconds))
    if failed:
        print(f"does not work here: {', '.join(failed)}", file=sys.stderr)
    return FAILED if failed else 0


if __name__ == "__main__":
    sys.exit(main())
