"""Speed of plain PyBullet, with which speeds measured on different machines are compared."""

import timeit
from statistics import median

import pybullet_data

from bulletarm_gym.simulation.client import Client

CUBES = 4
"""Number of resting cubes."""
UNTIL_REST = 300
"""Number of simulation steps until the cubes rest."""
REPETITIONS = 5
"""Number of measurements, of which the median is the result."""


def measure_yardstick(steps: int = 2000) -> float:
    """Return the duration (microseconds) of a simulation step with a KUKA arm and four resting cubes.

    :param steps: number of simulation steps in each measurement
    """
    client = Client()
    try:
        client.setAdditionalSearchPath(pybullet_data.getDataPath())
        client.setGravity(0, 0, -10)
        client.loadURDF("plane.urdf")
        client.loadSDF("kuka_iiwa/kuka_with_gripper2.sdf")
        for index in range(CUBES):
            client.loadURDF("cube_small.urdf", [0.4 + 0.08 * index, 0.08 * index, 0.03])
        for _ in range(UNTIL_REST):
            client.stepSimulation()
        return 1e6 * median(timeit.repeat(client.stepSimulation, number=steps, repeat=REPETITIONS)) / steps
    finally:
        client.close()
