"""Share of the default workspaces that each arm reaches inside its joint limits.

python tools/reach.py                 print a table of the built-in arms
python tools/reach.py --search kuka   compare bases over x, z and mounting yaw
"""

import argparse
import itertools
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bulletarm_gym.check.robot import TILT, grid, reach_share
from bulletarm_gym.config import CLOSE_LOOP, OPEN_LOOP, WORKSPACES
from bulletarm_gym.geometry import Pose
from bulletarm_gym.robots import ROBOTS, RobotModel

POINTS = 9
"""Number of positions along each side of a workspace."""
HEIGHTS = {CLOSE_LOOP: (0.01, 0.07, 0.13, 0.19, 0.25), OPEN_LOOP: (0.02, 0.1, 0.2, 0.35)}
"""Heights (m) of the upright fingertips."""
TILTED_HEIGHTS = (0.02, 0.1, 0.2)
"""Heights (m) of the tilted fingertips."""


def share(model: RobotModel, control: str, tilt: float = 0.0) -> float:
    """Return the share of the poses of a workspace that an arm reaches inside its joint limits."""
    heights = HEIGHTS[control] if tilt == 0.0 else TILTED_HEIGHTS
    return reach_share(model, grid(WORKSPACES[control], heights, POINTS, tilt))


def shares(model: RobotModel) -> tuple[float, ...]:
    """Return the shares of the closed-loop and the open-loop workspace, upright and tilted by 30 degrees."""
    return tuple(share(model, control, tilt) for control in (CLOSE_LOOP, OPEN_LOOP) for tilt in (0.0, TILT))


def table() -> None:
    """Print the shares of all arms."""
    print("| arm | base (m) | closed loop | tilted 30 degrees | open loop | tilted 30 degrees |")
    print("|---|---|---:|---:|---:|---:|")
    for name, model in ROBOTS.items():
        position = ", ".join(f"{value:g}" for value in model.base.position)
        print(f"| {name} | ({position}) | " + " | ".join(f"{value:.1%}" for value in shares(model)) + " |")


def search(name: str, xs: Sequence[float], zs: Sequence[float], yaws: Sequence[float]) -> None:
    """Print the ten bases with the largest sums of shares."""
    model = ROBOTS[name]
    rows = []
    for x, z, yaw in itertools.product(xs, zs, yaws):
        found = shares(replace(model, base=Pose.planar(x, 0.0, z, yaw)))
        rows.append((sum(found), x, z, yaw, found))
    for _, x, z, yaw, found in sorted(rows, reverse=True)[:10]:
        print(f"x {x:g} z {z:g} yaw {yaw:.2f}: " + " ".join(f"{value:.1%}" for value in found))


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--search", choices=ROBOTS, metavar="ARM", help=f"one of {', '.join(ROBOTS)}")
    args = parser.parse_args()
    if args.search is None:
        table()
    else:
        grid = np.arange(-0.25, 0.11, 0.05).round(2).tolist(), np.arange(0.0, 0.31, 0.05).round(2).tolist()
        search(args.search, *grid, (0.0, math.pi / 4.0))


if __name__ == "__main__":
    main()
