import pytest
import torch as th
from torch import nn

from sb3_extensions.encoders.cnn import CnnEncoder, count_halvings, encoded_size, plan_stages
from sb3_extensions.encoders.extractors import EquivariantEncoder
from sb3_extensions.equivariant.groups import Group
from sb3_extensions.equivariant.layers import EquivariantConv2d


@pytest.fixture(autouse=True)
def _seed():
    th.manual_seed(0)


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
        (0, 3, 0, "size"),
        (128, 5, 0, "channels"),
        (64, 5, 5, "strided"),
        (64, 5, -1, "strided"),
    ],
)
def test_plan_stages_rejects_invalid_sizes(size, count, strided, named):
    with pytest.raises(ValueError, match=named):
        plan_stages(size, count, strided)


@pytest.mark.parametrize(
    ("size", "encoded"), [(1, 6), (7, 8), (24, 24), (25, 32), (84, 96), (128, 128), (224, 256)]
)
def test_images_are_resized_to_the_next_encoded_size(size, encoded):
    assert encoded_size(size) == encoded


@pytest.mark.parametrize("size", [5, 20, 25, 84])
def test_encoders_of_any_size_are_equivariant(size):
    count = count_halvings(size) + 2
    plain = CnnEncoder(3, size, (4,) * count)
    image = th.rand(2, 3, size, size)
    assert plain(image).shape == (2, 4) and plain(image).std() > 0
    equivariant = EquivariantEncoder(3, size, Group("cyclic", 4), (4,) * count)
    features = equivariant(image).unflatten(1, (4, 4))
    turned = equivariant(th.rot90(image, 1, (-2, -1))).unflatten(1, (4, 4))
    th.testing.assert_close(turned, features.roll(1, dims=2), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("size", [84, 224])
def test_default_encoders_accept_sizes_of_colour_sensors(size):
    with th.no_grad():
        for encoder in (CnnEncoder(3, size), EquivariantEncoder(3, size, Group("cyclic", 4))):
            assert encoder(th.rand(1, 3, size, size)).shape == (1, encoder.features_dim)


def test_encoder_rejects_unknown_precision():
    with pytest.raises(ValueError, match="autocast"):
        EquivariantEncoder(2, 16, Group("cyclic", 4), (4, 4, 4), autocast="fp8")


def test_first_features_of_a_deep_encoder_neither_vanish_nor_explode():
    encoder = EquivariantEncoder(2, 128, Group("cyclic", 8))
    with th.no_grad():
        features = encoder(0.5 + 0.2 * th.rand(2, 2, 128, 128))
    assert 0.05 < features.square().mean().sqrt() < 5
