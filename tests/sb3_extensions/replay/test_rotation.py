"""Rotation of sampled steps."""

import math
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_extensions.common.action_sequence import ActionSequence
from sb3_extensions.replay.augmentation import RAD, Sequence
from sb3_extensions.replay.augmentations import make_augmentation
from sb3_extensions.replay.buffer import ExpertReplayBuffer
from sb3_extensions.replay.rotation import Rotation, rotate_actions, rotate_images
from sb3_extensions.sacfd import SACfD

SIZE = 17
SPACE = spaces.Dict(
    {
        "heightmap": spaces.Box(0.0, 0.4, (1, SIZE, SIZE), np.float32),
        "labels": spaces.Box(0, 255, (1, SIZE, SIZE), np.uint8),
        "rgb": spaces.Box(0, 255, (3, SIZE, SIZE), np.uint8),
        "points": spaces.Box(-1.0, 1.0, (4, 3), np.float32),
        "in_hand": spaces.Box(0.0, 0.4, (1, 8, 8), np.float32),
        "holding": spaces.Box(0.0, 1.0, (1,), np.float32),
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


def make_samples(actions: np.ndarray, place: tuple[float, float] = (0.4, -0.3)) -> Any:
    """Return all steps of an episode in which a bump moves by a tenth of the action's x and y."""
    buffer = ExpertReplayBuffer(200, SPACE, spaces.Box(-1, 1, actions.shape[1:]), device="cpu", seed=0)
    places = [np.array(place)]
    for action in actions:
        places.append(places[-1] + 0.1 * action[1:3])
    observations = [draw(*xy) for xy in places]
    stacked = {key: np.stack([entry[key] for entry in observations]) for key in observations[0]}
    buffer.add_episode(stacked, actions, np.zeros(len(actions)), np.arange(len(actions)) == len(actions) - 1)
    return buffer._get_samples(np.arange(len(actions)), None)


def generator(seed: int = 0) -> th.Generator:
    return th.Generator().manual_seed(seed)


@pytest.mark.parametrize("quarter", range(4))
@pytest.mark.parametrize("size", [4, 5])
def test_quarter_turns_are_exact(quarter: int, size: int) -> None:
    images = np.random.default_rng(0).random((3, 2, size, size)).astype(np.float32)
    angles = th.full((3,), quarter * math.pi / 2)
    rotated = rotate_images(th.from_numpy(images), angles)
    np.testing.assert_allclose(rotated, np.rot90(images, quarter, axes=(2, 3)), atol=1e-5)
    levels = (images * 255).astype(np.uint8)
    rotated = rotate_images(th.from_numpy(levels), angles)
    np.testing.assert_array_equal(rotated, np.rot90(levels, quarter, axes=(2, 3)))


@pytest.mark.parametrize("angle", [0.3, 2.0, 4.5])
def test_the_rotated_image_is_the_image_of_the_rotated_scene(angle: float) -> None:
    before, after = draw(0.4, -0.3)["heightmap"], draw(*rotate(0.4, -0.3, angle))["heightmap"]
    rotated = rotate_images(th.from_numpy(before)[None], th.tensor([angle]))[0].numpy()
    assert np.abs(before - after).max() > 0.06
    inside = np.hypot(*(np.indices((SIZE, SIZE)) - SIZE // 2)) <= SIZE // 2
    np.testing.assert_allclose(rotated[0][inside], after[0][inside], atol=0.02)  # of 0.3 m


def test_pixels_outside_the_image_are_the_nearest_border_pixel() -> None:
    image = th.zeros(1, 1, 5, 5)
    image[0, 0, 0, 0] = 1.0
    rotated = rotate_images(image, th.tensor([math.pi / 4]))[0, 0]
    assert rotated[0, 2] < 1 and rotated.argmax() in (1, 2, 5, 6, 10)
    assert (rotate_images(th.ones(1, 1, 5, 5), th.tensor([0.7])) == 1).all()


@pytest.mark.parametrize("sequence", ["pxyzr", "rzyxp", "pxyz"])
def test_only_x_and_y_of_actions_rotate(sequence: str) -> None:
    rng = np.random.default_rng(0)
    actions = rng.uniform(-0.7, 0.7, (50, len(sequence))).astype(np.float32)
    angles = rng.uniform(0, 2 * math.pi, 50)
    rotated = rotate_actions(
        th.from_numpy(actions), th.from_numpy(angles), ActionSequence(sequence, len(sequence))
    ).numpy()
    x, y = sequence.index("x"), sequence.index("y")
    for before, after, angle in zip(actions, rotated, angles, strict=True):
        np.testing.assert_allclose((after[x], after[y]), rotate(before[x], before[y], angle), atol=1e-6)
        others = [k for k in range(len(sequence)) if k not in (x, y)]
        np.testing.assert_array_equal(after[others], before[others])


def test_rotation_vectors_rotate() -> None:
    """A quarter turn maps a rotation about x to one about y."""
    action = th.tensor([[0.5, 1, 0, 0.1, 0.3, 0.2, 0.4]])
    rotated = rotate_actions(action, th.tensor([math.pi / 2]), ActionSequence("pxyzrrr", 7))
    np.testing.assert_allclose(rotated, [[0.5, 0, 1, 0.1, -0.2, 0.3, 0.4]], atol=1e-6)


def test_observations_and_actions_of_a_step_rotate_by_one_angle() -> None:
    actions = np.tile(np.array([0.2, 0.6, -0.5, 0.3, -0.6], np.float32), (6, 1))
    before = make_samples(actions, (-0.3, 0.2))
    after = Rotation(probability=1.0)(before, generator())
    angles = []
    for k in range(6):
        vectors = [before.actions[k, 1:3], after.actions[k, 1:3]]
        angle = float(th.atan2(vectors[1][1], vectors[1][0]) - th.atan2(vectors[0][1], vectors[0][0]))
        angles.append(angle)
        pairs = [(before.observations, after.observations)]
        if before.dones[k] == 0:
            pairs.append((before.next_observations, after.next_observations))
        for old, new in pairs:
            points = old["points"][k, 0]
            x, y = rotate(points[0].item(), points[1].item(), angle)
            expected = draw(x, y)
            assert np.abs(new["heightmap"][k].numpy() - expected["heightmap"]).max() < 0.03
            assert np.abs(new["rgb"][k].numpy().astype(int) - expected["rgb"]).max() < 20
            assert set(new["labels"][k].unique().tolist()) == {0, 7}
            assert th.equal(new["in_hand"][k], old["in_hand"][k])
            assert th.equal(new["holding"][k], old["holding"][k])
    assert len({round(angle % (2 * math.pi), 3) for angle in angles}) == 6
    np.testing.assert_allclose(after.expert_actions, after.actions)  # both were equal before
    for field in ("dones", "rewards", "weights", "is_expert"):
        assert th.equal(getattr(before, field), getattr(after, field))


def test_rotated_actions_stay_within_their_bounds_and_keep_their_length() -> None:
    actions = np.random.default_rng(0).uniform(-1, 1, (150, 5)).astype(np.float32)
    before = make_samples(actions)
    before = before._replace(expert_actions=th.roll(before.actions, 1, 0))
    after = Rotation(probability=1.0)(before, generator())
    for name in ("actions", "expert_actions"):
        old, new = getattr(before, name), getattr(after, name)
        assert new.abs().max() <= 1
        np.testing.assert_allclose(new[:, 1:3].norm(dim=1), old[:, 1:3].norm(dim=1), atol=1e-5)
    assert ((after.actions - before.actions).abs().amax(dim=1) > 1e-3).float().mean() > 0.6


def test_a_corner_rotates_by_quarter_turns() -> None:
    corner = np.tile(np.array([0, 1, 1, 0, 0], np.float32), (80, 1))
    rotated = Rotation(probability=1.0)(make_samples(corner), generator()).actions[:, 1:3].numpy()
    assert len(np.unique(rotated.round(3), axis=0)) == 4
    np.testing.assert_allclose(np.abs(rotated), 1, atol=1e-5)


def test_the_probability_is_the_share_of_rotated_steps() -> None:
    actions = np.tile(np.array([0, 0.5, 0, 0, 0], np.float32), (190, 1))
    before = make_samples(actions, (-0.9, 0))
    for probability in (0.0, 0.8):
        after = Rotation(probability=probability)(before, generator())
        moved = (after.actions != before.actions).any(dim=1).float().mean().item()
        assert moved == pytest.approx(probability, abs=0.08)


def test_an_unknown_expert_action_stays_unknown() -> None:
    samples = make_samples(np.tile(np.array([0, 0.5, 0, 0, 0], np.float32), (5, 1)))
    samples = samples._replace(expert_actions=th.full((5, 5), np.nan))
    rotated = Rotation(probability=1.0)(samples, generator())
    assert rotated.expert_actions.isnan()[:, 1:3].all()
    assert (rotated.actions != samples.actions).any(dim=1).all()


def test_rotation_precedes_a_crop() -> None:
    augmentation = make_augmentation({"rotation": {}, "rad": {"size": 12}}, action_sequence="xyzrp")
    assert augmentation == Sequence((Rotation(action_sequence="xyzrp"), RAD(12)))
    samples = make_samples(np.zeros((4, 5), np.float32))
    cropped = augmentation(samples, generator())
    assert cropped.observations["heightmap"].shape == (4, 1, 12, 12)
    kwargs = augmentation.with_crop({})
    assert kwargs == {"features_extractor_kwargs": {"crop": 12}}


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"probability": 1.5}, "probability must be between 0 and 1, got 1.5"),
        ({"action_sequence": "pz"}, "action_sequence must have x and y to rotate, got 'pz'"),
    ],
)
def test_bad_arguments(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Rotation(**kwargs)


def test_observations_without_square_images_are_refused() -> None:
    for shape in ((3,), (1, 4, 5)):
        space = spaces.Dict({"entry": spaces.Box(0.0, 1.0, shape)})
        with pytest.raises(ValueError, match=r"must have images \(channels, size, size\)"):
            Rotation().check(space)


def test_the_action_sequence_is_the_environments(make_toy: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    env = make_toy()
    monkeypatch.setattr(type(env.envs[0].unwrapped), "action_sequence", "zxypr", raising=False)
    small = {"features_extractor_kwargs": {"channels": [4, 8, 8]}}
    model = SACfD("MultiInputPolicy", env, augmentation="rotation", buffer_size=100, policy_kwargs=small)
    assert model.augmentation == Rotation(action_sequence="zxypr")


@pytest.mark.parametrize("sampler", ["uniform", "prioritized"])
def test_learns_to_reach(policy: Any, sampler: str, make_toy: Any) -> None:
    name, policy_kwargs = policy
    kwargs = {
        "expert_episodes": 20,
        "pretrain_steps": 60,
        "critic_warmup_steps": None,
        "learning_rate": 3e-3,
        "batch_size": 32,
    }
    model = SACfD(
        name,
        make_toy(2),
        augmentation="rotation",
        bc_weight=10.0,
        replay_buffer_kwargs={"sampler": sampler},
        buffer_size=1500,
        policy_kwargs=policy_kwargs,
        seed=0,
        device="cpu",
        **kwargs,
    )
    untrained, _ = evaluate_policy(model, make_toy(seed=9), 30)
    model.learn(100)
    trained, _ = evaluate_policy(model, make_toy(seed=9), 30)
    assert untrained < 0.6
    assert trained >= 0.9
