"""What decides whether trainings run well on a machine, besides what decides it for environments."""

from __future__ import annotations

import os
from collections.abc import Iterator

from bulletarm_gym import selfcheck
from bulletarm_gym.machine import versions
from bulletarm_gym.selfcheck import Finding

PACKAGES = ("torch", "stable-baselines3", "sb3-contrib", "optuna")


def look_at(seconds: float) -> Iterator[Finding]:
    """
    Look at everything: the learners, then the environments.

    :param seconds: How long to measure the speed of each of two environments
    :return: The findings, one after the other
    """
    found = versions(PACKAGES)
    yield Finding("learners", ", ".join(f"{name} {found[name]}" for name in PACKAGES))
    yield compute_threads()
    yield gpu()
    yield from selfcheck.look_at(seconds)


def compute_threads() -> Finding:
    """
    Threads of PyTorch.

    :return: The finding
    """
    import torch

    number, asked = torch.get_num_threads(), os.environ.get(selfcheck.THREADS)
    advice = "give train --num-threads 1 before several trainings run at once: each takes all cores otherwise"
    return Finding("PyTorch", f"{number} threads", "" if asked or number == 1 else advice)


def gpu() -> Finding:
    """
    The GPU, on which the preset ``paper`` wants to train.

    :return: The finding
    """
    import torch

    if torch.cuda.is_available():
        return Finding("GPU", torch.cuda.get_device_name())
    return Finding("GPU", "none: the default preset is cpu")
