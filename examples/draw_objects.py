"""Draw a set of objects: ``python examples/draw_objects.py grasping docs/images/objects.png``."""

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

import imageio.v3 as imageio

from bulletarm_gym.geometry import Pose
from bulletarm_gym.objects import create
from bulletarm_gym.objects.blocks import SHAPES, improvise_blocks
from bulletarm_gym.objects.containers import BOTTLES
from bulletarm_gym.objects.graspables import graspables
from bulletarm_gym.simulation import BodySpec, Camera, World
from bulletarm_gym.simulation.state import PHYSICS_MODES
from bulletarm_gym.surfaces.surface import FLOOR

BLOCKS = ("cube", "brick", "triangle", "roof", "cylinder")
COVID = ("swab", "tube", "used_tube", "new_tube_box", "used_tube_box", "test_area")
STORAGE = ("palletizing_box", "pallet", "packing_bin", "bottle_tray")
SETS: dict[str, tuple[Callable[[], Sequence[BodySpec]], int]] = {
    "grasping": (graspables, 15),
    "blocks": (lambda: [create(kind, kind, 0.6) for kind in BLOCKS], 5),
    "improvise": (lambda: improvise_blocks("block", 0.6, series=0), 10),
    "packing": (lambda: [create(f"packing_block_{n}", str(n), 0.8) for n in range(len(SHAPES))], 7),
    "bottles": (lambda: [create(f"bottle_{n}", str(n), 0.8) for n in range(len(BOTTLES))], 8),
    "storage": (lambda: [create(k, k, 0.8 if k == "palletizing_box" else 1.0) for k in STORAGE], 4),
    "covid": (lambda: [create(k, k, 1.0 if k.endswith(("box", "area")) else 0.6) for k in COVID], 6),
}
"""Function that creates the objects of a set, and the number of objects in a row."""
WIDTH = 1500


def main() -> None:
    """Place the objects in rows and render an image from above."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("set", choices=SETS, help="set of objects")
    parser.add_argument("output", type=Path, help="image file to write")
    arguments = parser.parse_args()
    make, columns = SETS[arguments.set]
    world = World(PHYSICS_MODES["fast"])
    world.add_plane(FLOOR)
    extent = lay_out(world, make(), columns)
    imageio.imwrite(arguments.output, render(world, *extent))
    world.close()
    print(f"wrote {arguments.output}")


def lay_out(world: World, specs: Sequence[BodySpec], columns: int) -> tuple[float, float]:
    """Place objects in rows. Return the lengths (m) of the columns and of the rows."""
    pitch = 0.03 + max(max(spec.extents[:2]) for spec in specs)
    rows = -(-len(specs) // columns)
    for index, spec in enumerate(specs):
        row, column = divmod(index, columns)
        low, high = spec.mesh.bounds
        x, y = pitch * (row - (rows - 1) / 2.0), pitch * (column - (columns - 1) / 2.0)
        middle = (low + high) / 2.0
        world.place(world.add(spec), Pose((x - middle[0], y - middle[1], -float(low[2]))))
    return pitch * rows, pitch * columns


def render(world: World, length: float, width: float) -> object:
    """Return an image (height, width, 3) of the objects around the origin, from the front and above."""
    distance = 2.5 * width
    height = int(WIDTH * min(1.0, (0.95 * length + 0.08) / width))
    eye = (0.3 * distance, 0.0, 0.95 * distance)
    fov, far = 25.0 * height / WIDTH, 2.0 * distance
    return Camera(eye, (0.0, 0.0, 0.0), fov, WIDTH, height, far=far, shadow=False).color(world)


if __name__ == "__main__":
    main()
