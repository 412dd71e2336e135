"""The processor, its load, the versions of packages, and findings about them."""

import math
import os
import platform
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

PACKAGES = ("bulletarm-gym", "gymnasium", "pybullet", "numpy", "numba", "torch", "stable-baselines3")
"""Packages of environments and learners whose versions are reported."""


class Finding(NamedTuple):
    """Subject and result of a check, advice if the value is beyond its threshold, and whether it failed."""

    what: str
    value: str
    advice: str = ""
    fails: bool = False


def report(findings: Iterable[Finding]) -> list[str]:
    """Print findings and advice, and return the subjects of failed checks."""
    failed = []
    for finding in findings:
        mark = "FAILED" if finding.fails else "note" if finding.advice else "ok"
        print(f"{mark:<6}  {finding.what}: {' '.join(finding.value.split())}", flush=True)
        if finding.advice:
            print(f"        -> {finding.advice}")
        failed += [finding.what] * finding.fails
    return failed


def describe_machine() -> str:
    """Return model and cores of the processor, and the load average over one minute if known."""
    load = load_average()
    return describe_processor() + ("" if math.isnan(load) else f", load average {load:.2f}")


def describe_processor() -> str:
    """Return model and cores of the processor."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.exists() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    model = models[0] if models else platform.processor() or platform.machine()
    return f"{model}, {os.cpu_count()} cores"


def load_average() -> float:
    """Return the load average over one minute, or NaN if the system has none."""
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else math.nan


def versions(packages: Iterable[str] = PACKAGES) -> dict[str, str]:
    """Return the versions of Python and of packages, by name."""
    return {"python": platform.python_version(), **{name: _version(name) for name in packages}}


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "not installed"
