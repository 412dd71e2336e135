"""The machine: what it is, how busy, and with which versions of what."""

import math
import os
import platform
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path

PACKAGES = ("bulletarm-gym", "gymnasium", "pybullet", "numpy", "numba")
"""On which environments depend."""


def describe_machine() -> str:
    """Return model and cores of the processor, and the load average over one minute, where there is one."""
    load = load_average()
    return describe_processor() + ("" if math.isnan(load) else f", load average {load:.2f}")


def describe_processor() -> str:
    """Return model and cores of the processor."""
    return f"{_processor()}, {os.cpu_count()} cores"


def load_average() -> float:
    """Return how many programs wanted a core over the last minute; NaN where the system does not tell."""
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else math.nan


def versions(packages: Iterable[str] = PACKAGES) -> dict[str, str]:
    """Return the version of Python, and of packages by name."""
    return {"python": platform.python_version(), **{name: metadata.version(name) for name in packages}}


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.exists() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or platform.machine()
