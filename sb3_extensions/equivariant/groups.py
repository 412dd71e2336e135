"""Finite groups of the plane, their real representations, and the types of feature fields.

Conventions, used by every equivariant layer: an image's row is world x, its column world y. A rotation by
``theta`` about z takes (x, y) to (cos(theta) x - sin(theta) y, sin(theta) x + cos(theta) y); by +90 degrees
it takes (x, y) to (-y, x) and turns an array by ``np.rot90(image, k=1, axes=(rows, columns))``. The
reflection of a dihedral group takes (x, y) to (x, -y) and turns a rotation about z into its opposite; an
array's columns are flipped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from operator import itemgetter

import numpy as np
import numpy.typing as npt

Matrices = npt.NDArray[np.float64]

GROUP_FAMILIES = ("cyclic", "dihedral")


@dataclass(frozen=True)
class Group:
    """The cyclic group C_n (rotations by multiples of 2 pi / n) or the dihedral group D_n (and their
    reflections).

    Element ``i`` is the rotation by ``2 pi (i mod n) / n``, after the reflection if ``i >= n``.

    :param family: ``"cyclic"`` or ``"dihedral"``
    :param n: number of rotations, at least 1
    :raises ValueError: if the family is another or ``n < 1``
    """

    family: str
    n: int

    def __post_init__(self) -> None:
        if self.family not in GROUP_FAMILIES:
            raise ValueError(f"group must be one of {GROUP_FAMILIES}, got {self.family!r}")
        if self.n < 1:
            raise ValueError(f"n, the number of rotations, must be at least 1, got {self.n}")

    @property
    def order(self) -> int:
        """Number of elements."""
        return self.n if self.family == "cyclic" else 2 * self.n

    def angle(self, element: int) -> float:
        """Rotation angle of an element, rad."""
        return 2 * np.pi * (element % self.n) / self.n

    def reflects(self, element: int) -> bool:
        """Whether the element contains the reflection."""
        return element >= self.n

    def product(self, first: int, second: int) -> int:
        """The element that acts as ``second`` and then ``first``."""
        turn = -second if self.reflects(first) else second
        return (first + turn) % self.n + self.n * (self.reflects(first) != self.reflects(second))

    @property
    def trivial(self) -> Representation:
        """One number that every element leaves alone."""
        return Representation(self, "trivial")

    @property
    def sign(self) -> Representation:
        """One number whose sign a reflection changes; the same as trivial for a cyclic group."""
        return Representation(self, "sign" if self.family == "dihedral" else "trivial")

    @property
    def regular(self) -> Representation:
        """One number for each element, permuted by the group."""
        return Representation(self, "regular")

    def quotient(self, m: int) -> Representation:
        """One number for each coset of the subgroup C_m of rotations, permuted by the group.

        Number ``i < n / m`` is the coset of the rotation by ``2 pi i / n``; those of a dihedral group's
        elements with the reflection follow in the same order. Of C_32 with ``m = 2``, number ``i`` means a
        gripper's yaw of ``i pi / 16`` modulo pi. With ``m = 1`` it acts as the regular representation.

        :param m: order of the subgroup, a divisor of n
        :raises ValueError: if m does not divide n
        """
        if m < 1 or self.n % m:
            raise ValueError(f"m, the order of the subgroup, must divide n = {self.n}, got {m}")
        return Representation(self, "quotient", subgroup=m)

    def irrep(self, frequency: int) -> Representation:
        """Two numbers turned by ``frequency`` times the angle; frequency 1 is a vector (x, y).

        For frequencies of 0 or n / 2 modulo n the two numbers fall apart into one-dimensional irreps.

        :param frequency: at least 0
        """
        return Representation(self, "irrep", frequency)


@dataclass(frozen=True)
class Representation:
    """An orthogonal representation of a group.

    :param group: the group
    :param kind: ``"trivial"``, ``"sign"``, ``"regular"``, ``"quotient"`` or ``"irrep"``
    :param frequency: of an irrep
    :param subgroup: of a quotient, order of the subgroup of rotations
    """

    group: Group
    kind: str
    frequency: int = 0
    subgroup: int = 1

    @property
    def size(self) -> int:
        """Numbers in one field."""
        cosets = self.group.order // self.subgroup
        return {"trivial": 1, "sign": 1, "irrep": 2, "regular": cosets, "quotient": cosets}[self.kind]

    @property
    def is_permutation(self) -> bool:
        """Whether a nonlinearity may act on each number alone."""
        return self.kind in ("regular", "quotient", "trivial")

    @cached_property
    def matrices(self) -> Matrices:
        """One orthogonal matrix an element: (order, size, size)."""
        return np.stack([self._matrix(element) for element in range(self.group.order)])

    def _matrix(self, element: int) -> Matrices:
        if self.kind in ("regular", "quotient"):
            return np.eye(self.size)[:, self._images(element)]
        mirror = -1.0 if self.group.reflects(element) else 1.0
        if self.kind == "irrep":
            angle = self.frequency * self.group.angle(element)
            cos, sin = np.cos(angle), np.sin(angle)
            return np.array([[cos, -sin * mirror], [sin, cos * mirror]])
        return np.array([[mirror if self.kind == "sign" else 1.0]])

    def _images(self, element: int) -> list[int]:
        """The coset to which an element takes each; those of a regular representation are single elements."""
        group, turns = self.group, self.group.n // self.subgroup
        first = [start + turn for start in range(0, group.order, group.n) for turn in range(turns)]
        images = [group.product(element, other) for other in first]
        return [image % group.n % turns + turns * group.reflects(image) for image in images]


@dataclass(frozen=True)
class FieldType:
    """What the channels of a feature map are: ``count`` fields of each representation, one after the other.

    The numbers of one field are neighbouring channels.

    :param fields: pairs (representation, count), all of one group; empty pairs are dropped, neighbours of one
        kind joined
    :raises ValueError: if empty, a count is negative, or the groups differ
    """

    fields: tuple[tuple[Representation, int], ...]

    def __post_init__(self) -> None:
        present = [(rep, count) for rep, count in self.fields if count != 0]
        joined = [(rep, sum(count for _, count in run)) for rep, run in groupby(present, key=itemgetter(0))]
        object.__setattr__(self, "fields", tuple(joined))
        if not joined or any(count < 0 for _, count in present):
            raise ValueError(
                f"a field type needs at least one field and no negative count, got {self.fields}"
            )
        if len({rep.group for rep, _ in self.fields}) != 1:
            raise ValueError("all fields of a field type must belong to the same group")

    @classmethod
    def of(cls, *fields: tuple[Representation, int]) -> FieldType:
        """Build from pairs (representation, count)."""
        return cls(fields)

    def __add__(self, other: FieldType) -> FieldType:
        return FieldType(self.fields + other.fields)

    @property
    def group(self) -> Group:
        """The group that acts."""
        return self.fields[0][0].group

    @property
    def size(self) -> int:
        """Number of channels."""
        return sum(rep.size * count for rep, count in self.fields)

    def matrix(self, element: int) -> Matrices:
        """How an element acts on the channels: (size, size), block diagonal."""
        return block_diagonal([rep.matrices[element] for rep, count in self.fields for _ in range(count)])


def block_diagonal(blocks: Sequence[Matrices]) -> Matrices:
    """Matrix with the given square blocks along its diagonal and zeros elsewhere."""
    sizes = [len(block) for block in blocks]
    matrix, start = np.zeros((sum(sizes), sum(sizes))), 0
    for block, size in zip(blocks, sizes, strict=True):
        matrix[start : start + size, start : start + size] = block
        start += size
    return matrix
