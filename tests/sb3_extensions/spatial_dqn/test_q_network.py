"""Q functions on a grid: their levels, the chain of best choices, and that both kinds learn the same."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from torch.nn import functional as F

from sb3_extensions.encoders.observation import SceneView
from sb3_extensions.equivariant.groups import Group
from sb3_extensions.spatial_dqn.asr_heads import (
    DeicticLevel,
    EquivariantRotations,
    Level,
    PlainLevel,
    PlainRotations,
)
from sb3_extensions.spatial_dqn.codec import SpatialActionCodec
from sb3_extensions.spatial_dqn.pixel_maps import (
    EquivariantPixelMaps,
    PixelMaps,
    PlainPixelMaps,
    RotatedPixelMaps,
)
from sb3_extensions.spatial_dqn.q_network import SpatialQNetwork

SIZE, SIDE, YAWS = 16, 12, 4
BATCH = 5
CHANNELS, PATCH_MAP, IN_HAND = (4, 8), (4, 4, 8), (4, 4, 8, 8)
NARROW = ((4, 4, 8, 8), (16, 8))


@pytest.fixture(autouse=True)
def _seed() -> None:
    th.manual_seed(0)


def make_space(**boxes: tuple[int, ...]) -> spaces.Dict:
    shapes = {"heightmap": (1, SIZE, SIZE), "in_hand": (1, SIDE, SIDE), "holding": (1,), **boxes}
    return spaces.Dict({name: spaces.Box(0.0, 0.4, shape, np.float32) for name, shape in shapes.items()})


def make_view(**kwargs: Any) -> SceneView:
    return SceneView(make_space(), **{"quantise": None, "standardise": (0.05, 0.05), **kwargs})


def make_codec(sequence: str) -> SpatialActionCodec:
    return SpatialActionCodec(SIZE, sequence, num_rotations=YAWS, num_heights=3, num_tilts=3)


def fcn(codec: SpatialActionCodec, view: SceneView) -> tuple[PixelMaps, list[Level]]:
    return PlainPixelMaps(view.size, view.in_hand_shape, CHANNELS, PATCH_MAP, YAWS), []


def rot_fcn(codec: SpatialActionCodec, view: SceneView) -> tuple[PixelMaps, list[Level]]:
    return RotatedPixelMaps(view.size, view.in_hand_shape, CHANNELS, PATCH_MAP, YAWS), []


def equivariant_fcn(codec: SpatialActionCodec, view: SceneView) -> tuple[PixelMaps, list[Level]]:
    return EquivariantPixelMaps(
        view.size, view.in_hand_shape, Group("cyclic", 2 * YAWS), (4, 4), IN_HAND, 16, YAWS
    ), []


def asr(codec: SpatialActionCodec, view: SceneView) -> tuple[PixelMaps, list[Level]]:
    pixels = PlainPixelMaps(view.size, view.in_hand_shape, CHANNELS, PATCH_MAP)
    return pixels, [PlainRotations(codec, view, pixels.encoding_shape, PATCH_MAP, 16)]


def asr_6d(codec: SpatialActionCodec, view: SceneView) -> tuple[PixelMaps, list[Level]]:
    pixels = PlainPixelMaps(view.size, view.in_hand_shape, CHANNELS, PATCH_MAP)
    args: Any = (view, pixels.encoding_shape, *NARROW)
    return pixels, [PlainLevel(codec, name, *args) for name in codec.grids]


def deictic(
    codec: SpatialActionCodec, view: SceneView, pool_encoding: bool = False
) -> tuple[PixelMaps, list[Level]]:
    pixels = EquivariantPixelMaps(view.size, view.in_hand_shape, Group("dihedral", 4), (4, 4), IN_HAND, 16)
    widths: Any = ((4, 4, 6, 4), IN_HAND, (16, 16), pool_encoding)
    rotations = EquivariantRotations(codec, view, pixels.encoding_shape, *widths)
    others = [DeicticLevel(codec, name, view, *NARROW) for name in list(codec.grids)[1:]]
    return pixels, [rotations, *others]


MakeLevels = Callable[[SpatialActionCodec, SceneView], tuple[PixelMaps, list[Level]]]
NETWORKS: dict[str, tuple[str, MakeLevels]] = {
    "FCN": ("pxyr", fcn),
    "Rot FCN": ("pxyr", rot_fcn),
    "Equivariant FCN": ("pxyr", equivariant_fcn),
    "ASR": ("pxyr", asr),
    "Equivariant ASR": ("pxyr", deictic),
    "ASR 6D": ("zrrrxyp", asr_6d),
    "Deictic ASR": ("pxyzrrr", deictic),
}


def make_network(kind: str, **kwargs: Any) -> SpatialQNetwork:
    sequence, make_levels = NETWORKS[kind]
    codec = make_codec(sequence)
    view = make_view()
    return SpatialQNetwork(codec, view, *make_levels(codec, view), **kwargs)


def observe(batch: int = BATCH) -> dict[str, th.Tensor]:
    return {
        "heightmap": 0.1 * th.rand(batch, 1, SIZE, SIZE),
        "in_hand": 0.1 * th.rand(batch, 1, SIDE, SIDE),
        "holding": (th.arange(batch) % 2).float()[:, None],
    }


def maps_of(network: SpatialQNetwork, observations: dict[str, th.Tensor]) -> th.Tensor:
    """Values of all pixels at the first level, (batch, yaws, size, size)."""
    with th.no_grad():
        values: th.Tensor = network.pixel_maps(network.scene_view(observations))[0]
    return values


def whole_grid_of(codec: SpatialActionCodec, batch: int) -> th.Tensor:
    return th.stack([th.randint(count, (batch,)) for count in codec.shape], dim=1)


@pytest.mark.parametrize("kind", NETWORKS)
def test_greedy_is_the_best_choice_at_every_level(kind: str) -> None:
    """Compare with NumPy for each level, and with the values of all levels for the chosen indices."""
    network, observations = make_network(kind), observe()
    indices, values = network.greedy(observations)
    assert indices.shape == (BATCH, len(network.codec.shape)) and indices.dtype == th.int64
    maps = maps_of(network, observations).numpy()
    chosen = []
    for sample in range(BATCH):
        yaw, row, column = np.unravel_index(maps[sample].argmax(), maps[sample].shape)
        chosen.append([row, column, yaw][: 2 + (len(maps[sample]) > 1)])
    with th.no_grad():
        view = network.scene_view(observations)
        encoding = network.pixel_maps(view)[1]
        best = maps.reshape(BATCH, -1).max(axis=1)
        for level in network.levels:
            found = level(view, encoding, th.tensor(chosen)).numpy()
            chosen = [[*before, row.argmax()] for before, row in zip(chosen, found, strict=True)]
            best = found.max(axis=1)
        at_once = network.values(observations, indices)
    np.testing.assert_array_equal(indices, chosen)
    np.testing.assert_allclose(values, best, rtol=1e-5, atol=1e-8)
    for level_values, choice in zip(at_once, network.choices(indices), strict=True):
        best = level_values.gather(1, choice[:, None])[:, 0]
        th.testing.assert_close(best, level_values.amax(dim=1), rtol=1e-5, atol=1e-8)
    th.testing.assert_close(best, values, rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("kind", NETWORKS)
def test_values_of_choices_equal_the_maps(kind: str) -> None:
    network, observations = make_network(kind), observe(40)
    shape = network.codec.shape
    indices = whole_grid_of(network.codec, 40)
    with th.no_grad():
        values, maps = network.values(observations, indices), maps_of(network, observations)
    yaws = maps.shape[1]
    sizes = [yaws * SIZE**2, *shape[2 + (yaws > 1) :]]
    assert [tuple(level.shape) for level in values] == [(40, size) for size in sizes]
    assert all(level.dtype == th.float32 for level in values)
    choices = network.choices(indices)
    rows = th.arange(40)
    expected = maps[rows, indices[:, 2] if yaws > 1 else 0, indices[:, 0], indices[:, 1]]
    th.testing.assert_close(values[0][rows, choices[0]], expected)
    for place, choice in enumerate(choices[1:]):
        assert th.equal(choice, indices[:, 2 + (yaws > 1) + place])


@pytest.mark.parametrize("kind", ["ASR", "ASR 6D", "Deictic ASR"])
def test_levels_depend_on_earlier_choices_only(kind: str) -> None:
    """The order is pixel, yaw, height, tilts about y and x."""
    network, observations = make_network(kind), observe(20)
    observations["heightmap"][:, :, 3:13, 3:13] += 0.05
    names = [level.name for level in network.levels]
    assert names == ["theta", "z", "phi", "psi"][: len(names)]
    indices = whole_grid_of(network.codec, 20)
    indices[:, :2] = 5 + indices[:, :2] % 6
    with th.no_grad():
        values = network.values(observations, indices)
        for place in range(indices.shape[1]):
            other = indices.clone()
            other[:, place] = (other[:, place] + 1) % network.codec.shape[place]
            changed = [
                not th.equal(a, b) for a, b in zip(values, network.values(observations, other), strict=True)
            ]
            # Level k sees the pixel and k - 1 numbers more
            assert changed == [level > max(0, place - 1) for level in range(len(values))]


@pytest.mark.parametrize("kind", ["ASR", "ASR 6D", "Equivariant ASR"])
def test_later_levels_train_the_encoding_of_the_first(kind: str) -> None:
    network, observations = make_network(kind), observe()
    values = network.values(observations, whole_grid_of(network.codec, BATCH))
    values[1].sum().backward()
    gradients = {
        name: parameter.grad is not None and bool(parameter.grad.any())
        for name, parameter in network.pixel_maps.named_parameters()
    }
    assert all(
        found for name, found in gradients.items() if name.startswith("unet.downs") and "bias" not in name
    )
    assert not any(found for name, found in gradients.items() if name.startswith(("unet.ups", "head")))


@pytest.mark.parametrize("turned", [1, 2, 3])
@pytest.mark.parametrize("pool_encoding", [True, False])
def test_pooled_encodings_keep_yaws_equivariant(turned: int, pool_encoding: bool) -> None:
    """Rotate the whole scene by 90 degrees, with all levels in one network."""
    codec, view = make_codec("pxyr"), make_view()
    network = SpatialQNetwork(codec, view, *deictic(codec, view, pool_encoding))
    observations, indices = observe(), whole_grid_of(codec, BATCH)
    after = {**observations, "heightmap": th.rot90(observations["heightmap"], turned, (2, 3))}
    moved = indices
    for _ in range(turned):
        moved = th.stack([SIZE - 1 - moved[:, 1], moved[:, 0], (moved[:, 2] + YAWS // 2) % YAWS], dim=1)
    with th.no_grad():
        first, second = network.values(observations, indices), network.values(after, moved)
    maps = th.rot90(first[0].view(-1, SIZE, SIZE), turned, (1, 2)).flatten(1)
    th.testing.assert_close(second[0], maps, rtol=0, atol=float(1e-4 * maps.std()))
    yaws = first[1].roll(turned * YAWS // 2, dims=1)
    assert ((second[1] - yaws).abs().max() < 1e-4 * yaws.std()) == pool_encoding


def test_one_level_and_several_levels_learn_the_same_best_actions() -> None:
    """The value of an action is the sum of a value of the pixel and a value of the yaw."""
    of_yaw = th.tensor([0.1, 0.5, 0.3, 0.2])
    observations, peaks = observe(4), th.tensor([[3, 4], [12, 9], [7, 13], [10, 2]])
    line = th.arange(SIZE)
    away = (line[:, None] - peaks[:, 0, None, None]) ** 2 + (line - peaks[:, 1, None, None]) ** 2
    of_pixel = th.exp(-away / 4.0)
    observations["heightmap"] = 0.1 * of_pixel[:, None] + 0.05 * observations["heightmap"]

    def learn(kind: str, targets: Callable[[th.Tensor], Sequence[th.Tensor]]) -> th.Tensor:
        network = make_network(kind)
        optimizer = th.optim.Adam(network.parameters(), lr=2e-2)
        for _ in range(60):
            indices = whole_grid_of(network.codec, 4)
            values = network.values(observations, indices)
            loss = sum(F.mse_loss(*pair) for pair in zip(values, targets(indices), strict=True))
            optimizer.zero_grad()
            loss.backward()  # type: ignore[union-attr]
            optimizer.step()
        return network.greedy(observations)[0]

    def all_actions(indices: th.Tensor) -> list[th.Tensor]:
        return [(of_yaw[:, None, None] + of_pixel[:, None]).flatten(1)]

    def best_at_each_level(indices: th.Tensor) -> list[th.Tensor]:
        there = of_pixel[th.arange(4), indices[:, 0], indices[:, 1]]
        return [(of_pixel + of_yaw.max()).flatten(1), there[:, None] + of_yaw]

    expected = th.cat([peaks, th.ones(4, 1, dtype=th.int64)], dim=1)
    for kind, targets in (("FCN", all_actions), ("ASR", best_at_each_level)):
        np.testing.assert_array_equal(learn(kind, targets), expected, err_msg=kind)


def test_view_has_rounded_standardised_images() -> None:
    view = make_view(quantise="uint8", standardise=(0.1, 0.02))
    observations = observe()
    seen = view(observations)
    heights = (observations["heightmap"] / 0.4 * 255).round() * 0.4 / 255
    th.testing.assert_close(seen.heights, heights[:, 0])
    th.testing.assert_close(seen.image, (heights - 0.1) / 0.02)
    assert seen.in_hand is not None and seen.in_hand.shape == (BATCH, 1, SIDE, SIDE)
    assert seen.places.tolist() == [False, True] * 2 + [False]
    some = seen.of(th.tensor([3, 1]))
    assert th.equal(some.heights, seen.heights[[3, 1]]) and some.places.tolist() == [True, True]


def test_without_holding_all_actions_are_picks() -> None:
    space = spaces.Dict({"depth": spaces.Box(0.0, 0.4, (1, SIZE, SIZE), np.float32)})
    view = SceneView(space, image_key="depth")
    seen = view({"depth": th.rand(2, 1, SIZE, SIZE)})
    assert seen.in_hand is None and not seen.places.any()
    network = SpatialQNetwork(make_codec("xyr"), view, *fcn(make_codec("xyr"), view))
    assert network.greedy({"depth": th.rand(2, 1, SIZE, SIZE)})[0].shape == (2, 3)


def test_precision_changes_little() -> None:
    observations = observe()
    indices = whole_grid_of(make_codec("pxyr"), BATCH)
    results = []
    for kwargs in ({}, {"autocast": "bf16"}):
        th.manual_seed(0)
        with th.no_grad():
            results.append(make_network("Equivariant ASR", **kwargs).values(observations, indices))
    for first, second in zip(*results, strict=True):
        assert second.dtype == th.float32
        assert (first - second).abs().max() < 0.1 * first.abs().max()


@pytest.mark.parametrize(
    ("kind", "sequence", "chosen", "needed"),
    [
        ("FCN", "pxyzrrr", r"\['theta'\]", r"\['theta', 'z', 'phi', 'psi'\]"),
        ("FCN", "pxy", r"\['theta'\]", r"\[\]"),
        ("ASR", "pxyzr", r"\['theta'\]", r"\['theta', 'z'\]"),
    ],
)
def test_levels_of_another_action_sequence_are_rejected(
    kind: str, sequence: str, chosen: str, needed: str
) -> None:
    levels = NETWORKS[kind][1](make_codec("pxyr"), make_view())
    with pytest.raises(
        ValueError, match=f"needs levels for {needed} after the pixel, got levels for {chosen}"
    ):
        SpatialQNetwork(make_codec(sequence), make_view(), *levels)


@pytest.mark.parametrize(
    ("space", "kwargs", "message"),
    [
        (
            make_space()["heightmap"],
            {},
            r"a Dict with a heightmap \(1, size, size\) under 'heightmap', got Box",
        ),
        (make_space(), {"image_key": "depth"}, "under 'depth'"),
        (make_space(heightmap=(3, SIZE, SIZE)), {}, r"a heightmap \(1, size, size\)"),
        (make_space(heightmap=(SIZE, SIZE)), {}, r"a heightmap \(1, size, size\)"),
        (
            make_space(heightmap=(1, SIZE, 12)),
            {},
            r"must have images, all \(channels, size, size\), .*heightmap",
        ),
        (make_space(in_hand=(1, 12, 13)), {}, r"must have images, all \(channels, size, size\), .*in_hand"),
        (make_space(in_hand=(12,)), {}, "must have images, .*in_hand"),
        (make_space(), {"standardise": (0.1, 0.0)}, r"standard deviation above 0\), got \(0.1, 0.0\)"),
        (make_space(), {"quantise": "uint4"}, "uint4"),
    ],
)
def test_invalid_observation_spaces_are_rejected(space: Any, kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SceneView(space, **kwargs)


def test_unknown_precision_is_rejected() -> None:
    with pytest.raises(ValueError, match="autocast must be None or"):
        make_network("FCN", autocast="fp8")
