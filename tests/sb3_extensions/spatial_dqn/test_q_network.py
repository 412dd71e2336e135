"""Q functions on a grid: their levels, the chain of best choices, and what the values depend on."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from bulletarm_gym.geometry import euler_pose
from bulletarm_gym.observations import ElevationMap
from bulletarm_gym.observations.images import projections
from sb3_extensions.encoders.observation import SceneView
from sb3_extensions.spatial_dqn.asr_heads import PATCH_STAGES, DeicticLevel
from sb3_extensions.spatial_dqn.codec import SpatialActionCodec

SIZE, SIDE = 32, 12


def random_indices(codec: SpatialActionCodec, count: int = 20) -> th.Tensor:
    """Return pixels inside the block and random other indices."""
    th.manual_seed(0)
    pixels = [th.randint(10, 22, (count,)) for _ in range(2)]
    return th.stack([*pixels, *(th.randint(n, (count,)) for n in codec.shape[2:])], dim=1)


def test_greedy_is_the_best_choice_at_every_level(policy, scenes):
    """Compare with NumPy for each level, and with the values of all levels for the chosen indices."""
    network = policy.q_net
    indices, values = network.greedy(scenes)
    assert indices.shape == (20, len(network.codec.shape)) and indices.dtype == th.int64
    with th.no_grad():
        view = network.scene_view(scenes)
        maps, encoding = network.pixel_maps(view)
        yaws = maps.shape[1]
        best = maps.flatten(1).amax(dim=1).numpy()
        flat = [np.unravel_index(each.argmax(), each.shape) for each in maps.numpy()]
        chosen = [[row, column, yaw][: 2 + (yaws > 1)] for yaw, row, column in flat]
        for level in network.levels:
            found = level(view, encoding, th.tensor(np.array(chosen))).numpy()
            chosen = [[*before, row.argmax()] for before, row in zip(chosen, found, strict=True)]
            best = found.max(axis=1)
        at_once = network.values(scenes, indices)
    np.testing.assert_array_equal(indices, chosen)
    np.testing.assert_allclose(values, best, rtol=1e-5, atol=1e-8)
    sizes = [yaws * SIZE**2, *network.codec.shape[2 + (yaws > 1) :]]
    assert [tuple(level.shape) for level in at_once] == [(20, size) for size in sizes]
    for level_values, choice in zip(at_once, network.choices(indices), strict=True):
        assert level_values.dtype == th.float32 and level_values.abs().max() < 1
        best = level_values.gather(1, choice[:, None])[:, 0]
        th.testing.assert_close(best, level_values.amax(dim=1), rtol=1e-5, atol=1e-8)
    th.testing.assert_close(best, values, rtol=1e-5, atol=1e-8)


def test_levels_depend_on_earlier_choices_and_the_view(policy, scenes):
    """The order is pixel, yaw, height, tilts about y and x. Samples are independent."""
    network = policy.q_net
    names = [level.name for level in network.levels]
    assert names == ["theta", "z", "phi", "psi"][: len(names)]
    indices = random_indices(network.codec)
    with th.no_grad():
        values = network.values(scenes, indices)

        def changed(others) -> list[bool]:
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


def make_view(shapes=None, **kwargs) -> SceneView:
    boxes = {"heightmap": (1, SIZE, SIZE), "in_hand": (1, SIDE, SIDE), "holding": (1,), **(shapes or {})}
    space = {name: spaces.Box(0.0, 0.4, shape, np.float32) for name, shape in boxes.items()}
    return SceneView(spaces.Dict(space), **kwargs)


@pytest.mark.parametrize("case", [("FCNPolicy", "pxyr")], indirect=True)
def test_view_has_rounded_standardised_images(scenes):
    seen = make_view(quantise="uint8", standardise=(0.1, 0.02))(scenes)
    heights = (scenes["heightmap"] / 0.4 * 255).round() * 0.4 / 255
    th.testing.assert_close(seen.heights, heights[:, 0])
    th.testing.assert_close(seen.image, (heights - 0.1) / 0.02)
    assert seen.in_hand is not None and seen.in_hand.shape == (20, 1, SIDE, SIDE)
    assert seen.places.tolist() == [False, True] * 10
    some = seen.of(th.tensor([3, 1]))
    assert th.equal(some.heights, seen.heights[[3, 1]]) and some.places.tolist() == [True, True]


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: SceneView(spaces.Box(0.0, 0.4, (1, 16, 16))), "'heightmap', got Box"),
        (lambda: make_view(image_key="depth"), "'depth'"),
        (lambda: make_view({"heightmap": (3, SIZE, SIZE)}), "heightmap"),
        (lambda: make_view({"heightmap": (1, SIZE, 12)}), "must have images, .*heightmap"),
        (lambda: make_view({"in_hand": (1, 12, 13)}), "must have images, .*in_hand"),
        (lambda: make_view({"in_hand": (12,)}), "must have images, .*in_hand"),
        (lambda: make_view(standardise=(0.1, 0.0)), r"got \(0.1, 0.0\)"),
        (lambda: make_view(quantise="uint4"), "uint4"),
    ],
)
def test_invalid_arguments_are_rejected(make, named):
    with pytest.raises(ValueError, match=named):
        make()
