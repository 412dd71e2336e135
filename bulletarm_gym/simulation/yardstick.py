"""Speed of plain PyBullet, with which speeds measured on different machines are compared."""

import timeit
from statistics import median

import pybullet_data

from bulletarm_gym.simulation.client import Client


def measure_yardstick(steps: int = 2000) -> float:
    """Return the duration (microseconds) of a simulation step with a KUKA arm and four resting cubes.

    :param steps: number of simulation steps in each of five measurements, of which the median is returned
    """
    client = Client()
    try:
        client.setAdditionalSearchPath(pybullet_data.getDataPath())
        client.setGravity(0, 0, -10)
        client.loadURDF("plane.urdf")
        client.loadSDF("kuka_iiwa/kuka_with_gripper2.sdf")
        for index in range(4):
            client.loadURDF("cube_small.urdf", [0.4 + 0.08 * index, 0.08 * index, 0.03])
        for _ in range(300):  # until the cubes rest
            client.stepSimulation()
        return 1e6 * median(timeit.repeat(client.stepSimulation, number=steps, repeat=5)) / steps
    finally:
        client.close()
