"""Random crops, shifts and rotations of sampled steps, compared with slow references."""

import math

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_extensions.common.action_sequence import ActionSequence
from sb3_extensions.replay.augmentation import RAD, DrQ, Sequence
from sb3_extensions.replay.buffer import ExpertReplayBuffer
from sb3_extensions.replay.rotation import Rotation, make_augmentation, rotate_actions
from sb3_extensions.replay.samples import ExpertReplayBufferSamples

SIDE, CROP, BATCH = 19, 16, 6
OBSERVATIONS = ("observations", "next_observations")
SPACE = spaces.Dict(
    {
        "heightmap": spaces.Box(0.0, 0.4, (2, SIDE, SIDE), np.float32),
        "holding": spaces.Box(0.0, 1.0, (1,), np.float32),
    }
)


def generator(seed: int = 0) -> th.Generator:
    return th.Generator().manual_seed(seed)


def observations(seed: int) -> dict[str, th.Tensor]:
    """Return observations with a different number in every pixel, to identify windows."""
    pixels = th.randperm(BATCH * 2 * SIDE * SIDE, generator=generator(seed)).float()
    return {"heightmap": pixels.view(BATCH, 2, SIDE, SIDE), "holding": th.arange(BATCH)[:, None] % 2.0}


def samples() -> ExpertReplayBufferSamples:
    column = th.arange(BATCH, dtype=th.float32)[:, None]
    return ExpertReplayBufferSamples(
        observations=observations(0),
        actions=th.rand(BATCH, 5),
        next_observations=observations(1),
        dones=column % 2,
        rewards=column + 10,
        discounts=column + 20,
        expert_actions=th.rand(BATCH, 5),
        succeeded=column > 1,
        is_expert=column > 2,
        weights=column + 30,
        indices=np.arange(BATCH),
    )


def find_offset(image: th.Tensor, window: th.Tensor) -> tuple[int, int]:
    """Return the offset of a window in an image whose border is repeated outwards, by 4 pixels."""
    padded = np.pad(image.numpy(), ((0, 0), (4, 4), (4, 4)), mode="edge")
    views = np.lib.stride_tricks.sliding_window_view(padded, window.shape)[0]
    [(row, column)] = np.argwhere((views == window.numpy()).all(axis=(2, 3, 4)))
    return row - 4, column - 4


def test_rad_crops_both_observations_of_a_step_equally():
    before = samples()
    after = RAD(CROP)(before, generator())
    offsets = [
        [
            find_offset(getattr(before, field)["heightmap"][k], getattr(after, field)["heightmap"][k])
            for k in range(BATCH)
        ]
        for field in OBSERVATIONS
    ]
    assert offsets[0] == offsets[1] and len(set(offsets[0])) > 3
    assert min(map(min, offsets[0])) >= 0 and max(map(max, offsets[0])) <= SIDE - CROP
    assert after.observations["heightmap"].shape == (BATCH, 2, CROP, CROP)
    assert th.equal(after.observations["holding"], before.observations["holding"])
    assert all(after[i] is before[i] for i in range(len(before)) if after._fields[i] not in OBSERVATIONS)


@pytest.mark.parametrize(("k", "m"), [(2, 2), (3, 1), (1, 2)])
def test_drq_shifts_each_view_independently(k, m):
    before = samples()
    after = DrQ(k, m)(before, generator())
    for field, copies in (("observations", m), ("next_observations", k)):
        old, new = getattr(before, field), getattr(after, field)
        assert new["heightmap"].shape == (copies * BATCH, 2, SIDE, SIDE)
        offsets = {
            find_offset(old["heightmap"][i % BATCH], new["heightmap"][i]) for i in range(copies * BATCH)
        }
        assert len(offsets) > copies * BATCH // 2
        assert th.equal(new["holding"], th.cat([old["holding"]] * copies))
    for field in ("actions", "dones", "rewards", "discounts", "expert_actions", "is_expert", "weights"):
        assert th.equal(getattr(after, field), th.cat([getattr(before, field)] * m)), field
    assert after.indices is before.indices


@pytest.mark.parametrize("augmentation", [RAD(CROP), RAD(5), DrQ(K=3, M=2)])
@pytest.mark.parametrize("first", [True, False])
def test_smaller_images_do_not_change(augmentation, first):
    """Smaller images have no effect on the windows of the scene, in any order of the entries."""
    before, in_hand = samples(), {"in_hand": th.rand(BATCH, 3, 8, 8)}
    parts = [(in_hand, getattr(before, field)) for field in OBSERVATIONS]
    both = [{**a, **b} if first else {**b, **a} for a, b in parts]
    joined = before._replace(**dict(zip(OBSERVATIONS, both, strict=True)))
    after, without = augmentation(joined, generator()), augmentation(before, generator())
    for field in OBSERVATIONS:
        seen, expected = getattr(after, field), getattr(without, field)
        assert th.equal(seen["heightmap"], expected["heightmap"])
        copies = len(expected["holding"]) // BATCH
        assert th.equal(seen["in_hand"], th.cat([in_hand["in_hand"]] * copies))


def test_only_the_largest_images_must_be_larger_than_the_crop():
    space = spaces.Dict({**SPACE, "in_hand": spaces.Box(0.0, 0.4, (1, 8, 8), np.float32)})
    for augmentation in (RAD(18), RAD(8), RAD(5), DrQ()):
        augmentation.check(space)
    with pytest.raises(ValueError, match="19 x 19"):
        RAD(19).check(space)


@pytest.mark.parametrize("window, shape", [(DrQ(), (3,)), (Rotation(), (3,)), (Rotation(), (1, 4, 5))])
def test_observations_without_square_images_are_refused(window, shape):
    with pytest.raises(ValueError, match="must have images"):
        window.check(spaces.Dict({"entry": spaces.Box(0.0, 1.0, shape)}))


def test_targets_are_means_over_the_views_of_a_next_observation():
    values = th.tensor([1.0, 2.0, 3.0, 5.0, 7.0, 9.0])[:, None]
    expected = [[(1 + 5) / 2], [(2 + 7) / 2], [(3 + 9) / 2]]
    assert DrQ(2, 2).average_targets(values).tolist() == expected * 2
    assert RAD().average_targets(values) is values


@pytest.mark.parametrize(("augmentation", "places"), [(RAD(CROP), 4), (DrQ(pad=4), 9)])
def test_window_positions_are_uniform_up_to_the_edges(augmentation, places):
    image = th.stack(th.meshgrid(*[th.arange(float(SIDE))] * 2, indexing="ij")).expand(9_000, -1, -1, -1)
    view = augmentation.view(image, generator())
    # The middle pixel, which no shift moves onto the repeated edge, identifies the position.
    middle = view[:, :, view.shape[-1] // 2, view.shape[-1] // 2].numpy()
    pairs, counts = np.unique(middle, axis=0, return_counts=True)
    assert len(pairs) == places**2  # rows and columns are drawn independently
    expected = 9_000 / places**2
    assert (abs(counts - expected) < 5 * np.sqrt(expected)).all()
    again, other = (augmentation.view(image, generator(seed)) for seed in (0, 1))
    assert th.equal(view, again) and not th.equal(view, other)


@pytest.mark.parametrize(
    ("spec", "expected"),
    [
        (None, None),
        ("rad", RAD(128)),
        ({"rad": {"size": 64}}, RAD(64)),
        ({"drq": {"K": 1, "M": 3}}, DrQ(1, 3)),
        ({"drq": None}, DrQ(2, 2)),
        (RAD(32), RAD(32)),
        ({"rotation": {}, "rad": {"size": 12}}, Sequence((Rotation(action_sequence="xyzrp"), RAD(12)))),
    ],
)
def test_make_augmentation_from_names_and_arguments(spec, expected):
    assert make_augmentation(spec, action_sequence="xyzrp") == expected


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: make_augmentation("rda"), "augmentation .*rotation, rad, drq, .* got"),
        (lambda: make_augmentation(3), "augmentation .*rotation"),
        (lambda: make_augmentation({"rad": {"sise": 3}}), "sise"),
        (lambda: make_augmentation({"rad": {"size": 0}}), "size .* got 0"),
        (lambda: make_augmentation({"drq": {"K": -1}}), "K .* got -1"),
        (lambda: Rotation(probability=1.5), "probability .* got 1.5"),
        (lambda: Rotation(action_sequence="pz"), "action_sequence .* got 'pz'"),
    ],
)
def test_invalid_arguments_are_rejected(make, named):
    with pytest.raises(ValueError, match=named):
        make()


def test_policy_acts_on_the_centre_of_an_image(make_toy, make_learner):
    env = make_toy(3, size=18)
    model = make_learner(env, augmentation=RAD(CROP))
    observation = env.reset()
    centre = {**observation, "heightmap": observation["heightmap"][..., 1:17, 1:17]}
    tensors = {key: th.from_numpy(value) for key, value in centre.items()}
    with th.no_grad():
        trained_on = model.policy.unscale_action(model.actor(tensors, deterministic=True).numpy())
    np.testing.assert_array_equal(model.predict(observation, deterministic=True)[0], trained_on)


# Rotations.

SIZE = 17
SHAPES = {"heightmap": (1, SIZE, SIZE), "points": (4, 3), "in_hand": (1, 8, 8), "holding": (1,)}
LEVELS = {"labels": (1, SIZE, SIZE), "rgb": (3, SIZE, SIZE)}
DRAWN = spaces.Dict(
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
    buffer = ExpertReplayBuffer(200, DRAWN, spaces.Box(-1, 1, actions.shape[1:]), device="cpu", seed=0)
    places = np.cumsum([place, *(0.1 * actions[:, 1:3])], axis=0)
    drawn = [draw(*xy) for xy in places]
    stacked = {key: np.stack([entry[key] for entry in drawn]) for key in drawn[0]}
    buffer.add_episode(stacked, actions, np.zeros(len(actions)), np.arange(len(actions)) == len(actions) - 1)
    return buffer._get_samples(np.arange(len(actions)), None)


def rotated(samples, probability: float = 1.0):
    return Rotation(probability=probability)(samples, generator())


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
    cropped = model.augmentation(make_samples(np.zeros((4, 5), np.float32)), generator())
    assert cropped.observations["heightmap"].shape == (4, 1, 12, 12)
