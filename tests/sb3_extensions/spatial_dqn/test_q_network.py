"""Networks of spatial Q functions: patches, pixel maps, levels, the chain of best choices."""

import math

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from torch.nn import functional as F

from bulletarm_gym.geometry import Pose, euler_pose
from bulletarm_gym.observations import ElevationMap
from bulletarm_gym.observations.images import projections, rotated_crop
from sb3_extensions.encoders.observation import View
from sb3_extensions.encoders.patch_encoders import LAST_SIDE, LAST_SIDE_OF_PIXELS, PatchVector
from sb3_extensions.encoders.unet import equivariant_unet, plain_unet
from sb3_extensions.equivariant.groups import Group
from sb3_extensions.spatial_dqn.asr_heads import PATCH_STAGES, DeicticLevel
from sb3_extensions.spatial_dqn.patches import crop_patches, rotate_zero_padded
from sb3_extensions.spatial_dqn.pixel_maps import EquivariantPixelMaps, RotatedPixelMaps

IMAGE_SIDE, RESOLUTION = 20, 0.02  # pixels, m
# In the middle, near each border, in corners, and beyond.
ROWS = th.tensor([9, 10, 1, 19, 0, 19, 18, -2])
COLUMNS = th.tensor([11, 0, 17, 7, 0, 19, 1, 5])
ANGLES = th.tensor([0.0, math.pi / 2, 0.3, -2.0, 1.1, 3.0, -0.7, 6.0], dtype=th.float64)


@pytest.mark.parametrize(("size", "side", "side_of_pixels"), [(16, 8, 8), (24, 6, 6), (40, 5, 10)])
def test_maps_before_linear_layers_are_as_large_as_the_authors(size, side, side_of_pixels):
    for last_side, expected in ((LAST_SIDE, side), (LAST_SIDE_OF_PIXELS, side_of_pixels)):
        network = PatchVector(1, size, [2, 2, 2, 2], [3], last_side)
        linear = next(layer for layer in network if isinstance(layer, th.nn.Linear))
        assert linear.in_features == 2 * expected**2
        assert network(th.zeros(1, 1, size, size)).shape == (1, 3)


@pytest.fixture
def images():
    return 0.4 * th.rand(len(ROWS), 2, IMAGE_SIDE, IMAGE_SIDE, generator=th.Generator().manual_seed(0))


def rotated_by_90(images):
    """Return images rotated by 90 degrees, and the rows and columns of the test pixels in them."""
    return th.rot90(images, k=1, dims=(-2, -1)), IMAGE_SIDE - 1 - COLUMNS, ROWS


@pytest.mark.parametrize(
    ("size", "angles"), [(1, None), (2, ANGLES), (7, None), (7, ANGLES), (8, None), (8, ANGLES), (24, ANGLES)]
)
def test_patches_are_in_hand_crops_that_rotate_with_the_image(images, size, angles):
    patches = crop_patches(images, ROWS, COLUMNS, size, angles)
    assert patches.dtype == th.float32
    yaws = th.zeros(len(ROWS)) if angles is None else angles
    for k, channel in np.ndindex(len(ROWS), 2):
        view = ElevationMap(images[k, channel].numpy(), (0.45, 0.1), 0.4)
        x, y = np.array([0.25, -0.1]) + (np.array([ROWS[k], COLUMNS[k]]) + 0.5) * RESOLUTION
        [expected] = rotated_crop(view, Pose.planar(x, y, 0.0, yaws[k].item()), size)
        np.testing.assert_allclose(patches[k, channel], expected, atol=1e-6)
    after = crop_patches(*rotated_by_90(images), size, angles)
    th.testing.assert_close(after, th.rot90(patches, k=1, dims=(-2, -1)), atol=1e-7, rtol=0.0)
    after = crop_patches(*rotated_by_90(images), size, yaws + math.pi / 2)
    th.testing.assert_close(after, patches, atol=1e-6, rtol=0.0)
    part = images[:, :, :, :13]  # images need not be square
    expected = crop_patches(F.pad(part, [0, 7, 0, 0]), ROWS, COLUMNS, size, angles)
    th.testing.assert_close(crop_patches(part, ROWS, COLUMNS, size, angles), expected)


SIDE = 12  # of the in-hand image


def make_view(size, batch=4):
    """Random images; every other gripper holds something."""
    image = th.rand(batch, 1, size, size)
    return View(image, image[:, 0], th.randn(batch, 1, SIDE, SIDE), th.arange(batch) % 2 == 1)


@pytest.mark.parametrize("rotations", [1, 16])
def test_untrained_small_networks_have_different_values_of_places(rotations):
    """Of one field behind a ReLU all numbers may be 0 everywhere: then nothing is ever learned of places."""
    view = make_view(32)
    group = Group("dihedral", 4) if rotations == 1 else Group("cyclic", 2 * rotations)
    for seed in range(10):
        th.manual_seed(seed)
        arguments = (group, (2, 2, 4, 4), (4, 4, 6, 6), 16, rotations)
        network = EquivariantPixelMaps(32, (1, SIDE), *arguments, dynamic_fields=4)
        assert network.dynamic.out_type.size == 4 * network.dynamic.out_type.group.order
        with th.no_grad():
            maps, _ = network(view)
        assert (maps[view.places].flatten(1).std(dim=1) > 0).all(), seed


def test_rotated_maps_equal_the_network_on_rotated_images():
    size, rotations = 16, 4
    network = RotatedPixelMaps(size, (1, SIDE), (4, 6, 8), (4, 4, 6), rotations)
    view = make_view(size)
    with th.no_grad():
        maps, encoding = network(view)
        for sample, yaw in np.ndindex(4, rotations):
            angle = th.tensor([yaw * np.pi / rotations])
            one = view.of(th.tensor([sample]))
            alone = one._replace(image=rotate_zero_padded(one.image, -angle, network.canvas))
            values, seen = network.network(alone)
            expected = rotate_zero_padded(values, angle, size)[0, 0]
            th.testing.assert_close(maps[sample, yaw], expected, atol=1e-6, rtol=1e-4)
            if yaw == 0:
                th.testing.assert_close(encoding[sample], seen[0], atol=1e-6, rtol=1e-4)


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
        unet = equivariant_unet(1, Group("cyclic", 4), (16, 32, 64, 128, 128))
        features, lowest = unet(th.rand(1, 1, 16, 16))
    assert features.shape == (1, 16 * 4, 16, 16) and lowest.shape == (1, 128 * 4, 1, 1)


SIZE, SIDE = 32, 12


def random_indices(codec, count=20):
    """Return pixels inside the block and random other indices."""
    th.manual_seed(0)
    pixels = [th.randint(10, 22, (count,)) for _ in range(2)]
    return th.stack([*pixels, *(th.randint(n, (count,)) for n in codec.shape[2:])], dim=1)


def test_greedy_is_the_best_choice_at_every_level(policy, scenes):
    """Of the values of each level for the choices at the levels before it."""
    network = policy.q_net
    indices, best = network.greedy(scenes)
    assert indices.shape == (20, len(network.codec.shape)) and indices.dtype == th.int64
    with th.no_grad():
        levels = network.values(scenes, indices)
    in_first = 2 + (len(network.levels) < len(network.codec.grids))  # pixels, or pixels and yaws
    sizes = [math.prod(network.codec.shape[:in_first]), *network.codec.shape[in_first:]]
    assert [tuple(level.shape) for level in levels] == [(20, size) for size in sizes]
    for level, choice in zip(levels, network.choices(indices), strict=True):
        values = level.gather(1, choice[:, None])[:, 0]
        th.testing.assert_close(values, level.amax(dim=1), rtol=1e-5, atol=1e-8)
    th.testing.assert_close(values, best, rtol=1e-5, atol=1e-8)


def test_levels_depend_on_earlier_choices_and_the_view(policy, scenes):
    """The order is pixel, yaw, height, tilts about y and x. Samples are independent."""
    network = policy.q_net
    names = [level.name for level in network.levels]
    assert names == ["theta", "z", "phi", "psi"][: len(names)]
    indices = random_indices(network.codec)
    with th.no_grad():
        values = network.values(scenes, indices)

        def changed(others):
            return [not th.equal(a, b) for a, b in zip(values, others, strict=True)]

        for place in range(indices.shape[1]):
            other = indices.clone()
            other[:, place] = (other[:, place] + 1) % network.codec.shape[place]
            if network.levels:  # level k sees the pixel and k - 1 numbers more
                expected = [level > max(0, place - 1) for level in range(len(values))]
                assert changed(network.values(scenes, other)) == expected
        for name, part in scenes.items():
            assert all(changed(network.values({**scenes, name: part.flip(0).flip(-1)}, indices))), name
        alone = network.values({name: part[3:4] for name, part in scenes.items()}, indices[3:4])
    for one, level in zip(alone, values, strict=True):
        th.testing.assert_close(one[0], level[3], atol=1e-6, rtol=1e-3)


@pytest.mark.parametrize(("side", "pool_encoding"), [*[(side, True) for side in PATCH_STAGES], (SIDE, False)])
def test_pooled_encodings_keep_yaws_equivariant(side, pool_encoding, make_picking, make_policy):
    """Rotate the whole scene by 90 degrees, with all levels in one network."""
    networks = {"patch_fields": (4, 4, 6, 6, 4)[: len(PATCH_STAGES[side])], "pool_encoding": pool_encoding}
    network = make_policy("EquivariantASRPolicy", "pxyr", make_picking(in_hand_size=side), networks).q_net
    scenes = {"heightmap": 0.1 * th.rand(20, 1, SIZE, SIZE), "in_hand": 0.1 * th.rand(20, 1, side, side)}
    scenes["holding"] = (th.arange(20) % 2).float()[:, None]
    indices = random_indices(network.codec)
    with th.no_grad():
        first = network.values(scenes, indices)
        for turns in (1, 2, 3):
            after = {**scenes, "heightmap": th.rot90(scenes["heightmap"], turns, (2, 3))}
            moved = indices
            for _ in range(turns):
                moved = th.stack([SIZE - 1 - moved[:, 1], moved[:, 0], (moved[:, 2] + 2) % 4], dim=1)
            second = network.values(after, moved)
            maps = th.rot90(first[0].view(-1, SIZE, SIZE), turns, (1, 2)).flatten(1)
            th.testing.assert_close(second[0], maps, rtol=0, atol=float(1e-4 * maps.std()))
            expected = first[1].roll(2 * turns, dims=1)
            assert ((second[1] - expected).abs().max() < 1e-4 * expected.std()) == pool_encoding


@pytest.mark.parametrize("case", [("EquivariantASRPolicy", "pxyzrrr")], indirect=True)
def test_deictic_levels_see_the_projection_of_each_candidate(policy, scenes):
    """Against a loop over samples and candidates, with the environment's own projections."""
    network = policy.q_net
    codec, indices = network.codec, random_indices(network.codec)
    # At yaw 0 voxels are on the borders of pixels, which the environment rounds arbitrarily
    indices[:, 2] = 1 + indices[:, 2] % 3 // 2 * 2
    mean, deviation = 0.0, 0.03  # of the fixture's policies
    with th.no_grad():
        view = network.scene_view(scenes)
        values = network.values(scenes, indices)[2:]
    for level, found in zip(network.levels[1:], values, strict=True):
        assert isinstance(level, DeicticLevel)
        known = list(codec.grids)[: list(codec.grids).index(level.name)]
        for sample, candidate in np.ndindex(6, len(codec.grids[level.name])):
            row, column, *others = indices[sample].tolist()
            chosen = dict(zip(codec.grids, others, strict=True))
            at = {name: codec.grids[name][chosen[name]] for name in known}
            at[level.name] = codec.grids[level.name][candidate]
            place = ((row + 0.5) * 0.4 / SIZE, (column + 0.5) * 0.4 / SIZE, at["z"])
            pose = euler_pose(place, (at.get("psi", 0.0), at.get("phi", 0.0), at["theta"]))
            seen = projections(ElevationMap(view.heights[sample].numpy(), (0.2, 0.2), 0.4), pose, SIDE)
            patch = th.cat([(th.as_tensor(seen) - mean) / deviation, view.in_hand[sample]])
            with th.no_grad():
                expected = level.head(level.encoder(patch[None]))[0, int(view.places[sample])]
            th.testing.assert_close(found[sample, candidate], expected, atol=1e-5, rtol=1e-3)


def test_spaces_without_in_hand_image_or_gripper(case, scenes, make_policy):
    """Patches are as large as the authors', and all actions are picks."""
    space = spaces.Dict({"depth": spaces.Box(0.0, 0.4, (1, SIZE, SIZE), np.float32)})
    name, sequence = case
    networks = {"patch_fields": (4,) * 5} if name == "EquivariantASRPolicy" else {}
    policy = make_policy(
        name, sequence, network_kwargs=networks, observation_space=space, image_key="depth", quantise=None
    )
    observations = {"depth": scenes["heightmap"]}
    seen = policy.q_net.scene_view(observations)
    assert seen.in_hand is None and not seen.places.any()
    assert all(level.patch_size == 24 for level in policy.q_net.levels)
    assert policy.q_net.greedy(observations)[0].shape == (20, len(policy.codec.shape))
