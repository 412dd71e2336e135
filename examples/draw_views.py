"""Draw the two views of closed-loop control side by side: python examples/draw_views.py [FILE]."""

import sys
from pathlib import Path

import gymnasium
import matplotlib.pyplot as plt
import numpy as np

import bulletarm_gym  # noqa: F401 (registers the environments)

ENV_ID = "BulletArm/CloseLoopBlockInBowl-v0"
SEED = 4
STEPS = 2  # of the expert, so that the gripper hides something


def main(path: Path) -> None:
    """Write an image with both views and the pixels that differ by more than 2 mm."""
    images = [look(view) for view in ("orthographic", "point_cloud")]
    titles = ("orthographic", "point cloud of two side cameras", "differing by more than 2 mm")
    panels = [*images, np.abs(images[0] - images[1]) > 0.002]
    figure, axes = plt.subplots(1, 3, figsize=(10.5, 3.8), constrained_layout=True)
    for axis, title, panel in zip(axes, titles, panels, strict=True):
        axis.imshow(panel, cmap="viridis_r" if panel.dtype != bool else "gray")
        axis.set(title=title, xlabel="column, world y", ylabel="row, world x", xticks=[], yticks=[])
    figure.savefig(path, dpi=110)


def look(view: str) -> np.ndarray:
    """Return the heightmap after some steps of the expert."""
    env = gymnasium.make(ENV_ID, view=view)
    observation, _ = env.reset(seed=SEED)
    for _ in range(STEPS):
        observation, *_ = env.step(env.unwrapped.expert_action())
    env.close()
    return observation["heightmap"][0]


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path("docs/images/views.png"))
