"""The machine: what it is, how busy, and how fast in plain PyBullet."""

from __future__ import annotations

import importlib
import os
import platform
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from statistics import median
from typing import Any

PACKAGES = ("bulletarm-gym", "torch", "stable-baselines3", "gymnasium", "pybullet", "numpy")


@dataclass(frozen=True)
class Yardstick:
    """
    The machine's speed in plain PyBullet: a KUKA arm and four resting cubes.

    :param step_us: One simulation step, in microseconds
    :param render_ms: One picture of 128 x 128 pixels by the software renderer, in milliseconds
    """

    step_us: float
    render_ms: float


def measure_yardstick(steps: int = 2000, pictures: int = 20) -> Yardstick:
    """
    Measure the machine, apart from any environment.

    :param steps: Simulation steps in each of five measurements
    :param pictures: Pictures in each of five measurements
    :return: The median of five measurements of each figure
    """
    pb: Any = importlib.import_module("pybullet")
    client = pb.connect(pb.DIRECT)
    try:
        _build_yardstick_scene(pb, client)
        view = pb.computeViewMatrix([0.45, 0, 0.8], [0.45, 0, 0], [-1, 0, 0])
        lens = pb.computeProjectionMatrixFOV(40, 1, 0.01, 2)
        step = _median_time(lambda: pb.stepSimulation(physicsClientId=client), steps)
        shoot = {"renderer": pb.ER_TINY_RENDERER, "physicsClientId": client}
        picture = _median_time(lambda: pb.getCameraImage(128, 128, view, lens, **shoot), pictures)
    finally:
        pb.disconnect(client)
    return Yardstick(step_us=step * 1e6, render_ms=picture * 1e3)


def _build_yardstick_scene(pb: Any, client: int) -> None:
    here = {"physicsClientId": client}
    pb.setAdditionalSearchPath(importlib.import_module("pybullet_data").getDataPath(), **here)
    pb.setGravity(0, 0, -10, **here)
    pb.loadURDF("plane.urdf", **here)
    pb.loadSDF("kuka_iiwa/kuka_with_gripper2.sdf", **here)
    for index in range(4):
        pb.loadURDF("cube_small.urdf", [0.4 + 0.08 * index, 0.08 * index, 0.03], **here)
    for _ in range(300):  # until the cubes rest
        pb.stepSimulation(**here)


def _median_time(function: Callable[[], Any], calls: int, repetitions: int = 5) -> float:
    """Median over repetitions of the mean time of a call, in seconds."""
    times = []
    for _ in range(repetitions):
        start = time.perf_counter()
        for _ in range(calls):
            function()
        times.append((time.perf_counter() - start) / calls)
    return median(times)


def describe_machine() -> str:
    """
    Describe the machine and how busy it is.

    :return: Model and cores of the processor, and the load average over one minute
    """
    return f"{describe_processor()}, load average {os.getloadavg()[0]:.2f}"


def describe_processor() -> str:
    """
    Describe the machine alone.

    :return: Model and cores of the processor
    """
    return f"{_processor()}, {os.cpu_count()} cores"


def describe_arithmetic() -> str:
    """
    What the bits of a result depend on besides versions.

    :return: Kind of the processor, and how many threads PyTorch computes with
    """
    import llvmlite.binding
    import torch

    return f"{llvmlite.binding.get_host_cpu_name()}, {torch.get_num_threads()} threads"


def versions() -> dict[str, str]:
    """
    What a result depends on besides the machine.

    :return: From package to its version; that of Python, too
    """
    return {"python": platform.python_version(), **{name: metadata.version(name) for name in PACKAGES}}


def commit() -> str:
    """
    The commit of the checkout that runs.

    :return: Its abbreviated hash; empty if this is none, or there is no git
    """
    checkout = Path(__file__).resolve().parents[2]
    if not (checkout / ".git").exists():
        return ""
    command = ["git", "-C", str(checkout), "rev-parse", "--short", "HEAD"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return ""


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.exists() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or platform.machine()
