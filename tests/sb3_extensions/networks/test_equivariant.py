import copy
import io
import math
import pickle

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.utils import polyak_update
from torch import nn

from sb3_extensions.networks.encoders import CnnEncoder, EquivariantEncoder, count_halvings, plan_stages
from sb3_extensions.networks.equivariant import (
    EquivariantConv2d,
    EquivariantLinear,
    GroupMaxPool,
    expanded_filters,
    harmonic_basis,
)
from sb3_extensions.networks.groups import FieldType, Group

GROUPS = [Group("cyclic", n) for n in (1, 2, 4, 8)] + [Group("dihedral", n) for n in (1, 2, 4, 8)]
EXACT = 1e-5


@pytest.fixture(autouse=True)
def _seed():
    th.manual_seed(0)


def mixed_type(group):
    return FieldType.of(
        (group.regular, 2), (group.irrep(1), 1), (group.sign, 2), (group.trivial, 3), (group.irrep(2), 1)
    )


def grid_elements(group):
    """Elements that map a square grid of pixels to itself."""
    return [g for g in range(group.order) if math.isclose(math.sin(2 * group.angle(g)), 0, abs_tol=1e-9)]


def turn_image(image, group, element):
    """Act on the pixels alone."""
    image = image.flip(-1) if group.reflects(element) else image
    return th.rot90(image, round(group.angle(element) / (math.pi / 2)), (-2, -1))


def act(features, field_type, element):
    """Act on the pixels, if any, and on the channels."""
    matrix = th.tensor(field_type.matrix(element), dtype=features.dtype)
    if features.dim() == 4:
        features = turn_image(features, field_type.group, element)
    return th.einsum("ij,bj...->bi...", matrix, features)


def relative_error(found, expected):
    return float((found - expected).detach().abs().max() / expected.detach().abs().max())


@pytest.mark.parametrize("group", GROUPS, ids=str)
@pytest.mark.parametrize("kernel_size, stride", [(1, 1), (3, 1), (5, 1), (2, 2), (4, 2)])
def test_convolution_commutes_with_the_group(group, kernel_size, stride):
    fields = mixed_type(group)
    layer = EquivariantConv2d(
        fields, fields, kernel_size, stride, padding=kernel_size // 2 - 1 + kernel_size % 2
    )
    nn.init.normal_(layer.bias)
    image = th.randn(2, fields.size, 8, 8)
    out = layer(image)
    assert out.std() > 0.5
    for element in grid_elements(group):
        assert relative_error(layer(act(image, fields, element)), act(out, fields, element)) < EXACT


@pytest.mark.parametrize("group", GROUPS, ids=str)
def test_linear_commutes_with_every_element(group):
    fields = mixed_type(group)
    layer = EquivariantLinear(fields, fields)
    nn.init.normal_(layer.bias)
    features = th.randn(3, fields.size)
    for element in range(group.order):
        error = relative_error(layer(act(features, fields, element)), act(layer(features), fields, element))
        assert error < EXACT


@pytest.mark.parametrize("n", [8, 6])
def test_filters_obey_the_constraint_under_rotations_off_the_grid(n):
    """The continuous filters obey it exactly: turned harmonics are the harmonics' rotation."""
    group = Group("cyclic", n)
    _, frequencies = harmonic_basis(5)
    angle, element = 0.37, 1
    for frequency in frequencies:
        if frequency:
            waves = np.array([np.cos(frequency * angle), np.sin(frequency * angle)])
            turned = frequency * (angle + group.angle(element))
            expected = group.irrep(frequency).matrices[element] @ waves
            np.testing.assert_allclose([np.cos(turned), np.sin(turned)], expected)


def blobs(size, angle, width):
    """An image of Gaussian blobs, turned by an angle about its centre without interpolation."""
    axis = th.arange(float(size)) - (size - 1) / 2
    rows, columns = th.meshgrid(axis, axis, indexing="ij")
    places = th.tensor([[0.3, 0.1], [-0.2, 0.25], [0.05, -0.3]]) * size
    turn = th.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    squared = [(rows - x) ** 2 + (columns - y) ** 2 for x, y in places @ turn.T]
    heights = [
        height * th.exp(-each / (2 * width**2)) for height, each in zip((1, -1, 1), squared, strict=True)
    ]
    return th.stack(heights).sum(dim=0)[None, None]


def test_layer_commutes_with_45_degrees_on_smooth_images():
    group = Group("cyclic", 8)
    scalar, regular = FieldType.of((group.trivial, 1)), FieldType.of((group.regular, 4))
    layer = EquivariantConv2d(scalar, regular, 3)
    centre = (slice(None), slice(None), 14, 14)
    plain, turned = (layer(blobs(31, angle, width=5))[centre] for angle in (0, math.pi / 4))
    assert relative_error(turned, act(plain, regular, 1)) < 0.05


@pytest.mark.parametrize("strided", [0, 2])
def test_encoder_commutes_with_45_degrees_up_to_sampling(strided):
    """Pixels and pooling windows do not turn by 45 degrees: the last ones are as coarse as the image."""
    encoder = EquivariantEncoder(1, 64, Group("cyclic", 8), (4, 8, 8, 16, 16), strided=strided)
    with th.no_grad():
        plain, turned = (encoder(blobs(64, angle, width=4)) for angle in (0, math.pi / 4))
    error = (turned - act(plain, encoder.out_type, 1)).norm()
    assert error < 0.4 * turned.norm() and error < (turned - plain).norm()


@pytest.mark.parametrize(
    "group, functions", [(Group("cyclic", 4), 6), (Group("cyclic", 8), 6), (Group("dihedral", 4), 6)]
)
def test_regular_layer_has_a_fraction_of_the_parameters(group, functions):
    fields = FieldType.of((group.regular, 3))
    layer = EquivariantConv2d(fields, fields, 3)
    plain = nn.Conv2d(fields.size, fields.size, 3)
    assert len(harmonic_basis(3)[0]) == functions
    assert (
        sum(weight.numel() for weight in layer.weights.values())
        == plain.weight.numel() // group.order * functions // 9
    )
    assert layer.bias.numel() == 3


@pytest.mark.parametrize("group", [Group("cyclic", 4), Group("dihedral", 8)], ids=str)
def test_first_weights_keep_the_scale_of_a_signal(group):
    """By He's rule the mean square doubles, and a ReLU halves it; noise is damped, not amplified."""
    layer = EquivariantConv2d(FieldType.of((group.regular, 64)), FieldType.of((group.regular, 64)), 3)
    constant = th.randn(1, 64, 1, 1, 1).expand(1, 64, group.order, 3, 3).flatten(1, 2)
    out = layer(constant)
    assert out.square().mean().item() == pytest.approx(2 * constant.square().mean().item(), rel=0.5)
    noise = layer(th.randn(1, 64 * group.order, 12, 12))
    assert 0.5 < noise.square().mean() < 2


def test_first_features_of_a_deep_encoder_neither_vanish_nor_explode():
    encoder = EquivariantEncoder(2, 128, Group("cyclic", 8))
    with th.no_grad():
        features = encoder(0.5 + 0.2 * th.rand(2, 2, 128, 128))
    assert 0.05 < features.square().mean().sqrt() < 5


def test_gradients_reach_every_parameter():
    group = Group("dihedral", 4)
    layer = EquivariantConv2d(mixed_type(group), mixed_type(group), 3)
    layer(th.randn(2, layer.in_type.size, 5, 5)).square().sum().backward()
    for name, parameter in layer.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().sum() > 0, name


def test_group_pooling_is_invariant_and_refuses_other_fields():
    group = Group("cyclic", 8)
    regular = FieldType.of((group.regular, 3))
    pool, features = GroupMaxPool(regular), th.randn(2, 24)
    assert pool(features).shape == (2, 3) and pool.out_type.size == 3
    assert pool(th.randn(2, 24, 5, 5)).shape == (2, 3, 5, 5)
    for element in range(group.order):
        assert th.equal(pool(act(features, regular, element)), pool(features))
    with pytest.raises(ValueError, match="regular fields only"):
        GroupMaxPool(mixed_type(group))


def test_layers_refuse_what_has_no_answer():
    c4, c8, d4 = Group("cyclic", 4), Group("cyclic", 8), Group("dihedral", 4)
    with pytest.raises(ValueError, match="group"):
        EquivariantLinear(FieldType.of((c4.regular, 1)), FieldType.of((c8.regular, 1)))
    with pytest.raises(ValueError, match="commutes"):
        EquivariantLinear(FieldType.of((d4.trivial, 1)), FieldType.of((d4.sign, 1)))
    with pytest.raises(ValueError, match="kernel_size"):
        EquivariantConv2d(FieldType.of((c4.regular, 1)), FieldType.of((c4.regular, 1)), 0)


def encoder_of(group, size=16, channels=(4, 4, 4), **kwargs):
    return EquivariantEncoder(2, size, group, channels, **kwargs)


@pytest.mark.parametrize("group", [Group("cyclic", 4), Group("cyclic", 8), Group("dihedral", 4)], ids=str)
@pytest.mark.parametrize("channels_last", [True, False])
@pytest.mark.parametrize("size, strided", [(16, 0), (16, 1), (24, 0), (32, 1), (32, 2), (8, 0)])
def test_encoder_commutes_with_the_group(group, size, strided, channels_last):
    channels = (4,) * (count_halvings(size) + 3)
    encoder = encoder_of(group, size, channels, strided=strided, channels_last=channels_last)
    image = th.rand(2, 2, size, size)
    features = encoder(image)
    assert features.shape == (2, encoder.features_dim) and features.std() > 0
    for element in grid_elements(group):
        turned = encoder(turn_image(image, group, element))
        assert relative_error(turned, act(features, encoder.out_type, element)) < EXACT


@pytest.mark.parametrize(
    "size, count, sides",
    [(128, 7, [64, 32, 16, 8, 8, 3, 1]), (64, 5, [32, 16, 8, 3, 1]), (96, 6, [48, 24, 12, 6, 3, 1])],
)
def test_stages_reduce_the_image_to_one_pixel(size, count, sides):
    encoder = CnnEncoder(2, size, (4,) * count)
    image, found = th.zeros(1, 2, size, size), []
    for layer in encoder.layers:
        image = layer(image)
        found += [image.shape[-1]] if isinstance(layer, nn.ReLU) else []
    assert found == sides


def test_default_channels_are_the_papers():
    """128 pixels: 16 to 256 channels, 8 to 128 regular fields; a smaller image drops the widest halvings."""
    cnn = [layer.out_channels for layer in CnnEncoder(2, 128).layers if isinstance(layer, nn.Conv2d)]
    assert cnn == [16, 32, 64, 128, 256, 256, 128]
    group = Group("cyclic", 8)
    for size, expected in ((128, [8, 16, 32, 64, 128, 64, 64]), (64, [8, 16, 32, 128, 64, 64])):
        layers = EquivariantEncoder(2, size, group).layers
        assert [x.out_type.size // 8 for x in layers if isinstance(x, EquivariantConv2d)] == expected


@pytest.mark.parametrize(
    "size, count, strided, named",
    [
        (100, 7, 0, "size"),
        (7, 3, 0, "size"),
        (4, 3, 0, "size"),
        (128, 5, 0, "channels"),
        (64, 5, 4, "strided"),
        (64, 5, -1, "strided"),
    ],
)
def test_plan_refuses_what_it_cannot_reduce(size, count, strided, named):
    with pytest.raises(ValueError, match=named):
        plan_stages(size, count, strided)


def test_encoder_refuses_an_unknown_precision():
    with pytest.raises(ValueError, match="autocast"):
        encoder_of(Group("cyclic", 4), autocast="fp8")


@pytest.mark.filterwarnings("ignore:autocast")
def test_bfloat16_is_close_to_float32():
    exact, rounded = encoder_of(Group("cyclic", 4)), encoder_of(Group("cyclic", 4), autocast="bf16")
    rounded.load_state_dict(exact.state_dict())
    image = th.rand(4, 2, 16, 16)
    out = rounded(image)
    assert out.dtype == th.float32
    assert relative_error(out, exact(image)) < 0.03
    out.sum().backward()
    assert all(p.grad is not None and p.grad.dtype == th.float32 for p in rounded.parameters())


# Filters must follow their weights however these are written: a target network that does not learns nothing.


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize("strided", [0, 1])
def test_target_follows_a_polyak_update(training, strided):
    """Stable-Baselines3 sets the target to eval mode once and then writes its weights through ``.data``."""
    online, target = (encoder_of(Group("cyclic", 4), strided=strided) for _ in range(2))
    target.train(training)
    image = th.rand(2, 2, 16, 16)
    with th.no_grad():
        before = target(image)
        polyak_update(online.parameters(), target.parameters(), tau=0.5)
        assert relative_error(target(image), before) > 1e-3
        polyak_update(online.parameters(), target.parameters(), tau=1.0)
        assert th.equal(target(image), online(image))


@pytest.mark.parametrize("training", [True, False])
def test_state_dict_copy_and_pickle(training):
    encoder = encoder_of(Group("dihedral", 4)).train(training)
    keys = set(encoder.state_dict())
    image = th.rand(2, 2, 16, 16)
    expected = encoder(image)
    assert set(encoder.state_dict()) == keys == set(dict(encoder.named_parameters()))
    buffer = io.BytesIO()
    th.save(encoder.state_dict(), buffer)
    buffer.seek(0)
    loaded = encoder_of(Group("dihedral", 4)).train(not training)
    loaded.load_state_dict(th.load(buffer, weights_only=True))
    for other in (copy.deepcopy(encoder), pickle.loads(pickle.dumps(encoder)), loaded):
        assert th.equal(other(image), expected)


def test_scope_expands_once_and_never_outlives_itself(monkeypatch):
    encoder = encoder_of(Group("cyclic", 4))
    image = th.rand(2, 2, 16, 16)
    layers = [layer for layer in encoder.modules() if isinstance(layer, EquivariantConv2d)]
    expansions = []
    expand = EquivariantConv2d.expand
    monkeypatch.setattr(EquivariantConv2d, "expand", lambda self: expansions.append(self) or expand(self))
    with th.no_grad():
        expected = encoder(image)
        assert len(expansions) == len(layers)
        with expanded_filters(encoder):
            assert all(th.equal(encoder(image), expected) for _ in range(3))
            duplicate = copy.deepcopy(encoder)
        assert len(expansions) == 2 * len(layers)
        for parameter in (*encoder.parameters(), *duplicate.parameters()):
            parameter.data.mul_(0.5)
        assert relative_error(encoder(image), expected) > 1e-3
        assert th.equal(duplicate(image), encoder(image))


def test_scope_leaves_training_alone():
    encoder = encoder_of(Group("cyclic", 4))
    image = th.rand(2, 2, 16, 16)
    with expanded_filters(encoder):
        encoder(image).sum().backward()
    assert all(parameter.grad is not None for parameter in encoder.parameters())


def test_scope_closes_after_an_error():
    encoder = encoder_of(Group("cyclic", 4))
    image = th.rand(2, 2, 16, 16)
    with th.no_grad():
        before = encoder(image)
        with pytest.raises(KeyError), expanded_filters(encoder):
            raise KeyError
        for parameter in encoder.parameters():
            parameter.data.mul_(0.5)
        assert relative_error(encoder(image), before) > 1e-3
