import itertools

import numpy as np
import pytest

from sb3_extensions.equivariant.groups import FieldType, Group

GROUPS = [Group("cyclic", n) for n in (1, 2, 4, 8)] + [Group("dihedral", n) for n in (1, 2, 4, 6)]


def representations(group):
    quotients = [group.quotient(m) for m in range(1, group.n + 1) if group.n % m == 0]
    return [group.trivial, group.sign, group.regular, group.irrep(1), group.irrep(2), *quotients]


@pytest.mark.parametrize("group", GROUPS, ids=str)
def test_representations_are_orthogonal_homomorphisms(group):
    for rep in representations(group):
        assert rep.matrices.shape == (group.order, rep.size, rep.size)
        for first, second in itertools.product(range(group.order), repeat=2):
            product = rep.matrices[group.product(first, second)]
            np.testing.assert_allclose(rep.matrices[first] @ rep.matrices[second], product, atol=1e-12)
        inverses = rep.matrices.transpose(0, 2, 1)
        np.testing.assert_allclose(rep.matrices @ inverses, [np.eye(rep.size)] * group.order, atol=1e-12)


def test_vector_rotates_with_the_world():
    group = Group("dihedral", 4)
    x, y = 0.3, 0.7
    np.testing.assert_allclose(group.irrep(1).matrices[1] @ (x, y), (-y, x), atol=1e-12)
    np.testing.assert_allclose(group.irrep(1).matrices[4] @ (x, y), (x, -y), atol=1e-12)
    assert [rep.matrices[4].item() for rep in (group.sign, group.trivial)] == [-1, 1]


def test_rot90_of_an_image_rotates_its_points_as_vectors():
    """A rotation by 90 degrees maps (x, y) to (-y, x) and an image to np.rot90(image, k=1)."""
    size, turn = 8, Group("cyclic", 4).irrep(1).matrices[1]
    image = np.zeros((size, size))
    image[6, 3] = 1
    centre = (size - 1) / 2
    point = np.argwhere(image)[0] - centre
    turned = np.argwhere(np.rot90(image, k=1))[0] - centre
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


@pytest.mark.parametrize("group", GROUPS, ids=str)
def test_quotient_by_one_rotation_acts_as_the_regular_representation(group):
    np.testing.assert_array_equal(group.quotient(1).matrices, group.regular.matrices)


def test_reflected_cosets_follow_the_rotations():
    rep = Group("dihedral", 4).quotient(2)
    assert rep.size == 4
    turn, reflection = (rep.matrices[element].argmax(axis=0).tolist() for element in (1, 4))
    assert turn == [1, 0, 3, 2] and reflection == [2, 3, 0, 1]


@pytest.mark.parametrize("m", [0, -2, 3, 16])
def test_quotient_rejects_orders_that_do_not_divide_n(m):
    with pytest.raises(ValueError, match=f"m, the order of the subgroup, must divide n = 8, got {m}"):
        Group("dihedral", 8).quotient(m)


def test_sign_of_a_cyclic_group_is_trivial():
    group = Group("cyclic", 4)
    assert group.sign == group.trivial


def test_field_type_joins_neighbours_and_drops_empty_fields():
    group = Group("cyclic", 4)
    fields = FieldType.of((group.regular, 2), (group.trivial, 0), (group.regular, 1), (group.irrep(1), 1))
    assert fields.fields == ((group.regular, 3), (group.irrep(1), 1))
    assert fields.size == 14 and fields.matrix(1).shape == (14, 14)
    assert (fields + fields).size == 28


@pytest.mark.parametrize("family, n, named", [("square", 4, "square"), ("cyclic", 0, "0")])
def test_group_rejects_invalid_arguments(family, n, named):
    with pytest.raises(ValueError, match=named):
        Group(family, n)


def test_field_type_rejects_mixed_groups_and_no_fields():
    with pytest.raises(ValueError, match="same group"):
        FieldType.of((Group("cyclic", 4).regular, 1), (Group("cyclic", 8).regular, 1))
    for count in (0, -1):
        with pytest.raises(ValueError, match="at least one field"):
            FieldType.of((Group("cyclic", 4).regular, count))
