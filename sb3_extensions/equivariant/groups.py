"""Finite groups of the plane, their real representations, and field types of feature maps.

Conventions of all equivariant layers: the row of an image is world x, its column world y. A rotation by
``theta`` about z maps (x, y) to (cos(theta) x - sin(theta) y, sin(theta) x + cos(theta) y). A rotation by +90
degrees maps (x, y) to (-y, x), and an array to ``np.rot90(image, k=1, axes=(rows, columns))``. The reflection
of a dihedral group maps (x, y) to (x, -y), inverts rotations about z, and flips the columns of an array.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from operator import itemgetter

import numpy as np
import numpy.typing as npt
from scipy.linalg import block_diag

Matrices = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Group:
    """Cyclic group C_n (rotations by multiples of 2 pi / n) or dihedral group D_n (with reflections).

    Element ``i`` is the rotation by ``2 pi (i mod n) / n``, after the reflection if ``i >= n``.

    :param family: ``"cyclic"`` or ``"dihedral"``
    :param n: number of rotations, at least 1
    :raises ValueError: if the family is unknown or ``n < 1``
    """

    family: str
    n: int

    def __post_init__(self) -> None:
        if self.family not in ("cyclic", "dihedral"):
            raise ValueError(f"group must be 'cyclic' or 'dihedral', got {self.family!r}")
        if self.n < 1:
            raise ValueError(f"n, the number of rotations, must be at least 1, got {self.n}")

    @property
    def order(self) -> int:
        """Number of elements."""
        return self.n if self.family == "cyclic" else 2 * self.n

    def angle(self, element: int) -> float:
        """Return the rotation angle of an element, rad."""
        return 2 * np.pi * (element % self.n) / self.n

    def reflects(self, element: int) -> bool:
        """Return True if the element contains the reflection."""
        return element >= self.n

    def product(self, first: int, second: int) -> int:
        """Return the element that is ``second`` followed by ``first``."""
        rotation = -second if self.reflects(first) else second
        return (first + rotation) % self.n + self.n * (self.reflects(first) != self.reflects(second))

    @property
    def trivial(self) -> Representation:
        """One invariant number."""
        return Representation(self, "trivial")

    @property
    def sign(self) -> Representation:
        """One number whose sign a reflection changes; equal to trivial for a cyclic group."""
        return Representation(self, "sign" if self.family == "dihedral" else "trivial")

    @property
    def regular(self) -> Representation:
        """One number for each element, permuted by the group."""
        return Representation(self, "regular")

    def quotient(self, m: int) -> Representation:
        """Return the representation with one number for each coset of the subgroup C_m of rotations.

        Number ``i < n / m`` is the coset of the rotation by ``2 pi i / n``. The numbers of the reflected
        elements of a dihedral group follow in the same order.

        :param m: order of the subgroup, a divisor of n
        :raises ValueError: if m does not divide n
        """
        if m < 1 or self.n % m:
            raise ValueError(f"m, the order of the subgroup, must divide n = {self.n}, got {m}")
        return Representation(self, "quotient", subgroup=m)

    def irrep(self, frequency: int) -> Representation:
        """Return the representation of two numbers that rotate by ``frequency`` times the angle.

        Frequency 1 is a vector (x, y). Frequencies of 0 or n / 2 modulo n are reducible.
        """
        return Representation(self, "irrep", frequency)


@dataclass(frozen=True)
class Representation:
    """Orthogonal representation of a group.

    :param group: the group
    :param kind: ``"trivial"``, ``"sign"``, ``"regular"``, ``"quotient"`` or ``"irrep"``
    :param frequency: frequency of an irrep
    :param subgroup: order of the subgroup of a quotient
    """

    group: Group
    kind: str
    frequency: int = 0
    subgroup: int = 1

    @property
    def size(self) -> int:
        """Number of channels of one field."""
        cosets = self.group.order // self.subgroup
        return {"trivial": 1, "sign": 1, "irrep": 2, "regular": cosets, "quotient": cosets}[self.kind]

    @property
    def is_permutation(self) -> bool:
        """Whether elementwise nonlinearities are equivariant."""
        return self.kind in ("regular", "quotient", "trivial")

    @cached_property
    def matrices(self) -> Matrices:
        """Orthogonal matrix of each element, (order, size, size)."""
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
        """Return the coset to which an element maps each coset."""
        group, rotations = self.group, self.group.n // self.subgroup
        first = [start + index for start in range(0, group.order, group.n) for index in range(rotations)]
        images = [group.product(element, other) for other in first]
        return [image % group.n % rotations + rotations * group.reflects(image) for image in images]


@dataclass(frozen=True)
class FieldType:
    """Representation of the channels of a feature map: fields in order, the channels of a field adjacent.

    :param fields: pairs (representation, number of fields) of one group; empty pairs are dropped, adjacent
        pairs of one representation joined
    :raises ValueError: if there is no field, a number is negative, or the groups differ
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
        """Return the field type of pairs (representation, number of fields)."""
        return cls(fields)

    def __add__(self, other: FieldType) -> FieldType:
        return FieldType(self.fields + other.fields)

    @property
    def group(self) -> Group:
        """Symmetry group."""
        return self.fields[0][0].group

    @property
    def size(self) -> int:
        """Number of channels."""
        return sum(rep.size * count for rep, count in self.fields)

    def matrix(self, element: int) -> Matrices:
        """Return the block diagonal matrix of an element for all channels, (size, size)."""
        blocks = [rep.matrices[element] for rep, count in self.fields for _ in range(count)]
        matrix: Matrices = block_diag(*blocks)
        return matrix
