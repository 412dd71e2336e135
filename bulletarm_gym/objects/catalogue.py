"""Objects by the name of their kind: ours and those that users register."""

from collections.abc import Callable, Mapping

from bulletarm_gym.extensions import OBJECT_PATHS, load
from bulletarm_gym.objects.blocks import cube, flat_block, triangle
from bulletarm_gym.objects.bowl import bowl
from bulletarm_gym.simulation.shapes import BodySpec

KINDS: Mapping[str, Callable[[str, float], BodySpec]] = {
    "bowl": bowl,
    "cube": cube,
    "flat_block": flat_block,
    "triangle": triangle,
}
"""What there is besides users' objects."""


def create(kind: str, name: str, scale: float = 1.0) -> BodySpec:
    """Return an object of a kind.

    :param kind: one of :data:`KINDS`, or a name given to :func:`bulletarm_gym.register_object`
    :param name: of the object, unique in its scene
    :param scale: times its nominal size
    :raises ValueError: there is no such kind, or it makes something else
    """
    if kind not in KINDS and kind not in OBJECT_PATHS:
        known = ", ".join(repr(other) for other in (*KINDS, *OBJECT_PATHS))
        raise ValueError(f"kind: got {kind!r}, takes one of {known}")
    made = (KINDS[kind] if kind in KINDS else load(OBJECT_PATHS[kind]))(name, scale)
    if not isinstance(made, BodySpec):
        raise ValueError(
            f"object {kind!r}: {OBJECT_PATHS[kind]} returned a {type(made).__name__}, not a BodySpec"
        )
    return made
