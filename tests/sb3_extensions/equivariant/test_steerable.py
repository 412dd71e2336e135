import math

import numpy as np
import pytest
import torch as th
from scipy.linalg import block_diag

from sb3_extensions.encoders.extractors import EquivariantEncoder
from sb3_extensions.equivariant.groups import FieldType, Group
from sb3_extensions.equivariant.layers import EquivariantConv2d, EquivariantLinear
from sb3_extensions.equivariant.steerable import WHOLE_BASIS_LIMIT, FilterSpace, harmonic_basis

C4, C8, C16, D4, D8 = (
    *(Group("cyclic", n) for n in (4, 8, 16)),
    *(Group("dihedral", n) for n in (4, 8)),
)
# Output representation and side of filters from regular fields, and whether the whole basis is kept.
FROM_REGULAR = [
    (C4.regular, 3, True),
    (C8.regular, 4, True),
    (D4.regular, 3, True),
    (D4.irrep(1), 3, True),
    (D4.sign, 5, True),
    (D4.quotient(2), 3, True),
    (C8.regular, 5, False),
    (D4.regular, 5, False),
    (D8.regular, 3, False),
    (C16.quotient(2), 5, False),
    (C4.irrep(1), 9, False),
]
# Maximum number of entries of a buffer (160 kB) of the largest layers: C_32 and 7 x 7 pixels.
LARGEST_BUFFER = 40_000


def projected_basis(out_rep, kernel_size):
    """Project every tensor (harmonics x out) of the first channel of a regular field."""
    group = out_rep.group
    harmonics, frequencies = harmonic_basis(kernel_size, group.n)
    reps = [group.irrep(frequency) if frequency else group.trivial for frequency in frequencies]
    turns = np.stack([block_diag(*(rep.matrices[g] for rep in reps)) for g in range(group.order)])
    mean = np.einsum("gab,gcd,gef->acebdf", turns, out_rep.matrices, group.regular.matrices) / group.order
    coefficients = mean[..., 0].reshape(*mean.shape[:3], -1) * math.sqrt(group.order * out_rep.size)
    return np.einsum("hoip,hxy->poixy", coefficients, harmonics)


@pytest.mark.parametrize("out_rep, kernel_size, whole", FROM_REGULAR, ids=str)
def test_expansion_equals_the_projected_basis(out_rep, kernel_size, whole):
    th.manual_seed(0)
    basis = projected_basis(out_rep, kernel_size)
    assert (len(basis) <= WHOLE_BASIS_LIMIT) == whole
    in_type, out_type = FieldType.of((out_rep.group.regular, 2)), FieldType.of((out_rep, 3))
    layer = EquivariantConv2d(in_type, out_type, kernel_size)
    (weights,) = layer.weights.values()
    assert weights.shape == (3, 2, len(basis))
    expected = np.einsum("OIp,poixy->OoIixy", weights.detach().numpy(), basis)
    found = layer.expand().detach().numpy()
    np.testing.assert_allclose(found, expected.reshape(found.shape), atol=1e-6)
    noise, constant = np.square(basis).sum(), np.square(basis.sum(axis=(2, 3, 4))).sum()
    std = math.sqrt(2 * basis[0].size / max(noise, constant) / (in_type.size * kernel_size**2))
    assert layer.space.std("0_0", math.sqrt(2)) == pytest.approx(std)


@pytest.mark.parametrize("kernel_size", [3, 5])
def test_filters_of_a_batch_equal_filters_of_its_samples(kernel_size):
    th.manual_seed(0)
    fields = FieldType.of((D4.regular, 2), (D4.irrep(1), 1), (D4.sign, 1), (D4.quotient(2), 2))
    space = FilterSpace(fields, fields, kernel_size)
    weights = {key: th.randn(4, 2, *shape) for key, shape in space.shapes.items()}
    filters = space.expand(weights)
    assert filters.shape == (4, 2, fields.size, fields.size, kernel_size, kernel_size)
    for first, second in np.ndindex(4, 2):
        single = space.expand({key: weight[first, second] for key, weight in weights.items()})
        th.testing.assert_close(filters[first, second], single)


def test_filters_are_on_the_device_of_the_weights():
    """On the device without memory, which mixes with no other."""
    mixed = FieldType.of((D4.regular, 1), (D4.sign, 1), (D4.trivial, 1))
    for kernel_size in (1, 5):
        layer = EquivariantConv2d(mixed, mixed, kernel_size).to("meta")
        assert layer.expand().device.type == "meta"


def test_gradients_equal_those_of_a_linear_map():
    """Of the expansion from one column; its derivative along a direction is the direction's expansion."""
    th.manual_seed(0)
    fields = FieldType.of((D8.regular, 2))
    space = FilterSpace(fields, fields, 3)
    weight = th.randn(space.shapes["0_0"], requires_grad=True)
    direction, cotangent = th.randn_like(weight), th.randn(fields.size, fields.size, 3, 3)
    (space.expand({"0_0": weight}) * cotangent).sum().backward()
    expected = (space.expand({"0_0": direction}) * cotangent).sum()
    th.testing.assert_close((weight.grad * direction).sum(), expected, rtol=1e-4, atol=1e-4)


def test_largest_layers_need_little_memory():
    """Buffers and tensors saved for the backward pass do not grow with the basis of 704 filters a field."""
    group = Group("cyclic", 32)
    layer = EquivariantConv2d(FieldType.of((group.regular, 8)), FieldType.of((group.regular, 16)), 7)
    assert max(buffer.numel() for buffer in layer.buffers()) < LARGEST_BUFFER
    saved = []
    with th.autograd.graph.saved_tensors_hooks(lambda x: saved.append(x.numel()) or x, lambda x: x):
        weight = layer.expand()
    assert weight.shape == (16 * 32, 8 * 32, 7, 7)
    assert sum(saved) < weight.numel()
    weight.sum().backward()
    (parameter,) = layer.weights.values()
    assert th.isfinite(parameter.grad).all() and parameter.grad.std() > 0
    # A field's first column may be anything, so its filters are as many as there are harmonics and numbers.
    assert parameter.shape == (16, 8, 22 * 32)


# Action and values (two fields) of a small actor and critic behind an encoder.
STORED = {
    C4: (
        [-0.000908, -0.100342, -0.074992, -0.201935, -0.177302],
        [[0.011417, 0.446298, 0.046876, 0.486022], [-0.324128, -0.456022, -0.336141, -0.412275]],
    ),
    D4: (
        [-0.435788, -0.049708, 0.050491, 0.034773, -0.225637],
        [
            [-0.229093, -0.097067, -0.176883, -0.918404, -0.09694, -0.825089, -0.281316, -0.324952],
            [-0.006162, -0.250437, 0.205073, -0.113424, 0.294541, -0.475133, 0.057585, 0.079482],
        ],
    ),
}


@pytest.mark.parametrize("group", STORED, ids=str)
def test_networks_of_a_seed_have_stored_outputs(group):
    th.manual_seed(3)
    encoder = EquivariantEncoder(2, 16, group, (4, 4, 4), strided=1)
    action_type = FieldType.of((group.irrep(1), 1), (group.sign, 1), (group.trivial, 2))
    actor = EquivariantLinear(encoder.out_type, action_type)
    critic = EquivariantLinear(encoder.out_type + action_type, FieldType.of((group.regular, 2)))
    image = th.linspace(0, 40, 512).sin().reshape(1, 2, 16, 16)
    with th.no_grad():
        features = encoder(image)
        action = actor(features)
        values = critic(th.cat([features, action], dim=1))
    stored_action, stored_values = STORED[group]
    np.testing.assert_allclose(action[0], stored_action, atol=1e-5)
    np.testing.assert_allclose(values[0], np.ravel(stored_values), atol=1e-5)
