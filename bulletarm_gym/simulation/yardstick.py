"""Speed of plain PyBullet, with which speeds measured on different machines are compared."""

import timeit
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median
from typing import Any

import pybullet_data

from bulletarm_gym.simulation.client import Client

PIXELS = 128
"""Side of the rendered image (pixels)."""
CUBES = 4
"""Number of resting cubes."""
UNTIL_REST = 300
"""Number of simulation steps until the cubes rest."""
REPETITIONS = 5
"""Number of measurements, of which the median is the result."""


@dataclass(frozen=True)
class Yardstick:
    """Speed of plain PyBullet with a KUKA arm and four resting cubes.

    :param step_us: duration of a simulation step (microseconds)
    :param render_ms: duration of an image of 128 x 128 pixels by the software renderer (milliseconds)
    """

    step_us: float
    render_ms: float


def measure_yardstick(steps: int = 2000, pictures: int = 20) -> Yardstick:
    """Measure the speed of plain PyBullet on this machine.

    :param steps: number of simulation steps in each measurement
    :param pictures: number of images in each measurement
    """
    client = Client()
    try:
        _build_scene(client)
        view = client.computeViewMatrix([0.45, 0, 0.8], [0.45, 0, 0], [-1, 0, 0])
        projection = client.computeProjectionMatrixFOV(40, 1, 0.01, 2)
        image = (PIXELS, PIXELS, view, projection)
        step = _median_time(client.stepSimulation, steps)
        picture = _median_time(
            lambda: client.getCameraImage(*image, renderer=client.ER_TINY_RENDERER), pictures
        )
    finally:
        client.close()
    return Yardstick(step_us=step * 1e6, render_ms=picture * 1e3)


def _build_scene(client: Client) -> None:
    client.setAdditionalSearchPath(pybullet_data.getDataPath())
    client.setGravity(0, 0, -10)
    client.loadURDF("plane.urdf")
    client.loadSDF("kuka_iiwa/kuka_with_gripper2.sdf")
    for index in range(CUBES):
        client.loadURDF("cube_small.urdf", [0.4 + 0.08 * index, 0.08 * index, 0.03])
    for _ in range(UNTIL_REST):
        client.stepSimulation()


def _median_time(function: Callable[[], Any], calls: int) -> float:
    """Return the median over the measurements of the mean duration of a call (s)."""
    return median(timeit.repeat(function, number=calls, repeat=REPETITIONS)) / calls
