"""Actions on the grid: conversion, rounding, and augmented samples, which equal those of the moved scene."""

import itertools
import math

import gymnasium as gym
import numpy as np
import pytest
import torch as th

import bulletarm_gym  # noqa: F401  registers the environments
from sb3_extensions.replay.samples import ExpertReplayBufferSamples
from sb3_extensions.spatial_dqn.augmentation import RigidMotion
from sb3_extensions.spatial_dqn.codec import SpatialActionCodec
from sb3_extensions.spatial_dqn.projections import rotation_matrices

THETA_BOUNDS = [(0.0, math.pi), (-math.pi, math.pi), (-math.pi / 2, math.pi / 2)]
SIDE = 6


def make_codec(sequence, **kwargs):
    return SpatialActionCodec(SIDE, sequence, num_rotations=4, num_heights=5, num_tilts=3, **kwargs)


def slowly_encoded(codec, action):
    """Number by number: the place of the grid that is the fewest metres or radians away."""
    value = dict(zip(codec.numbers, action.tolist(), strict=True))
    middles = [(2 * i + 1) / SIDE - 1 for i in range(SIDE)]
    indices = [int(np.argmin([abs(value[name] - middle) for middle in middles])) for name in "xy"]
    tilts = (-math.pi / 4, math.pi / 4)
    ranges = {"z": (0.0, 0.3), "theta": codec.theta_bounds, "phi": tilts, "psi": tilts}
    flipped = False
    for name, grid in codec.grids.items():
        low, high = ranges[name]
        at = low + (value[name] + 1) / 2 * (high - low)
        if name == "theta":
            turns = list(itertools.product(range(len(grid)), range(-2, 3)))  # yaw, number of rotations by pi
            index, half_turns = min(turns, key=lambda turn: abs(at - grid[turn[0]] - turn[1] * math.pi))
            flipped = half_turns % 2 == 1
        else:
            wanted = -at if flipped and name in ("phi", "psi") else at
            index = min(range(len(grid)), key=lambda k: abs(wanted - grid[k]))
        indices.append(index)
    return indices


@pytest.mark.parametrize(
    ("sequence", "theta_bounds"),
    [
        *(("pxyzrrr", bounds) for bounds in THETA_BOUNDS),
        *((sequence, THETA_BOUNDS[0]) for sequence in ("xy", "pxy", "xyrp", "zrrpyrx")),
    ],
)
def test_actions_are_rounded_to_the_nearest_grid_point(sequence, theta_bounds):
    """The grid's own actions are decoded and encoded exactly."""
    codec = make_codec(sequence, theta_bounds=theta_bounds)
    indices = np.indices(codec.shape).reshape(len(codec.shape), -1).T
    places = np.arange(len(indices)) % 3 == 0
    exact = codec.decode(indices, places)
    assert exact.dtype == np.float32 and exact.shape == (len(indices), len(sequence))
    assert np.abs(exact).max() <= 1.0 and len(np.unique(exact, axis=0)) == len(indices)
    np.testing.assert_array_equal(codec.encode(exact), indices)
    np.testing.assert_array_equal(codec.places(exact), places & ("p" in sequence))
    np.testing.assert_array_equal(codec.snap(exact), exact)
    actions = np.random.default_rng(0).uniform(-1, 1, (300, len(sequence)))
    expected = [slowly_encoded(codec, action) for action in actions]
    np.testing.assert_array_equal(codec.encode(actions), expected)
    np.testing.assert_array_equal(codec.encode(codec.snap(actions)), expected)
    np.testing.assert_array_equal(codec.places(codec.snap(actions)), codec.places(actions))


def test_order_of_indices_and_default_grid():
    codec = SpatialActionCodec(128, "rrrzyxp")
    assert codec.shape == (128, 128, 16, 36, 7, 7)
    assert list(codec.grids) == ["theta", "z", "phi", "psi"]
    assert math.isclose(codec.resolution, 0.4 / 128)
    np.testing.assert_allclose(codec.grids["theta"], np.arange(16) * math.pi / 16)
    np.testing.assert_allclose(codec.grids["z"][[0, -1]], [0.02, 0.20])
    for name in ("phi", "psi"):
        np.testing.assert_allclose(
            np.degrees(codec.grids[name]), [-22.5, -15, -7.5, 0, 7.5, 15, 22.5], atol=1e-9
        )


@pytest.mark.parametrize(
    ("sequence", "half_rotation"), [("xy", True), ("xyrp", False), ("pxyzrrr", True), ("pxyzrrr", False)]
)
def test_decoded_actions_match_the_environment(sequence, half_rotation):
    kwargs = {"obs_size": 16, "workspace": [[0.3, 0.6], [-0.1, 0.2], [0.0, 1.0]], "num_objects": 2}
    kwargs |= {"action_sequence": sequence, "half_rotation": half_rotation}
    env = gym.make("BulletArm/OpenLoopBlockStacking-v0", **kwargs)
    env.reset(seed=0)
    low = 0.0 if half_rotation else -math.pi
    codec = SpatialActionCodec(16, sequence, theta_bounds=(low, math.pi), workspace_size=0.3)
    rng = np.random.default_rng(0)
    indices = np.stack([rng.integers(count, size=60) for count in codec.shape], axis=1)
    places = rng.random(60) < 0.5
    for index, place, action in zip(indices, places, codec.decode(indices, places), strict=True):
        assert env.action_space.contains(action)
        move = env.unwrapped.decode_action(action)
        middle = [0.3 + (index[0] + 0.5) * 0.3 / 16, -0.1 + (index[1] + 0.5) * 0.3 / 16]
        np.testing.assert_allclose(move.position[:2], middle, atol=1e-6)
        values = {name: grid[k] for (name, grid), k in zip(codec.grids.items(), index[2:], strict=True)}
        rotation = [values.get(name, 0.0) for name in ("theta", "phi", "psi")]
        np.testing.assert_allclose(move.rotation, rotation, atol=1e-6)
        if "z" in values:
            np.testing.assert_allclose(move.position[2], values["z"], atol=1e-6)
        assert "p" not in sequence or move.primitive == ("place" if place else "pick")
    env.close()


SIZE, YAWS, BATCH = 20, 6, 400


@pytest.fixture
def motion():
    codec = SpatialActionCodec(SIZE, "pxyzrrr", num_rotations=YAWS, num_heights=4, num_tilts=5)
    return RigidMotion(codec, "heightmap")


def random_indices(motion, low=0, high=SIZE):
    """Of pixels from ``low`` to ``high``, and anything else."""
    ranges = [(low, high), (low, high), *((0, count) for count in motion.codec.shape[2:])]
    return th.as_tensor(np.stack([np.random.default_rng(1).integers(*limits, BATCH) for limits in ranges], 1))


def make_samples(before, after):
    others = {"in_hand": th.rand(BATCH, 1, 6, 6), "holding": th.rand(BATCH, 1).round()}
    first, second = ({"heightmap": images, **others} for images in (before, after))
    return ExpertReplayBufferSamples(first, th.rand(BATCH, 1), second, *th.rand(7, BATCH, 1))


def move(motion, samples, indices):
    """By a motion of the passed generator alone; in-hand images and rewards stay."""
    actions = th.as_tensor(motion.codec.decode(indices.numpy(), np.zeros(len(indices), bool)))
    state = th.get_rng_state()
    moved = motion(samples._replace(actions=actions), th.Generator().manual_seed(0))
    assert th.equal(state, th.get_rng_state()) and moved.rewards is samples.rewards
    for name in ("in_hand", "holding"):
        assert moved.next_observations[name] is samples.next_observations[name]
    return moved, th.as_tensor(motion.codec.encode(moved.actions.numpy()))


def test_grippers_and_objects_rotate_with_the_scene(motion, monkeypatch):
    """Poses of the gripper are modulo pi."""
    indices, turns = random_indices(motion, 5, 15), th.arange(BATCH) % (2 * YAWS)
    shifts = th.tensor([[1.0, 2.0]]).expand(BATCH, 2)
    monkeypatch.setattr(motion, "_sample_motions", lambda *args: (turns, shifts))
    row, column = np.ogrid[:SIZE, :SIZE]
    away = np.hypot(row - indices[:, 0, None, None].numpy(), column - indices[:, 1, None, None].numpy())
    images = th.as_tensor(0.1 * np.exp(-away / 4), dtype=th.float32)[:, None]
    moved, moved_indices = move(motion, make_samples(images, images), indices)
    highest = moved.observations["heightmap"].flatten(1).argmax(dim=1)
    found = th.stack([highest // SIZE, highest % SIZE], dim=1)
    assert (found - moved_indices[:, :2]).abs().max() <= 1
    names = [(2, "theta"), (4, "phi"), (5, "psi")]
    before, after = (
        rotation_matrices(*(th.as_tensor(motion.codec.grids[name][rows[:, k]]) for k, name in names))
        for rows in (indices, moved_indices)
    )
    world = rotation_matrices(turns.double() * math.pi / YAWS, *th.zeros(2, BATCH, dtype=th.float64))
    same, flipped = (
        (world @ before @ th.diag(th.tensor(end)).double() - after).abs().amax(dim=(1, 2)) < 1e-6
        for end in ([1, 1, 1], [-1, -1, 1])
    )
    assert (same ^ flipped).all()
    assert th.equal(flipped, (indices[:, 2] + turns) // YAWS % 2 == 1)


def test_objects_stay_in_the_image(motion):
    """Of a block of 3 x 3 pixels before, another after, and the gripper's pixel, wherever they are."""
    images = th.zeros(2, BATCH, 1, SIZE, SIZE)
    corners = np.random.default_rng(0).integers(0, SIZE - 2, size=(2 * BATCH, 2))
    for image, (row, column) in zip(images.flatten(0, 2), corners, strict=True):
        image[row : row + 3, column : column + 3] = 0.05
    indices = random_indices(motion)
    indices[::10, :2] = th.as_tensor(corners[:BATCH:10])  # in the block, which it must not leave
    moved, moved_indices = move(motion, make_samples(*images), indices)
    for observations in (moved.observations, moved.next_observations):
        areas = (observations["heightmap"] > 0).flatten(1).sum(dim=1)
        assert areas.min() >= 7 and areas.max() <= 12
    assert (moved_indices[:, :2] != indices[:, :2]).any(dim=1).float().mean() > 0.8
    around = th.nn.functional.max_pool2d(moved.observations["heightmap"], 3, 1, 1)[::10, 0]
    rows, columns = moved_indices[::10, :2].T
    assert (around[np.arange(BATCH // 10), rows, columns] > 0).all()


def test_full_images_rotate_by_90_degrees_only(motion):
    images, indices = 0.05 + 0.1 * th.rand(BATCH, 1, SIZE, SIZE), random_indices(motion)
    moved, moved_indices = move(motion, make_samples(images, images), indices)
    after, turns = moved.observations["heightmap"], []
    for first, second in zip(images, after, strict=True):
        [turned] = [k for k in range(4) if np.array_equal(np.rot90(first, k, axes=(1, 2)), second)]
        turns.append(turned)
    quarters = (moved_indices[:, 2] - indices[:, 2]) % YAWS * 2 // YAWS  # or two more
    assert set(turns) == {0, 1, 2, 3} and quarters.tolist() == [turned % 2 for turned in turns]
    heights = [
        scene[np.arange(BATCH), 0, pixels[:, 0], pixels[:, 1]]
        for scene, pixels in ((images, indices), (after, moved_indices))
    ]
    assert th.equal(*heights)
