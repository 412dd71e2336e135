"""How fast a machine is in plain PyBullet, apart from our environments."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median
from typing import Any

from bulletarm_gym.simulation.client import Client

PIXELS = 128
"""A side of the picture that is drawn."""
CUBES = 4
UNTIL_REST = 300
"""Steps until the cubes rest."""
REPETITIONS = 5
"""Measurements of a figure, of which the median counts."""


@dataclass(frozen=True)
class Yardstick:
    """The machine's speed in plain PyBullet: a KUKA arm and four resting cubes.

    :param step_us: one simulation step (microseconds)
    :param render_ms: one picture of 128 x 128 pixels by the software renderer (milliseconds)
    """

    step_us: float
    render_ms: float


def measure_yardstick(steps: int = 2000, pictures: int = 20) -> Yardstick:
    """Measure the machine, apart from any environment.

    :param steps: simulation steps in each of five measurements
    :param pictures: pictures in each of five measurements
    :return: the median of five measurements of each figure
    """
    client = Client()
    try:
        _build_scene(client)
        view = client.computeViewMatrix([0.45, 0, 0.8], [0.45, 0, 0], [-1, 0, 0])
        lens = client.computeProjectionMatrixFOV(40, 1, 0.01, 2)
        renderer = client.ER_TINY_RENDERER
        step = _median_time(client.stepSimulation, steps)
        picture = _median_time(
            lambda: client.getCameraImage(PIXELS, PIXELS, view, lens, renderer=renderer), pictures
        )
    finally:
        client.close()
    return Yardstick(step_us=step * 1e6, render_ms=picture * 1e3)


def _build_scene(client: Client) -> None:
    import pybullet_data

    client.setAdditionalSearchPath(pybullet_data.getDataPath())
    client.setGravity(0, 0, -10)
    client.loadURDF("plane.urdf")
    client.loadSDF("kuka_iiwa/kuka_with_gripper2.sdf")
    for index in range(CUBES):
        client.loadURDF("cube_small.urdf", [0.4 + 0.08 * index, 0.08 * index, 0.03])
    for _ in range(UNTIL_REST):
        client.stepSimulation()


def _median_time(function: Callable[[], Any], calls: int) -> float:
    """Return the median over repetitions of the mean time of a call (s)."""
    times = []
    for _ in range(REPETITIONS):
        start = time.perf_counter()
        for _ in range(calls):
            function()
        times.append((time.perf_counter() - start) / calls)
    return median(times)
