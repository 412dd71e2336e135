"""Draw the 86 objects of Object Grasping: ``python examples/draw_objects.py docs/images/objects.png``."""

import argparse
from pathlib import Path

import imageio.v3 as imageio

from bulletarm_gym.geometry import Pose
from bulletarm_gym.objects.graspables import graspables
from bulletarm_gym.simulation import Camera, World
from bulletarm_gym.simulation.world import PHYSICS_MODES
from bulletarm_gym.surfaces.flat import FLOOR

COLUMNS = 15
PITCH = 0.17
"""Distance (m) between the objects."""


def main() -> None:
    """Lay the objects out in rows and take a picture from above."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("output", type=Path, help="the picture to write")
    output: Path = parser.parse_args().output
    world = World(PHYSICS_MODES["fast"])
    world.add_plane(FLOOR)
    for index, spec in enumerate(graspables()):
        row, column = divmod(index, COLUMNS)
        x, y = PITCH * (row - 2.5), PITCH * (column - (COLUMNS - 1) / 2.0)
        world.place(world.add(spec), Pose((x, y, spec.extents[2] / 2.0)))
    camera = Camera((0.7, 0.0, 2.5), (0.02, 0.0, 0.0), fov=25.0, width=1500, height=640)
    imageio.imwrite(output, camera.color(world))
    world.close()
    print(f"wrote {output}")


if __name__ == "__main__":
    main()
