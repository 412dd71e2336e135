"""Random crops, shifts and rotations of sampled steps, compared with slow references."""

import math

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_extensions.common.action_sequence import ActionSequence
from sb3_extensions.replay.augmentation import RAD, Compose, DrQ
from sb3_extensions.replay.buffer import ExpertReplayBuffer
from sb3_extensions.replay.rotation import Rotation, make_augmentation, rotate_actions
from sb3_extensions.replay.samples import ExpertReplayBufferSamples

SIDE, CROP, BATCH = 19, 16, 6
OBSERVATIONS = ("observations", "next_observations")


def generator(seed=0):
    return th.Generator().manual_seed(seed)


def observations(seed):
    """Return scenes with a different number in every pixel, to identify windows, after smaller images."""
    pixels = th.randperm(BATCH * 2 * SIDE * SIDE, generator=generator(seed)).float()
    scene = {"heightmap": pixels.view(BATCH, 2, SIDE, SIDE), "holding": th.arange(BATCH)[:, None] % 2.0}
    return {"in_hand": th.rand(BATCH, 3, 8, 8), **scene}


def samples():
    columns = [th.arange(BATCH, dtype=th.float32)[:, None] + 10 * k for k in range(7)]
    return ExpertReplayBufferSamples(
        observations(0), columns[0], observations(1), *columns[1:6], np.arange(BATCH), columns[6]
    )


def find_offset(image, window):
    """Return the offset of a window in an image whose border is repeated outwards, by 4 pixels."""
    padded = np.pad(image.numpy(), ((0, 0), (4, 4), (4, 4)), mode="edge")
    views = np.lib.stride_tricks.sliding_window_view(padded, window.shape)[0]
    [(row, column)] = np.argwhere((views == window.numpy()).all(axis=(2, 3, 4)))
    return row - 4, column - 4


def test_rad_crops_both_observations_of_a_step_equally():
    before = samples()
    after = RAD(CROP)(before, generator())
    offsets = []
    for field in OBSERVATIONS:
        old, new = getattr(before, field), getattr(after, field)
        assert new["heightmap"].shape == (BATCH, 2, CROP, CROP)
        assert th.equal(new["holding"], old["holding"]) and th.equal(new["in_hand"], old["in_hand"])
        pairs = zip(old["heightmap"], new["heightmap"], strict=True)
        offsets.append([find_offset(image, window) for image, window in pairs])
    assert offsets[0] == offsets[1] and len(set(offsets[0])) > 3
    assert min(map(min, offsets[0])) >= 0 and max(map(max, offsets[0])) <= SIDE - CROP
    assert all(after[i] is before[i] for i in range(len(before)) if after._fields[i] not in OBSERVATIONS)


@pytest.mark.parametrize(("k", "m"), [(2, 2), (3, 1)])
def test_drq_shifts_each_view_independently(k, m):
    before = samples()
    after = DrQ(k, m)(before, generator())
    for field, copies in (("observations", m), ("next_observations", k)):
        old, new = getattr(before, field), getattr(after, field)
        images = old["heightmap"].repeat(copies, 1, 1, 1)
        offsets = {find_offset(*pair) for pair in zip(images, new["heightmap"], strict=True)}
        assert len(offsets) > copies * BATCH // 2
        for name in ("holding", "in_hand"):
            assert th.equal(new[name], th.cat([old[name]] * copies))
    for field in ("actions", "dones", "rewards", "discounts", "expert_actions", "is_expert", "weights"):
        assert th.equal(getattr(after, field), th.cat([getattr(before, field)] * m)), field
    assert after.indices is before.indices


@pytest.mark.parametrize(
    ("spec", "expected"),
    [
        (None, None),
        ("rad", RAD(128)),
        ({"drq": {"K": 1, "M": 3}}, DrQ(1, 3)),
        (RAD(32), RAD(32)),
        ({"rotation": {}, "rad": {"size": 12}}, Compose((Rotation(action_sequence="xyzrp"), RAD(12)))),
        ({"drq": {"K": 1}, "rotation": {}}, Compose((Rotation(action_sequence="xyzrp"), DrQ(1)))),
    ],
)
def test_make_augmentation_from_names_and_arguments(spec, expected):
    assert make_augmentation(spec, action_sequence="xyzrp") == expected


def test_policy_acts_on_the_centre_of_an_image(make_toy, make_learner):
    env = make_toy(3, size=18)
    model = make_learner(env, augmentation=RAD(CROP))
    observation = env.reset()
    centre = {**observation, "heightmap": observation["heightmap"][..., 1:17, 1:17]}
    tensors = {key: th.from_numpy(value) for key, value in centre.items()}
    with th.no_grad():
        trained_on = model.policy.unscale_action(model.actor(tensors, deterministic=True).numpy())
    np.testing.assert_array_equal(model.predict(observation, deterministic=True)[0], trained_on)


SIZE = 17
SHAPES = {"heightmap": (1, SIZE, SIZE), "points": (4, 3), "in_hand": (1, 8, 8), "holding": (1,)}
LEVELS = {"labels": (1, SIZE, SIZE), "rgb": (3, SIZE, SIZE)}
DRAWN = spaces.Dict(
    {
        **{name: spaces.Box(-1.0, 1.0, shape, np.float32) for name, shape in SHAPES.items()},
        **{name: spaces.Box(0, 255, shape, np.uint8) for name, shape in LEVELS.items()},
    }
)


def draw(x, y):
    """Return the observation of a bump in a square of 2 m, wide enough for bilinear interpolation."""
    rows, columns = np.meshgrid(*[np.linspace(-1, 1, SIZE)] * 2, indexing="ij")
    image = 0.3 * np.exp(-((rows - x) ** 2 + (columns - y) ** 2) / 0.2)[None].astype(np.float32)
    return {
        "heightmap": image,
        "labels": (image > 0.15).astype(np.uint8) * 7,
        "rgb": np.repeat(np.rint(image * 600), 3, axis=0).astype(np.uint8),
        "points": np.tile(np.array([x, y, 0.5], np.float32), (4, 1)),
        "in_hand": image[:, 2:10, 2:10],
        "holding": np.array([x], np.float32),
    }


def rotate(x, y, angle):
    return math.cos(angle) * x - math.sin(angle) * y, math.sin(angle) * x + math.cos(angle) * y


def make_samples(actions, place=(0.4, -0.3)):
    """Return all steps of an episode in which a bump moves by a tenth of the action's x and y."""
    buffer = ExpertReplayBuffer(200, DRAWN, spaces.Box(-1, 1, actions.shape[1:]), device="cpu", seed=0)
    places = np.cumsum([place, *(0.1 * actions[:, 1:3])], axis=0)
    drawn = [draw(*xy) for xy in places]
    stacked = {key: np.stack([entry[key] for entry in drawn]) for key in drawn[0]}
    buffer.add_episode(stacked, actions, np.zeros(len(actions)), np.arange(len(actions)) == len(actions) - 1)
    return buffer._get_samples(np.arange(len(actions)), None)


def test_rotation_vectors_rotate():
    """A quarter turn maps a rotation about x to one about y."""
    action = th.tensor([[0.5, 1, 0, 0.1, 0.3, 0.2, 0.4]])
    turned = rotate_actions(action, th.tensor([math.pi / 2]), ActionSequence("pxyzrrr", 7))
    np.testing.assert_allclose(turned, [[0.5, 0, 1, 0.1, -0.2, 0.3, 0.4]], atol=1e-6)


def test_observations_and_actions_of_a_step_rotate_by_one_angle():
    before = make_samples(np.tile(np.array([0.2, 0.6, -0.5, 0.3, -0.6], np.float32), (6, 1)), (-0.3, 0.2))
    after = Rotation(probability=1.0)(before, generator())
    assert th.equal(after.actions[:, [0, 3, 4]], before.actions[:, [0, 3, 4]])
    old, new = (th.atan2(each.actions[:, 2], each.actions[:, 1]) for each in (before, after))
    angles = (new - old).tolist()
    assert len({round(angle % (2 * math.pi), 3) for angle in angles}) == 6
    for k, field in np.ndindex(6, 2):
        if field == 1 and before.dones[k]:
            continue
        seen, turned = (getattr(each, OBSERVATIONS[field]) for each in (before, after))
        expected = draw(*rotate(*seen["points"][k, 0, :2].tolist(), angles[k]))
        assert np.abs(turned["heightmap"][k].numpy() - expected["heightmap"]).max() < 0.03
        assert np.abs(turned["rgb"][k].numpy().astype(int) - expected["rgb"]).max() < 20
        assert set(turned["labels"][k].unique().tolist()) == {0, 7}
        assert all(th.equal(turned[name][k], seen[name][k]) for name in ("in_hand", "holding"))
    np.testing.assert_allclose(after.expert_actions, after.actions)  # both were equal before
    for field in ("dones", "rewards", "weights", "is_expert"):
        assert th.equal(getattr(before, field), getattr(after, field))


def test_rotated_actions_stay_within_their_bounds_and_keep_their_length():
    """An unknown expert action stays unknown; a corner rotates by quarter turns."""
    actions = np.random.default_rng(0).uniform(-1, 1, (150, 5)).astype(np.float32)
    actions[100:] = [0, 1, 1, 0, 0]
    before = make_samples(actions)
    before = before._replace(expert_actions=th.roll(before.actions, 1, 0))
    before.expert_actions[:10] = math.nan
    after = Rotation(probability=1.0)(before, generator())
    for name in ("actions", "expert_actions"):
        old, new = getattr(before, name)[10:], getattr(after, name)[10:]
        assert new.abs().max() <= 1
        np.testing.assert_allclose(new[:, 1:3].norm(dim=1), old[:, 1:3].norm(dim=1), atol=1e-5)
    assert after.expert_actions[:10, 1:3].isnan().all()
    corners = after.actions[100:, 1:3].numpy()
    assert len(np.unique(corners.round(3), axis=0)) == 4
    np.testing.assert_allclose(np.abs(corners), 1, atol=1e-5)


def test_the_probability_is_the_share_of_rotated_steps():
    before = make_samples(np.tile(np.array([0, 0.5, 0, 0, 0], np.float32), (190, 1)), (-0.9, 0))
    for probability in (0.0, 0.8):
        after = Rotation(probability=probability)(before, generator())
        moved = (after.actions != before.actions).any(dim=1).float().mean().item()
        assert moved == pytest.approx(probability, abs=0.08)
