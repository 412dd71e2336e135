"""Measure the CPU time of observations of cameras of 128 x 128 pixels: python tools/measure_cameras.py.

The table has, for each arm, the number of triangles of its visual meshes and the median CPU time (ms) of
``env.unwrapped.observe()`` with these sensors.
"""

import statistics
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium

import bulletarm_gym  # noqa: F401 (registers the environments)
from bulletarm_gym.check.machine import describe_machine
from bulletarm_gym.simulation.shapes import mesh_parts
from zoo_configs.drawing.tables import markdown_table

ENV_ID = "BulletArm/CloseLoopBlockPicking-v0"
ROBOTS = ("kuka", "panda", "ur5")
REPETITIONS = 25
FRONT: dict[str, Any] = {"name": "front", "sensor": "rgb", "size": 128}
WRIST = {**FRONT, "name": "wrist", "mount": "wrist"}
SIDE = {**FRONT, "name": "side", "position": [0.45, 0.6, 0.3], "target": [0.45, 0.0, 0.05]}
PLAIN = {"shadow": False}
SENSORS: dict[str, list[dict[str, Any]]] = {
    "1 color, shadows": [FRONT],
    "1 color": [{**FRONT, **PLAIN}],
    "1 color and depth": [{**FRONT, **PLAIN}, {**FRONT, "name": "depth", "sensor": "depth"}],
    "2 color": [{**FRONT, **PLAIN}, {**WRIST, **PLAIN}],
    "3 color, shadows": [FRONT, WRIST, SIDE],
}


def milliseconds(robot: str, sensors: list[dict[str, Any]]) -> float:
    """Return the median CPU time (ms) of an observation."""
    with closing(gymnasium.make(ENV_ID, robot=robot, observation=sensors)) as env:
        env.reset(seed=0)
        core: Any = env.unwrapped
        times = []
        for _ in range(REPETITIONS):
            start = time.process_time()
            core.observe()
            times.append(1e3 * (time.process_time() - start))
    return statistics.median(times)


def triangles(robot: str) -> int:
    """Return the number of triangles of the visual meshes of an arm."""
    with closing(gymnasium.make(ENV_ID, robot=robot)) as env:
        scene = env.unwrapped.scene  # type: ignore[attr-defined]
        shapes = scene.world.client.getVisualShapeData(scene.robot.body.id)
        files = [Path(shape[4].decode()) for shape in shapes if shape[4]]
        return sum(len(points) // 3 for file in files for _, points in mesh_parts(file))


def main() -> None:
    """Print the table."""
    rows = []
    for robot in ROBOTS:
        times = [f"{milliseconds(robot, sensors):.0f}" for sensors in SENSORS.values()]
        rows.append([f"`{robot}`", str(triangles(robot)), *times])
    print(markdown_table(["arm", "triangles", *SENSORS], rows))
    print(f"\n{describe_machine()}")


if __name__ == "__main__":
    main()
