"""Networks that value every pixel rotate with the heightmap."""

import itertools

import numpy as np
import pytest
import torch as th

from sb3_extensions.encoders.observation import View
from sb3_extensions.encoders.unet import equivariant_unet, plain_unet
from sb3_extensions.equivariant.groups import Group
from sb3_extensions.spatial_dqn.patches import rotate_images
from sb3_extensions.spatial_dqn.pixel_maps import (
    EquivariantPixelMaps,
    PlainPixelMaps,
    RotatedPixelMaps,
)

SIDE = 12  # of the in-hand image
CHANNELS, FIELDS = (4, 6, 8), (4, 4, 6)
PATCH_MAP, IN_HAND, HIDDEN = (4, 4, 6), (4, 4, 6, 6), 16
C4 = Group("cyclic", 4)


@pytest.fixture(autouse=True)
def _seed():
    th.manual_seed(0)


def make_view(size: int, batch: int = 4) -> View:
    """Random images; every other gripper holds something."""
    image = th.rand(batch, 1, size, size)
    return View(image, image[:, 0], th.randn(batch, 1, SIDE, SIDE), th.arange(batch) % 2 == 1)


def assert_same(found: th.Tensor, expected: th.Tensor):
    spread = expected.std()
    assert spread > 0
    assert ((found - expected).abs().max() / spread).item() < 1e-4


def equivariant(
    size: int, rotations: int = 1, fields=FIELDS, in_hand=(1, SIDE), **kwargs
) -> EquivariantPixelMaps:
    group = Group("dihedral", 4) if rotations == 1 else Group("cyclic", 2 * rotations)
    return EquivariantPixelMaps(size, in_hand, group, fields, IN_HAND, HIDDEN, rotations, **kwargs)


@pytest.mark.parametrize("rotations", [1, 2, 4, 6])
@pytest.mark.parametrize("size", [16, 30])
def test_maps_rotate_with_the_image_and_yaws_shift(size, rotations):
    network, view = equivariant(size, rotations), make_view(size)
    maps, encoding = network(view)  # with gradients; the others without
    assert maps.shape == (4, rotations, size, size) and maps.dtype == th.float32
    for quarters, flipped in itertools.product(range(4), [False, True] if rotations == 1 else [False]):

        def turn(image: th.Tensor, quarters: int = quarters, flipped: bool = flipped) -> th.Tensor:
            image = th.rot90(image, quarters, (-2, -1))
            return image.flip(-1) if flipped else image

        with th.no_grad():
            found, found_encoding = network(view._replace(image=turn(view.image), heights=turn(view.heights)))
        shifted = turn(maps).roll(quarters * rotations // 2, dims=1)
        for sample in range(4):  # picks and places
            assert_same(found[sample], shifted[sample])
        assert_same(found_encoding, turn(encoding))
    if rotations > 1:
        assert (maps.std(dim=1).mean(dim=(1, 2)) > 0.05 * maps.flatten(1).std(dim=1)).all()  # yaws differ


@pytest.mark.parametrize("rotations", [1, 16])
def test_untrained_small_networks_have_different_values_of_places(rotations):
    """Of one field behind a ReLU all numbers may be 0 everywhere: then nothing is ever learned of places."""
    view = make_view(32)
    for seed in range(10):
        th.manual_seed(seed)
        network = equivariant(32, rotations, (2, 2, 4, 4), dynamic_fields=4)
        assert network.dynamic is not None
        assert network.dynamic.out_type.size == 4 * network.dynamic.out_type.group.order
        with th.no_grad():
            maps, _ = network(view)
        assert (maps[view.places].flatten(1).std(dim=1) > 0).all(), seed


def test_rotated_maps_equal_the_network_on_rotated_images():
    size, rotations = 16, 4
    network = RotatedPixelMaps(size, (1, SIDE), CHANNELS, PATCH_MAP, rotations)
    view = make_view(size)
    with th.no_grad():
        maps, encoding = network(view)
        for sample, yaw in np.ndindex(4, rotations):
            angle = th.tensor([yaw * np.pi / rotations])
            one = view.of(th.tensor([sample]))
            alone = one._replace(image=rotate_images(one.image, -angle, network.canvas))
            values, seen = network.network(alone)
            expected = rotate_images(values, angle, size)[0, 0]
            th.testing.assert_close(maps[sample, yaw], expected, atol=1e-6, rtol=1e-4)
            if yaw == 0:
                th.testing.assert_close(encoding[sample], seen[0], atol=1e-6, rtol=1e-4)


def test_places_without_an_in_hand_image_have_values():
    view = make_view(16)._replace(in_hand=None)
    for network in (PlainPixelMaps(16, None, CHANNELS, PATCH_MAP, 3), equivariant(16, in_hand=None)):
        assert network(view)[0].shape == (4, network.rotations, 16, 16)


def test_widths_are_the_authors():
    plain = plain_unet(1, (32, 64, 128, 256, 256), 256)
    convolutions = [(m.in_channels, m.out_channels) for m in plain.modules() if isinstance(m, th.nn.Conv2d)]
    blocks = [
        *[(1, 32), (32, 32), (32, 32)],
        *[(32, 64), (64, 64), (32, 64), (64, 128), (128, 128), (64, 128), (128, 256), (256, 256), (128, 256)],
        *[(256, 512), (512, 512), (256, 512), (512, 256)],
        *[(512, 256), (256, 256), (512, 256), (256, 128), (256, 128), (128, 128), (256, 128), (128, 64)],
        *[(128, 64), (64, 64), (128, 64), (64, 32), (64, 32), (32, 32), (64, 32)],
        *[(512, 256), (256, 256), (512, 256)],
    ]
    assert convolutions == blocks
    with th.no_grad():
        features, lowest = equivariant_unet(1, C4, (16, 32, 64, 128, 128))(th.rand(1, 1, 16, 16))
    assert features.shape == (1, 16 * 4, 16, 16) and lowest.shape == (1, 128 * 4, 1, 1)


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: PlainPixelMaps(32, None, [8]), r"two levels, got \[8\]"),
        (lambda: EquivariantPixelMaps(32, None, C4, [2]), "two levels"),
        (lambda: PlainPixelMaps(32, (1, 12), CHANNELS, [4, 4]), "in_hand_channels .* 3 entries"),
        (lambda: EquivariantPixelMaps(32, None, C4, FIELDS, IN_HAND, HIDDEN, 4), "group .* 8 rotations"),
        (lambda: equivariant(32, dynamic_fields=0), "dynamic_fields .* got 0"),
    ],
)
def test_invalid_arguments_are_rejected(make, named):
    with pytest.raises(ValueError, match=named):
        make()
