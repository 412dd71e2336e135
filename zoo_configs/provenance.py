"""Where a result comes from: machine, versions and commit."""

import functools
import subprocess
from importlib import metadata
from pathlib import Path
from typing import Any

from bulletarm_gym.check import machine

DISTRIBUTION = "bulletarm-gym"
PACKAGES = (DISTRIBUTION, "torch", "stable-baselines3", "gymnasium", "pybullet", "numpy")
HERE = Path(__file__).resolve()


def versions() -> dict[str, str]:
    """Return the version of each package of ``PACKAGES`` and of Python."""
    return machine.versions(PACKAGES)


def arithmetic() -> dict[str, Any]:
    """Return what must be equal for results to repeat exactly: processor type, threads and versions."""
    import llvmlite.binding
    import torch

    processor = f"{llvmlite.binding.get_host_cpu_name()}, {torch.get_num_threads()} threads"
    return {"arithmetic": processor, "versions": versions()}


def describe_hardware(device: str = "cpu") -> str:
    """Return the processor, its number of cores and the GPU that a PyTorch device uses."""
    processor = machine.describe_processor()
    if device == "cpu":
        return processor  # without importing PyTorch

    import torch
    from stable_baselines3.common.utils import get_device

    where = get_device(device)
    return f"{processor}, {torch.cuda.get_device_name(where)}" if where.type == "cuda" else processor


@functools.cache
def commit() -> str:
    """Return the abbreviated commit of the code, ``-dirty`` after changes, or the version of the package."""
    words = ("describe", "--always", "--abbrev=7", "--dirty", "--exclude=*")
    if _git("ls-files", "--error-unmatch", HERE.name) is not None and (found := _git(*words)):
        return found
    return f"version {metadata.version(DISTRIBUTION)}"


def _git(*words: str) -> str | None:
    """Return the output of a git command in this folder, None without git or a checkout."""
    command = ["git", "-C", str(HERE.parent), *words]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10.0, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()
