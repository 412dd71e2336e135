"""Augmented samples equal those of the moved scene."""

import math
from typing import Any

import numpy as np
import pytest
import torch as th

from sb3_extensions.replay.samples import ExpertReplayBufferSamples
from sb3_extensions.spatial_dqn.augmentation import SHIFT, RigidMotion
from sb3_extensions.spatial_dqn.codec import SpatialActionCodec
from sb3_extensions.spatial_dqn.projections import rotation_matrices

SIZE, YAWS = 20, 6
BATCH = 64
ROWS = np.arange(BATCH)


def make_motion(sequence: str = "pxyzrrr") -> RigidMotion:
    codec = SpatialActionCodec(SIZE, sequence, num_rotations=YAWS, num_heights=4, num_tilts=5)
    return RigidMotion(codec, "heightmap")


def random_indices(motion: RigidMotion, low: int = 0, high: int = SIZE, count: int = BATCH) -> th.Tensor:
    """Of pixels from ``low`` to ``high``, and anything else."""
    generator = th.Generator().manual_seed(1)
    shape = [th.randint(n, (count,), generator=generator) for n in motion.codec.shape]
    pixels = [th.randint(low, high, (count,), generator=generator) for _ in range(2)]
    return th.stack([*pixels, *shape[2:]], dim=1)


def make_samples(heightmaps: th.Tensor, after: th.Tensor | None = None) -> ExpertReplayBufferSamples:
    count, generator = len(heightmaps), th.Generator().manual_seed(2)
    numbers = [th.rand(count, 1, generator=generator) for _ in range(9)]
    first, second = (
        {"heightmap": images, "in_hand": th.rand(count, 1, 6, 6), "holding": th.rand(count, 1).round()}
        for images in (heightmaps, heightmaps if after is None else after)
    )
    return ExpertReplayBufferSamples(first, numbers[0], second, *numbers[1:])


def move(motion: RigidMotion, samples, indices: th.Tensor, seed: int = 0) -> tuple[Any, th.Tensor]:
    actions = th.as_tensor(motion.codec.decode(indices.numpy(), np.zeros(len(indices), bool)))
    by_index = motion.move(samples, indices, th.Generator().manual_seed(seed))
    by_action = motion(samples._replace(actions=actions), th.Generator().manual_seed(seed))
    assert np.array_equal(motion.codec.encode(by_action.actions.numpy()), by_index[1].numpy())
    return by_index


def always(motion: RigidMotion, turns: int, shift: tuple[int, int]) -> RigidMotion:
    """Replace the sampled motion by a fixed one."""

    def draw(before, after, indices: th.Tensor, generator: th.Generator):
        count = len(indices)
        return th.full((count,), turns), th.tensor([shift], dtype=th.float32).expand(count, 2)

    motion._sample_motions = draw
    return motion


def images_around_the_middle() -> th.Tensor:
    images = th.zeros(BATCH, 1, SIZE, SIZE)
    images[:, :, 6:14, 6:14] = 0.02 + 0.1 * th.rand(BATCH, 1, 8, 8, generator=th.Generator().manual_seed(0))
    return images


@pytest.mark.parametrize("shift", [(0, 0), (3, -2), (-6, 5)])
@pytest.mark.parametrize("quarters", [0, 1, 2, 3])
def test_rotations_by_90_degrees_and_shifts_are_exact(quarters, shift):
    motion = always(make_motion(), quarters * YAWS // 2, shift)
    images, indices = images_around_the_middle(), random_indices(make_motion(), 6, 14)
    moved, moved_indices = move(motion, make_samples(images, images.flip(0)), indices)
    for name, before in (("observations", images), ("next_observations", images.flip(0))):
        expected = np.roll(np.rot90(before.numpy(), quarters, axes=(2, 3)), shift, axis=(2, 3))
        np.testing.assert_array_equal(getattr(moved, name)["heightmap"], expected)
    found = moved.observations["heightmap"][ROWS, 0, moved_indices[:, 0], moved_indices[:, 1]]
    np.testing.assert_array_equal(found, images[ROWS, 0, indices[:, 0], indices[:, 1]])
    np.testing.assert_array_equal(moved_indices[:, 2], (indices[:, 2] + quarters * YAWS // 2) % YAWS)
    np.testing.assert_array_equal(moved_indices[:, 3], indices[:, 3])


@pytest.mark.parametrize("turns", range(2 * YAWS))
def test_grippers_and_objects_rotate_with_the_scene(turns):
    """Poses of the gripper are modulo pi."""
    motion = make_motion()
    indices = random_indices(motion, 5, 15)
    row, column = np.ogrid[:SIZE, :SIZE]
    away = np.hypot(row - indices[:, 0, None, None].numpy(), column - indices[:, 1, None, None].numpy())
    images = th.as_tensor(0.1 * np.exp(-away / 4), dtype=th.float32)[:, None]
    moved, moved_indices = move(always(motion, turns, (1, 2)), make_samples(images), indices)
    highest = moved.observations["heightmap"].flatten(1).argmax(dim=1)
    found = th.stack([highest // SIZE, highest % SIZE], dim=1)
    assert (found - moved_indices[:, :2]).abs().max() <= 1
    names = [(2, "theta"), (4, "phi"), (5, "psi")]
    before, after = (
        rotation_matrices(*(th.as_tensor(motion.codec.grids[name][rows[:, k]]) for k, name in names)).numpy()
        for rows in (indices, moved_indices)
    )
    c, s = math.cos(turns * math.pi / YAWS), math.sin(turns * math.pi / YAWS)
    world = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    same, flipped = (
        np.abs(world @ before @ np.diag(end) - after).max(axis=(1, 2)) < 1e-6
        for end in ([1, 1, 1], [-1, -1, 1])
    )
    assert (same ^ flipped).all()
    np.testing.assert_array_equal(flipped, (indices[:, 2] + turns) // YAWS % 2 == 1)


def test_only_heightmaps_and_indices_move():
    """By motions of the passed generator alone."""
    motion, images = make_motion(), images_around_the_middle()
    samples, indices = make_samples(images), random_indices(make_motion(), 6, 14)
    state = th.get_rng_state()
    moved, moved_indices = move(motion, samples, indices)
    assert th.equal(images, images_around_the_middle()) and th.equal(state, th.get_rng_state())
    for name in ("in_hand", "holding"):
        assert moved.next_observations[name] is samples.next_observations[name]
    assert moved.rewards is samples.rewards
    for seed in (0, 1):
        again = move(motion, samples, indices, seed)[0].observations["heightmap"]
        assert th.equal(again, moved.observations["heightmap"]) == (seed == 0)
    assert not th.equal(moved_indices, indices)


def test_objects_stay_in_the_image():
    """Of a block of 3 x 3 pixels before, another after, and the gripper's pixel, wherever they are."""
    motion, generator = make_motion(), np.random.default_rng(0)
    count = 400
    images = th.zeros(2, count, 1, SIZE, SIZE)
    for image in images.flatten(0, 2):
        row, column = generator.integers(0, SIZE - 2, size=2)
        image[row : row + 3, column : column + 3] = 0.05
    indices = random_indices(motion, count=count)
    indices[::10, :2] = images[0, ::10, 0].flatten(1).argmax(dim=1)[:, None] // th.tensor([SIZE, 1]) % SIZE
    moved, moved_indices = move(motion, make_samples(*images), indices)
    for observations in (moved.observations, moved.next_observations):
        areas = (observations["heightmap"] > 0).flatten(1).sum(dim=1)
        assert areas.min() >= 7 and areas.max() <= 12
    turned = (moved_indices[:, :2] != indices[:, :2]).any(dim=1)
    assert turned.float().mean() > 0.8
    # Where the pixel itself is in the block, it still is
    inside = images[0][np.arange(count), 0, indices[:, 0], indices[:, 1]] > 0
    assert inside.any()
    around = th.nn.functional.max_pool2d(moved.observations["heightmap"], 3, 1, 1)[:, 0]
    assert (around[np.arange(count), moved_indices[:, 0], moved_indices[:, 1]][inside] > 0).all()


def test_full_images_rotate_by_90_degrees_only():
    images = 0.05 + 0.1 * th.rand(BATCH, 1, SIZE, SIZE, generator=th.Generator().manual_seed(0))
    indices = random_indices(make_motion())
    moved, moved_indices = move(make_motion(), make_samples(images), indices)
    quarters = (moved_indices[:, 2] - indices[:, 2]) % YAWS * 2 // YAWS  # or two more
    seen = []
    for before, after, odd in zip(images, moved.observations["heightmap"], quarters.tolist(), strict=True):
        [turned] = [k for k in range(4) if np.array_equal(np.rot90(before, k, axes=(1, 2)), after)]
        assert turned % 2 == odd
        seen.append(turned)
    assert 0.2 < np.mean(np.array(seen) > 0) < 1.0 and set(seen) == {0, 1, 2, 3}
    heights = moved.observations["heightmap"][ROWS, 0, moved_indices[:, 0], moved_indices[:, 1]]
    assert th.equal(heights, images[ROWS, 0, indices[:, 0], indices[:, 1]])


def test_motions_have_all_rotations_and_shifts():
    """Nothing stands: only the pixel, in the middle, is to stay in view."""
    motion, count = make_motion(), 2000
    indices = th.zeros(count, 6, dtype=th.int64)
    indices[:, :2] = SIZE // 2
    _, moved_indices = move(motion, make_samples(th.zeros(count, 1, SIZE, SIZE)), indices)
    yaws = np.bincount(moved_indices[:, 2], minlength=YAWS)
    assert yaws.min() > 0.7 * count / YAWS
    shifts = (moved_indices[:, :2] - (SIZE - 1) / 2).numpy()
    np.testing.assert_allclose(shifts.mean(axis=0), 0.0, atol=0.15)
    np.testing.assert_allclose(shifts.std(axis=0), math.hypot(SHIFT * SIZE, 0.5), rtol=0.15)


def test_without_yaws_heightmaps_only_shift():
    images, motion = images_around_the_middle(), make_motion("pxy")
    indices = random_indices(motion, 6, 14)
    moved, moved_indices = move(motion, make_samples(images), indices)
    for k, shift in enumerate(moved_indices - indices):
        expected = np.roll(images[k], shift, axis=(1, 2))
        np.testing.assert_array_equal(moved.observations["heightmap"][k], expected)
