"""Kinds of objects by name, built-in and registered, and the object sets of tasks."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

from bulletarm_gym.objects import blocks, containers
from bulletarm_gym.objects.files import load_folder
from bulletarm_gym.objects.graspables import graspables
from bulletarm_gym.objects.solids import laid_flat
from bulletarm_gym.registry import OBJECTS
from bulletarm_gym.simulation.shapes import BodySpec

Make = Callable[[str, float], BodySpec]


def _numbered(kind: str, make: Callable[..., BodySpec], count: int) -> dict[str, Make]:
    return {f"{kind}_{number}": partial(make, number=number) for number in range(count)}


KINDS: Mapping[str, Make] = {
    "bottle_tray": containers.bottle_tray,
    "bowl": containers.bowl,
    "brick": blocks.brick,
    "cube": blocks.cube,
    "cylinder": blocks.upright_cylinder,
    "flat_block": blocks.flat_block,
    "new_tube_box": containers.new_tube_box,
    "packing_bin": containers.packing_bin,
    "pallet": containers.pallet,
    "palletizing_box": blocks.palletizing_box,
    "roof": blocks.roof,
    "swab": containers.swab,
    "test_area": containers.test_area,
    "triangle": blocks.triangle,
    "tube": containers.tube,
    "used_tube": containers.used_tube,
    "used_tube_box": containers.used_tube_box,
    **_numbered("bottle", containers.bottle, len(containers.BOTTLES)),
    **_numbered("improvise_block", blocks.improvise_block, len(blocks.DRAWINGS)),
    **_numbered("packing_block", blocks.packing_block, len(blocks.SHAPES)),
}
"""Built-in kinds of objects."""


def create(kind: str, name: str, scale: float = 1.0) -> BodySpec:
    """Return an object of a kind.

    :param kind: one of :data:`KINDS`, a name registered by :func:`bulletarm_gym.register_object`, or the
        import path ``"module:function"`` of a function that could be registered
    :param name: name of the object, unique in its scene
    :param scale: factor on its nominal size
    :raises ValueError: the kind is unknown, or its function does not return a body with a volume
    """
    path = OBJECTS.path(kind)
    made = OBJECTS.find(kind, "kind")(name, scale)
    if not isinstance(made, BodySpec):
        raise ValueError(f"object {kind!r}: {path} must return a BodySpec, got a {type(made).__name__}")
    if not made.pieces:
        raise ValueError(f"object {kind!r}: pieces must be at least one piece, got none")
    if not made.is_mark and min(made.extents) <= 0.0:
        raise ValueError(f"object {kind!r}: sides must be positive (m), got {made.extents}")
    return made


def object_set(source: str | Sequence[str] | None) -> tuple[BodySpec, ...]:
    """Return the objects of a set, always in the same order.

    :param source: None for the 86 built-in objects, a folder of OBJ, STL or URDF files, or a list of kinds,
        see :func:`create`; a kind that is listed n times makes n objects
    :raises ValueError: no file of the folder can be loaded; a kind is unknown or fixed
    """
    if source is None:
        return graspables()
    if isinstance(source, str):
        return load_folder(source)
    return tuple(_of_kind(kind, source[:place].count(kind)) for place, kind in enumerate(source))


def _of_kind(kind: str, number: int) -> BodySpec:
    """Return an object of a kind in nominal size and its resting frame."""
    try:
        spec = create(kind, f"{kind} {number}")
    except ValueError as error:
        raise ValueError(f"object_set: {error}") from error
    if spec.mass == 0.0 or spec.parts or spec.is_mark:
        raise ValueError(f"object_set: kinds must be of loose objects, got {kind!r}, which is fixed")
    return replace(spec, pieces=laid_flat(spec.pieces))
