"""Which objects a task draws from: the 86 made by code, a user's files, or some kinds."""

from collections.abc import Sequence
from dataclasses import replace

from bulletarm_gym.objects.catalogue import create
from bulletarm_gym.objects.folder import load_folder
from bulletarm_gym.objects.graspables import graspables
from bulletarm_gym.objects.solids import settled
from bulletarm_gym.simulation.shapes import BodySpec


def object_set(source: str | Sequence[str] | None) -> tuple[BodySpec, ...]:
    """Return the objects of a set, always in the same order.

    :param source: None for the 86, a folder of OBJ, STL or URDF files, or a list of kinds, see
        :func:`bulletarm_gym.objects.create`; a kind that is listed n times makes n objects
    :raises ValueError: the folder has no file that can be loaded; there is no such kind, or it stands fixed
    """
    if source is None:
        return graspables()
    if isinstance(source, str):
        return load_folder(source)
    return tuple(_of_kind(kind, source[:place].count(kind)) for place, kind in enumerate(source))


def _of_kind(kind: str, number: int) -> BodySpec:
    """Return an object of a kind in nominal size, lying as all of a set do, of its own mass and friction."""
    try:
        spec = create(kind, f"{kind} {number}")
    except ValueError as error:
        raise ValueError(f"object_set: {error}") from error
    if spec.mass == 0.0 or spec.parts or spec.is_mark:
        raise ValueError(f"object_set: {kind!r} stands fixed; it takes kinds of loose objects")
    return replace(spec, pieces=settled(spec.pieces))
