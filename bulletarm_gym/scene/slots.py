"""Slots of a task for objects, and the bodies that can fill them."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from bulletarm_gym.config import EnvConfig
from bulletarm_gym.simulation import BodySpec

GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0
"""Golden ratio, whose multiples are spread evenly over the unit interval modulo 1."""


@dataclass(frozen=True)
class ObjectSlot:
    """Slot of a task for one object, and the bodies that can fill it.

    :param variants: bodies of different sizes or shapes, of which one is sampled at every reset; the smallest
        size first, each size in all shapes, in the same order
    :param kind: property that slots of a task share: the kind of block, the colour
    :param scales: scale of each variant; empty if the object has one size
    :param like: name of an earlier slot with the same number of variants. Both slots always have the same
        variant, such as a peg and its socket
    """

    name: str
    variants: tuple[BodySpec, ...]
    kind: str = ""
    scales: tuple[float, ...] = ()
    like: str = ""


def scaled(
    config: EnvConfig, name: str, make: Callable[[str, float], BodySpec], kind: str = "", like: str = ""
) -> ObjectSlot:
    """Return a slot with one variant, ``make(name, scale)``, for every scale of the configuration.

    :param like: name of an earlier slot whose sampled scale this slot has, too
    """
    scales = tuple(config.scales)
    return ObjectSlot(name, tuple(make(f"{name} {scale:g}", scale) for scale in scales), kind, scales, like)


def shaped(
    config: EnvConfig, name: str, make: Callable[[str, float, int], BodySpec], shapes: int
) -> ObjectSlot:
    """Return a slot with the variants ``make(name, scale, number)`` for every scale and number of a shape."""
    kinds = [(scale, kind) for scale in config.scales for kind in range(shapes)]
    variants = tuple(make(f"{name} {kind} {scale:g}", scale, kind) for scale, kind in kinds)
    return ObjectSlot(name, variants, scales=tuple(scale for scale, _ in kinds))


def subsample_variants(slots: Sequence[ObjectSlot], limit: int) -> list[list[int]]:
    """Return the sorted indices of the chosen variants of each slot, at most ``limit`` if slots permit.

    Slots with few variants keep all. The others keep the same number, spread evenly over shapes and sizes. A
    slot continues where the previous one ended, so that together they keep many different variants.
    """
    counts = [len(slot.variants) for slot in slots]
    kept = max(counts, default=1)
    while kept > 1 and sum(min(count, kept) for count in counts) > limit:
        kept -= 1
    chosen, first = [], 0
    for count in counts:
        if count <= kept:
            chosen.append(list(range(count)))
            continue
        # A step coprime to the number of variants is coprime to that of shapes, so that these alternate.
        step = next(s for s in range(round(GOLDEN * count), count) if math.gcd(s, count) == 1)
        chosen.append(sorted((first + number) * step % count for number in range(kept)))
        first += kept
    return chosen


def matching_slots(loaded: Sequence[ObjectSlot], slots: Sequence[ObjectSlot]) -> list[str]:
    """Return the names of the loaded slots with the names, or else the kinds, of other slots.

    :param slots: slots of the same task with fewer objects
    :raises ValueError: no loaded slot is left for one of them
    """
    free = {slot.name: slot for slot in loaded}
    names = []
    for slot in slots:
        alike = (name for name, other in free.items() if slot.kind and other.kind == slot.kind)
        name = slot.name if slot.name in free else next(alike, "")
        if not name:
            raise ValueError(f"num_objects must lead to slots that are loaded, got {slot.name!r}")
        names.append(name)
        del free[name]
    return names
