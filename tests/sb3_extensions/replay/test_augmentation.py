"""Random crops, shifts and rotations of sampled steps, compared with slow references."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_extensions.replay.augmentation import RAD, DrQ, Sequence
from sb3_extensions.replay.augmentations import make_augmentation
from sb3_extensions.replay.rotation import Rotation
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
