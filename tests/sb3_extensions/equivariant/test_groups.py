"""Groups, their representations, and types of fields."""

import itertools

import numpy as np
import pytest

from sb3_extensions.equivariant.groups import FieldType, Group

GROUPS = [Group("cyclic", n) for n in (1, 2, 4, 8)] + [Group("dihedral", n) for n in (1, 2, 4, 6)]
C4, C8, D4 = Group("cyclic", 4), Group("cyclic", 8), Group("dihedral", 4)


@pytest.mark.parametrize("group", GROUPS, ids=str)
def test_representations_are_orthogonal_homomorphisms(group):
    quotients = [group.quotient(m) for m in range(1, group.n + 1) if group.n % m == 0]
    np.testing.assert_array_equal(quotients[0].matrices, group.regular.matrices)
    for rep in (group.trivial, group.sign, group.regular, group.irrep(1), group.irrep(2), *quotients):
        assert rep.matrices.shape == (group.order, rep.size, rep.size)
        for first, second in itertools.product(range(group.order), repeat=2):
            product = rep.matrices[group.product(first, second)]
            np.testing.assert_allclose(rep.matrices[first] @ rep.matrices[second], product, atol=1e-12)
        inverses = rep.matrices.transpose(0, 2, 1)
        np.testing.assert_allclose(rep.matrices @ inverses, [np.eye(rep.size)] * group.order, atol=1e-12)


def test_vectors_rotate_with_the_world_and_as_points_of_an_image():
    """A rotation by 90 degrees maps (x, y) to (-y, x) and an image to np.rot90(image, k=1)."""
    turn, reflection = D4.irrep(1).matrices[[1, 4]]
    np.testing.assert_allclose(turn @ (0.3, 0.7), (-0.7, 0.3), atol=1e-12)
    np.testing.assert_allclose(reflection @ (0.3, 0.7), (0.3, -0.7), atol=1e-12)
    assert [rep.matrices[4].item() for rep in (D4.sign, D4.trivial)] == [-1, 1]
    assert C4.sign == C4.trivial
    image = np.zeros((8, 8))
    image[6, 3] = 1
    point, turned = (np.argwhere(each)[0] - 3.5 for each in (image, np.rot90(image, k=1)))
    np.testing.assert_allclose(turned, turn @ point, atol=1e-12)


def test_quotient_is_a_yaw_modulo_pi():
    group = Group("cyclic", 32)
    rep = group.quotient(2)
    assert (rep.size, rep.kind, rep.is_permutation) == (16, "quotient", True)
    yaws = np.arange(16) * np.pi / 16
    for element in range(group.order):
        turned = (yaws + group.angle(element)) % np.pi
        images = rep.matrices[element].argmax(axis=0)
        np.testing.assert_allclose(np.exp(2j * yaws[images]), np.exp(2j * turned), atol=1e-12)
    turn, reflection = (D4.quotient(2).matrices[element].argmax(axis=0).tolist() for element in (1, 4))
    assert turn == [1, 0, 3, 2] and reflection == [2, 3, 0, 1]


def test_field_type_joins_neighbours_and_drops_empty_fields():
    fields = FieldType.of((C4.regular, 2), (C4.trivial, 0), (C4.regular, 1), (C4.irrep(1), 1))
    assert fields.fields == ((C4.regular, 3), (C4.irrep(1), 1))
    assert fields.size == 14 and fields.matrix(1).shape == (14, 14)
    assert (fields + fields).size == 28


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: Group("square", 4), "square"),
        (lambda: Group("cyclic", 0), "0"),
        (lambda: FieldType.of((C4.regular, 1), (C8.regular, 1)), "same group"),
        (lambda: FieldType.of((C4.regular, 0)), "at least one field"),
        (lambda: FieldType.of((C4.regular, -1)), "at least one field"),
        *[(lambda m=m: D4.quotient(m), f"m, .* n = 4, got {m}") for m in (0, -2, 3, 16)],
    ],
)
def test_invalid_arguments_are_rejected(make, named):
    with pytest.raises(ValueError, match=named):
        make()
