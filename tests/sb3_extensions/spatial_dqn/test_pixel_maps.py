"""Networks that value every pixel rotate with the heightmap."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch as th
from torch.nn import functional as F

from sb3_extensions.encoders.observation import View
from sb3_extensions.encoders.unet import equivariant_unet, lowest_shape, plain_unet
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
EXACT = 1e-4  # relative to the standard deviation of the compared values
Turn = Callable[[th.Tensor], th.Tensor]
QUARTERS: dict[str, Turn] = {
    f"{k} quarters": lambda image, k=k: th.rot90(image, k, (-2, -1)) for k in range(1, 4)
}
FLIPS: dict[str, Turn] = {
    "flipped": lambda image: image.flip(-1),
    "turned and flipped": lambda image: th.rot90(image, 1, (-2, -1)).flip(-1),
}


@pytest.fixture(autouse=True)
def _seed() -> None:
    th.manual_seed(0)


def make_view(size: int, batch: int = 4) -> View:
    """Random images; every other gripper holds something."""
    image = th.rand(batch, 1, size, size)
    return View(image, image[:, 0], th.randn(batch, 1, SIDE, SIDE), th.arange(batch) % 2 == 1)


def turned(view: View, turn: Turn) -> View:
    return view._replace(image=turn(view.image), heights=turn(view.heights))


def assert_same(found: th.Tensor, expected: th.Tensor) -> None:
    spread = expected.std()
    assert spread > 0
    assert ((found - expected).abs().max() / spread).item() < EXACT


def equivariant(size: int, rotations: int = 1) -> EquivariantPixelMaps:
    group = Group("dihedral", 4) if rotations == 1 else Group("cyclic", 2 * rotations)
    return EquivariantPixelMaps(size, (1, SIDE), group, FIELDS, IN_HAND, HIDDEN, rotations)


def all_networks(size: int) -> dict[str, Any]:
    shapes = size, (1, SIDE)
    return {
        "plain": PlainPixelMaps(*shapes, CHANNELS, PATCH_MAP, 3),
        "rotated": RotatedPixelMaps(*shapes, CHANNELS, PATCH_MAP, 3),
        "equivariant": equivariant(size),
        "equivariant with yaws": equivariant(size, 3),
    }


@pytest.mark.parametrize("gradient", [True, False])
@pytest.mark.parametrize("size", [32, 30])
@pytest.mark.parametrize("turn", [*QUARTERS, *FLIPS])
def test_maps_rotate_with_the_image(turn: str, size: int, gradient: bool) -> None:
    network, view, apply = equivariant(size), make_view(size), {**QUARTERS, **FLIPS}[turn]
    with th.set_grad_enabled(gradient):
        maps, encoding = network(view)
        turned_maps, turned_encoding = network(turned(view, apply))
    assert maps.shape == (4, 1, size, size) and maps.dtype == th.float32
    for sample in range(4):  # picks and places
        assert_same(turned_maps[sample], apply(maps[sample]))
    assert_same(turned_encoding, apply(encoding))


@pytest.mark.parametrize(("rotations", "dynamic_fields"), [(1, 4), (16, 4)])
def test_untrained_small_networks_have_different_values_of_places(
    rotations: int, dynamic_fields: int
) -> None:
    """Of one field behind a ReLU all numbers may be 0 everywhere: then nothing is ever learned of places."""
    group = Group("dihedral", 4) if rotations == 1 else Group("cyclic", 2 * rotations)
    view = make_view(32)
    for seed in range(10):
        th.manual_seed(seed)
        network = EquivariantPixelMaps(
            32, (1, SIDE), group, (2, 2, 4, 4), IN_HAND, HIDDEN, rotations, dynamic_fields
        )
        assert network.dynamic is not None
        assert network.dynamic.out_type.size == dynamic_fields * group.order
        with th.no_grad():
            maps, _ = network(view)
        assert (maps[view.places].flatten(1).std(dim=1) > 0).all(), seed


@pytest.mark.parametrize("rotations", [2, 4, 6])
@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_maps_rotate_and_yaws_shift(quarters: int, rotations: int) -> None:
    network, view = equivariant(16, rotations), make_view(16)
    turn = QUARTERS[f"{quarters} quarters"]
    with th.no_grad():
        maps, encoding = network(view)
        turned_maps, turned_encoding = network(turned(view, turn))
    assert maps.shape == (4, rotations, 16, 16)
    shifted = turn(maps).roll(quarters * rotations // 2, dims=1)
    for sample in range(4):
        assert_same(turned_maps[sample], shifted[sample])
        assert maps[sample].std(dim=0).mean() > 0.05 * maps[sample].std()  # yaws differ
    assert_same(turned_encoding, turn(encoding))


@pytest.mark.parametrize("size", [16, 18])
def test_rotated_maps_shift_under_quarter_turns(size: int) -> None:
    """Except yaws that wrap around at pi, for which the plain network has another input."""
    network = RotatedPixelMaps(size, (1, SIDE), CHANNELS, PATCH_MAP, 6)
    view = make_view(size)
    with th.no_grad():
        maps, _ = network(view)
        turned_maps, _ = network(turned(view, QUARTERS["1 quarters"]))
    assert_same(turned_maps[:, 3:], th.rot90(maps[:, :3], 1, (-2, -1)))


def test_rotated_maps_shift_under_one_step_between_yaws() -> None:
    size, rotations = 32, 6
    network = RotatedPixelMaps(size, (1, SIDE), CHANNELS, PATCH_MAP, rotations)
    line = th.linspace(-1, 1, size)
    x, y = th.meshgrid(line, line, indexing="ij")
    bumps = [th.exp(-((x - a) ** 2 + (y - b) ** 2) / 0.1) for a, b in ((0.3, 0.2), (-0.3, 0.3), (0.0, -0.4))]
    view = make_view(size, 2)._replace(image=th.stack(bumps).sum(0).expand(2, 1, size, size))
    angle = th.full((2,), np.pi / rotations)
    with th.no_grad():
        maps, _ = network(view)
        turned_maps, _ = network(view._replace(image=rotate_images(view.image, angle)))
    expected = rotate_images(maps, angle)
    inside = (x.hypot(y) < 0.8).expand_as(maps[:, 1:])
    error = (turned_maps[:, 1:] - expected[:, :-1])[inside].std()
    assert error < 0.15 * expected[:, :-1][inside].std()
    assert error < 0.3 * (turned_maps[:, :-1] - expected[:, :-1])[inside].std()


def test_rotated_maps_equal_the_network_on_rotated_images() -> None:
    size, rotations = 16, 4
    network = RotatedPixelMaps(size, (1, SIDE), CHANNELS, PATCH_MAP, rotations)
    view = make_view(size)
    with th.no_grad():
        maps, encoding = network(view)
        for sample in range(4):
            for yaw in range(rotations):
                angle = th.tensor([yaw * np.pi / rotations])
                one = view.of(th.tensor([sample]))
                alone = one._replace(image=rotate_images(one.image, -angle, network.canvas))
                values, seen = network.network(alone)
                expected = rotate_images(values, angle, size)[0, 0]
                th.testing.assert_close(maps[sample, yaw], expected, atol=1e-6, rtol=1e-4)
                if yaw == 0:
                    th.testing.assert_close(encoding[sample], seen[0], atol=1e-6, rtol=1e-4)


@pytest.mark.parametrize("kind", ["plain", "rotated", "equivariant", "equivariant with yaws"])
def test_maps_depend_on_the_in_hand_image_and_the_primitive(kind: str) -> None:
    """Places depend on the in-hand image, picks and places differ, samples are independent."""
    network, view = all_networks(16)[kind], make_view(16)
    with th.no_grad():
        maps, encoding = network(view)
        assert maps.shape == (4, network.rotations, 16, 16)
        assert encoding.shape[1:] == network.encoding_shape
        other_hand, _ = network(view._replace(in_hand=view.in_hand.flip(0)))
        assert not th.allclose(maps[1::2], other_hand[1::2])
        if "equivariant" in kind:  # whose picks do not depend on the in-hand image
            assert th.equal(maps[::2], other_hand[::2])
        swapped, _ = network(view._replace(places=~view.places))
        assert not th.allclose(maps, swapped)
        for sample in range(4):
            alone, _ = network(view.of(th.tensor([sample])))
            th.testing.assert_close(alone[0], maps[sample], atol=1e-6, rtol=1e-4)
        assert maps.abs().max() < 1


def test_networks_accept_no_in_hand_image() -> None:
    shapes = 16, None
    view = make_view(16)._replace(in_hand=None)
    group = Group("dihedral", 4)
    for network in (
        PlainPixelMaps(*shapes, CHANNELS, PATCH_MAP, 3),
        EquivariantPixelMaps(*shapes, group, FIELDS, IN_HAND, HIDDEN),
    ):
        assert network(view)[0].shape == (4, network.rotations, 16, 16)


@pytest.mark.parametrize("size", [30, 17, 32])
def test_padding_does_not_change_maps(size: int) -> None:
    """A U-Net of another size than a multiple sees zeros around the image."""
    network = plain_unet(1, CHANNELS, 0)
    image = th.rand(2, 1, size, size)
    missing = -size % 2 ** (len(network.downs) - 1)
    before, after = missing // 2, missing - missing // 2
    features, lowest = network(image)
    padded, padded_lowest = network(F.pad(image, (before, after, before, after)))
    assert features.shape == (2, CHANNELS[0], size, size)
    th.testing.assert_close(features, padded[..., before : before + size, before : before + size])
    th.testing.assert_close(lowest, padded_lowest)
    assert lowest.shape[1:] == lowest_shape(size, CHANNELS)


def test_widths_are_the_authors() -> None:
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
    steerable = equivariant_unet(1, Group("cyclic", 4), (16, 32, 64, 128, 128))
    with th.no_grad():
        features, lowest = steerable(th.rand(1, 1, 16, 16))
    assert features.shape == (1, 16 * 4, 16, 16) and lowest.shape == (1, 128 * 4, 1, 1)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: PlainPixelMaps(32, None, [8]), r"must have at least two levels, got \[8\]"),
        (lambda: EquivariantPixelMaps(32, None, Group("cyclic", 4), [2]), "must have at least two levels"),
        (lambda: PlainPixelMaps(32, (1, 12), CHANNELS, [4, 4]), "in_hand_channels must have 3 entries"),
        (
            lambda: EquivariantPixelMaps(32, None, Group("cyclic", 4), FIELDS, IN_HAND, HIDDEN, 4),
            "group must be cyclic with 8 rotations for 4 yaws, got Group",
        ),
        (
            lambda: EquivariantPixelMaps(
                32, None, Group("cyclic", 4), FIELDS, IN_HAND, HIDDEN, dynamic_fields=0
            ),
            "dynamic_fields must be positive, got 0",
        ),
    ],
)
def test_invalid_arguments_are_rejected(make: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
