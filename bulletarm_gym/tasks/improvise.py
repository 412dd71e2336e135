"""Houses of blocks that are never the same."""

from collections.abc import Sequence

from bulletarm_gym.config import EnvConfig, TaskDefaults
from bulletarm_gym.objects.blocks import CELL, MAX_STRETCHED_CELLS, improvise_blocks, improvise_bricks, roof
from bulletarm_gym.scene import ObjectSlot
from bulletarm_gym.tasks.structure import SCALE, Part, Structure

BRICKS = 19
"""Sizes of bricks to be drawn from: as many as there are shapes of blocks."""


class ImproviseHouseBuilding2(Structure):
    """Put two blocks of random shapes side by side, and the roof on both.

    Description: two of 19 blocks of one layer, 3.6 to 9 cm wide and long, and a roof, 12 x 3 x 3 cm, lie on
    the ground.
    Randomisation: which blocks, of which sizes; their positions and yaws, at least 4.2 cm between any two.
    All else is as in :class:`~bulletarm_gym.tasks.structure.Structure`.
    """

    defaults = TaskDefaults(
        num_objects=3, max_steps=10, object_scale=SCALE, allowed_objects=(3,), close_loop={"max_steps": 100}
    )
    kinds = {"roof": roof}  # noqa: RUF012
    layers: Sequence[Sequence[str]] = (("block", "block"), ("roof",))
    upright = ("roof",)
    width = CELL * MAX_STRETCHED_CELLS

    def block(self, config: EnvConfig, part: Part) -> ObjectSlot:
        """Return a role that each of the 19 shapes may play."""
        if part.kind != "block":
            return super().block(config, part)
        shapes = [spec for scale in config.scales for spec in improvise_blocks(part.name, scale, part.number)]
        return ObjectSlot(part.name, tuple(shapes))


class ImproviseHouseBuilding3(ImproviseHouseBuilding2):
    """Put two blocks of random shapes side by side, a brick of random size on both, and the roof on it.

    Description: two of 19 blocks of one layer, 3.6 to 9 cm wide and long, a brick 2.5 to 3.5 cm wide, 10 to
    14 cm long and 2 to 3.5 cm high, and a roof, 12 x 3 x 3 cm, lie on the ground.
    All else is as in :class:`ImproviseHouseBuilding2`.
    """

    defaults = TaskDefaults(
        num_objects=4, max_steps=10, object_scale=SCALE, allowed_objects=(4,), close_loop={"max_steps": 100}
    )
    layers = (("block", "block"), ("brick",), ("roof",))

    def block(self, config: EnvConfig, part: Part) -> ObjectSlot:
        """Return a role that bricks of several sizes may play, or one of the other blocks."""
        if part.kind != "brick":
            return super().block(config, part)
        sizes = [spec for scale in config.scales for spec in improvise_bricks(part.name, scale, BRICKS)]
        return ObjectSlot(part.name, tuple(sizes))
