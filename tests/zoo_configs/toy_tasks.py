"""Toy tasks for processes that do not know the fixtures: ``--gym-packages toy_tasks``."""

import errno
import os
import signal
import time

import gymnasium as gym
from toy_env import TOY_ID, ToyEnv


class FailingToy(ToyEnv):
    """A task whose author has made a mistake."""

    def step(self, action):
        raise RuntimeError("the block is lost")


class CrashingToy(ToyEnv):
    """A task whose engine takes the process with it."""

    def step(self, action):
        os.kill(os.getpid(), signal.SIGSEGV)


class FullToy(ToyEnv):
    """A task on a full disk."""

    def step(self, action):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


class SlowToy(ToyEnv):
    """A task that leaves time to end it."""

    def step(self, action):
        time.sleep(0.05)
        return super().step(action)


TOYS = {
    "Toy": ToyEnv,
    "ToyFailing": FailingToy,
    "ToyCrashing": CrashingToy,
    "ToyFull": FullToy,
    "ToySlow": SlowToy,
}
for name, toy in TOYS.items():
    if (env_id := TOY_ID.replace("Toy", name)) not in gym.registry:
        gym.register(env_id, entry_point=toy)
