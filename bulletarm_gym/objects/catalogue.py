"""Objects by the name of their kind: ours and those that users register."""

from collections.abc import Callable, Mapping
from functools import partial

from bulletarm_gym.objects import blocks, bottles, covid, packing, palletizing
from bulletarm_gym.objects.bowl import bowl
from bulletarm_gym.objects.polyominoes import DRAWINGS, improvise_block
from bulletarm_gym.registry import OBJECTS
from bulletarm_gym.simulation.shapes import BodySpec

Make = Callable[[str, float], BodySpec]


def _numbered(kind: str, make: Callable[..., BodySpec], count: int) -> dict[str, Make]:
    return {f"{kind}_{number}": partial(make, number=number) for number in range(count)}


KINDS: Mapping[str, Make] = {
    "bottle_tray": bottles.bottle_tray,
    "bowl": bowl,
    "brick": blocks.brick,
    "cube": blocks.cube,
    "cylinder": blocks.cylinder,
    "flat_block": blocks.flat_block,
    "new_tube_box": covid.new_tube_box,
    "packing_bin": packing.packing_bin,
    "pallet": palletizing.pallet,
    "palletizing_box": palletizing.palletizing_box,
    "roof": blocks.roof,
    "swab": covid.swab,
    "test_area": covid.test_area,
    "triangle": blocks.triangle,
    "tube": covid.tube,
    "used_tube": covid.used_tube,
    "used_tube_box": covid.used_tube_box,
    **_numbered("bottle", bottles.bottle, len(bottles.BOTTLES)),
    **_numbered("improvise_block", improvise_block, len(DRAWINGS)),
    **_numbered("packing_block", packing.packing_block, len(packing.SHAPES)),
}
"""What there is besides users' objects."""


def create(kind: str, name: str, scale: float = 1.0) -> BodySpec:
    """Return an object of a kind.

    :param kind: one of :data:`KINDS`, a name given to :func:`bulletarm_gym.register_object`, or the path
        ``"module:function"`` of what could be given to it
    :param name: of the object, unique in its scene
    :param scale: times its nominal size
    :raises ValueError: there is no such kind, or it makes something else
    """
    path = OBJECTS.path(kind)
    made = OBJECTS.find(kind, "kind")(name, scale)
    if not isinstance(made, BodySpec):
        raise ValueError(f"object {kind!r}: {path} returned a {type(made).__name__}, not a BodySpec")
    if not made.pieces:
        raise ValueError(f"object {kind!r}: pieces must be at least one piece, got none")
    if not made.is_mark and min(made.extents) <= 0.0:
        raise ValueError(f"object {kind!r}: sides must be positive (m), got {made.extents}")
    return made
