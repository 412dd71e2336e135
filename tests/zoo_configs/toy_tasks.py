"""Toy tasks for processes that do not know the fixtures: ``--gym-packages toy_tasks``."""

import errno
import itertools
import os
import signal
import time

import gymnasium as gym
from toy_env import TOY_ID, ToyEnv

EVENTS = itertools.count(1)
replace = os.replace


def fail(env, action):
    raise RuntimeError("the block is lost")


def crash(env, action):
    os.kill(os.getpid(), signal.SIGSEGV)


def fill_disk(env, action):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def step_slowly(env, action):
    time.sleep(0.05)
    return ToyEnv.step(env, action)


def count():
    """Kill the process at the event with the number ``DIES_AT``."""
    if next(EVENTS) == int(os.environ.get("DIES_AT", 0)):
        os.kill(os.getpid(), signal.SIGKILL)


def step_and_count(env, action):
    count()
    return ToyEnv.step(env, action)


def replace_and_count(*args, **kwargs):
    count()
    replace(*args, **kwargs)
    count()


if "DIES_AT" in os.environ:
    os.replace = replace_and_count
STEPS = {"": ToyEnv.step, "Failing": fail, "Crashing": crash, "Full": fill_disk, "Slow": step_slowly}
for name, step in {**STEPS, "Counting": step_and_count}.items():
    if (env_id := TOY_ID.replace("Toy", f"Toy{name}")) not in gym.registry:
        gym.register(env_id, entry_point=type(f"Toy{name}", (ToyEnv,), {"step": step}))
