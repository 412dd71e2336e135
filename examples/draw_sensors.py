"""Draw what all sensors see of one scene: python examples/draw_sensors.py [FILE]."""

import sys
from pathlib import Path
from typing import Any

import gymnasium
import matplotlib.pyplot as plt
import numpy as np

import bulletarm_gym  # noqa: F401 (registers the environments)

ENV_ID = "BulletArm/CloseLoopBlockSorting-v0"
SEED = 2
STEPS = 14  # of the expert, so that a bowl has its cube
SIDE = {"name": "side", "sensor": "rgb", "position": [0.45, 0.55, 0.35], "target": [0.45, 0.0, 0.03]}
SENSORS: list[Any] = [
    "heightmap",
    "color",
    "segmentation",
    {"name": "rgb", "size": 256},
    {**SIDE, "size": 256},
    {"name": "point_cloud", "points": 2048},
]


def main(path: Path) -> None:
    """Write an image with a panel for each sensor."""
    observation = observe()
    figure, axes = plt.subplots(2, 3, figsize=(10.5, 7.2), constrained_layout=True)
    for axis, (name, values) in zip(axes.flat, observation.items(), strict=True):
        if name == "point_cloud":
            x, y, z = values.T
            axis.scatter(y, x, c=z, s=2)
            axis.set(xlim=(-0.225, 0.225), ylim=(0.225, -0.225), aspect="equal")
        elif len(values) == 3:
            axis.imshow(values.transpose(1, 2, 0))
        else:
            axis.imshow(
                numbered(values[0]) if values.dtype == np.uint8 else values[0],
                cmap="tab10" if values.dtype == np.uint8 else "viridis_r",
            )
        axis.set(title=name, xticks=[], yticks=[])
    figure.savefig(path, dpi=100)


def numbered(image: np.ndarray) -> np.ndarray:
    """Replace the values of an image by consecutive numbers, so that each has its own colour."""
    return np.unique(image, return_inverse=True)[1].reshape(image.shape)


def observe() -> dict[str, np.ndarray]:
    """Return the observation after some steps of the expert."""
    env = gymnasium.make(ENV_ID, observation=SENSORS)
    observation, _ = env.reset(seed=SEED)
    for _ in range(STEPS):
        observation, *_ = env.step(env.unwrapped.expert_action())
    env.close()
    return observation


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path("docs/images/sensors.png"))
