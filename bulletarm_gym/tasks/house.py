"""Building houses."""

import math
from collections.abc import Sequence

from bulletarm_gym.config import TaskDefaults
from bulletarm_gym.objects.blocks import brick, cube, roof, triangle
from bulletarm_gym.tasks.stacking import Stack
from bulletarm_gym.tasks.structure import SCALE, Structure


class HouseBuilding1(Stack):
    """Stack the cubes, and put the triangle on top.

    Description: three (one to five) 3 cm cubes and a triangle, 3 x 3 x 3 cm, lie on the ground; in
    the paper's close-loop House Building a cube of 5 cm and a triangle as large.
    Randomisation: the blocks' positions and yaws, in open loop at least 4.2 cm between any two, in close loop
    at least 2.4 sides apart and yaws within 90 degrees either way.
    Success: the cubes form a stack, on top the triangle, upright; the gripper is empty and nothing moves.
    Expert: in open loop pick a cube, the triangle last, and place it on the tallest stack there is, in close
    loop grasp it, up, over the stack, down, open; and so on.
    All else is as in :class:`~bulletarm_gym.tasks.stacking.Stack`.
    """

    kinds = {"cube": cube, "triangle": triangle}  # noqa: RUF012
    upright = ("triangle",)
    crown = "triangle"
    spread = math.pi / 2.0


class HouseBuilding2(Structure):
    """Put two cubes side by side, and the roof on both.

    Description: two 3 cm cubes and a roof, 12 x 3 x 3 cm, lie on the ground.
    All else is as in :class:`~bulletarm_gym.tasks.structure.Structure`.
    """

    defaults = TaskDefaults(
        num_objects=3, max_steps=10, object_scale=SCALE, allowed_objects=(3,), close_loop={"max_steps": 100}
    )
    kinds = {"cube": cube, "roof": roof}  # noqa: RUF012
    layers: Sequence[Sequence[str]] = (("cube", "cube"), ("roof",))
    upright = ("roof",)


class HouseBuilding3(HouseBuilding2):
    """Put two cubes side by side, the brick on both, and the roof on the brick.

    Description: two 3 cm cubes, a brick and a roof, 12 x 3 x 3 cm each, lie on the ground.
    All else is as in :class:`~bulletarm_gym.tasks.structure.Structure`.
    """

    defaults = TaskDefaults(
        num_objects=4, max_steps=10, object_scale=SCALE, allowed_objects=(4,), close_loop={"max_steps": 100}
    )
    kinds = {**HouseBuilding2.kinds, "brick": brick}  # noqa: RUF012
    layers: Sequence[Sequence[str]] = (("cube", "cube"), ("brick",), ("roof",))


class HouseBuilding4(HouseBuilding3):
    """Put two cubes side by side, the brick on both, two more cubes on the brick, and the roof on those.

    Description: four 3 cm cubes, a brick and a roof, 12 x 3 x 3 cm each, lie on the ground.
    All else is as in :class:`~bulletarm_gym.tasks.structure.Structure`.
    """

    defaults = TaskDefaults(
        num_objects=6, max_steps=20, object_scale=SCALE, allowed_objects=(6,), close_loop={"max_steps": 200}
    )
    layers = (("cube", "cube"), ("brick",), ("cube", "cube"), ("roof",))
