"""Rotation of sampled steps."""

import math

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_extensions.common.action_sequence import ActionSequence
from sb3_extensions.replay.buffer import ExpertReplayBuffer
from sb3_extensions.replay.rotation import Rotation, rotate_actions

SIZE = 17
SHAPES = {"heightmap": (1, SIZE, SIZE), "points": (4, 3), "in_hand": (1, 8, 8), "holding": (1,)}
LEVELS = {"labels": (1, SIZE, SIZE), "rgb": (3, SIZE, SIZE)}
SPACE = spaces.Dict(
    {
        **{name: spaces.Box(-1.0, 1.0, shape, np.float32) for name, shape in SHAPES.items()},
        **{name: spaces.Box(0, 255, shape, np.uint8) for name, shape in LEVELS.items()},
    }
)


def draw(x: float, y: float) -> dict[str, np.ndarray]:
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


def rotate(x: float, y: float, angle: float) -> tuple[float, float]:
    return math.cos(angle) * x - math.sin(angle) * y, math.sin(angle) * x + math.cos(angle) * y


def make_samples(actions: np.ndarray, place: tuple[float, float] = (0.4, -0.3)):
    """Return all steps of an episode in which a bump moves by a tenth of the action's x and y."""
    buffer = ExpertReplayBuffer(200, SPACE, spaces.Box(-1, 1, actions.shape[1:]), device="cpu", seed=0)
    places = np.cumsum([place, *(0.1 * actions[:, 1:3])], axis=0)
    drawn = [draw(*xy) for xy in places]
    stacked = {key: np.stack([entry[key] for entry in drawn]) for key in drawn[0]}
    buffer.add_episode(stacked, actions, np.zeros(len(actions)), np.arange(len(actions)) == len(actions) - 1)
    return buffer._get_samples(np.arange(len(actions)), None)


def rotated(samples, probability: float = 1.0):
    return Rotation(probability=probability)(samples, th.Generator().manual_seed(0))


def test_rotation_vectors_rotate():
    """A quarter turn maps a rotation about x to one about y."""
    action = th.tensor([[0.5, 1, 0, 0.1, 0.3, 0.2, 0.4]])
    turned = rotate_actions(action, th.tensor([math.pi / 2]), ActionSequence("pxyzrrr", 7))
    np.testing.assert_allclose(turned, [[0.5, 0, 1, 0.1, -0.2, 0.3, 0.4]], atol=1e-6)


def test_observations_and_actions_of_a_step_rotate_by_one_angle():
    before = make_samples(np.tile(np.array([0.2, 0.6, -0.5, 0.3, -0.6], np.float32), (6, 1)), (-0.3, 0.2))
    after = rotated(before)
    angles = []
    for k in range(6):
        vectors = [before.actions[k, 1:3], after.actions[k, 1:3]]
        assert th.equal(after.actions[k, [0, 3, 4]], before.actions[k, [0, 3, 4]])
        angles.append(float(th.atan2(*vectors[1].flip(0)) - th.atan2(*vectors[0].flip(0))))
        pairs = [(before.observations, after.observations)]
        if before.dones[k] == 0:
            pairs.append((before.next_observations, after.next_observations))
        for old, new in pairs:
            expected = draw(*rotate(*old["points"][k, 0, :2].tolist(), angles[-1]))
            assert np.abs(new["heightmap"][k].numpy() - expected["heightmap"]).max() < 0.03
            assert np.abs(new["rgb"][k].numpy().astype(int) - expected["rgb"]).max() < 20
            assert set(new["labels"][k].unique().tolist()) == {0, 7}
            assert all(th.equal(new[name][k], old[name][k]) for name in ("in_hand", "holding"))
    assert len({round(angle % (2 * math.pi), 3) for angle in angles}) == 6
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
    after = rotated(before)
    for name in ("actions", "expert_actions"):
        old, new = getattr(before, name)[10:], getattr(after, name)[10:]
        assert new.abs().max() <= 1
        np.testing.assert_allclose(new[:, 1:3].norm(dim=1), old[:, 1:3].norm(dim=1), atol=1e-5)
    assert after.expert_actions[:10, 1:3].isnan().all()
    assert ((after.actions - before.actions).abs().amax(dim=1) > 1e-3).float().mean() > 0.6
    corners = after.actions[100:, 1:3].numpy()
    assert len(np.unique(corners.round(3), axis=0)) == 4
    np.testing.assert_allclose(np.abs(corners), 1, atol=1e-5)


def test_the_probability_is_the_share_of_rotated_steps():
    before = make_samples(np.tile(np.array([0, 0.5, 0, 0, 0], np.float32), (190, 1)), (-0.9, 0))
    for probability in (0.0, 0.8):
        moved = (rotated(before, probability).actions != before.actions).any(dim=1).float().mean().item()
        assert moved == pytest.approx(probability, abs=0.08)


def test_the_action_sequence_is_the_environments(make_toy, make_learner, monkeypatch):
    env = make_toy()
    monkeypatch.setattr(type(env.envs[0].unwrapped), "action_sequence", "zxypr", raising=False)
    model = make_learner(env, augmentation={"rotation": {}, "rad": {"size": 12}})
    assert model.augmentation.steps[0] == Rotation(action_sequence="zxypr")
    assert model.augmentation.with_crop({}) == {"features_extractor_kwargs": {"crop": 12}}
