"""RAD and DrQ compared with slow references."""

from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_extensions.encoders.extractors import CnnExtractor
from sb3_extensions.replay.augmentation import RAD, DrQ
from sb3_extensions.replay.augmentations import make_augmentation
from sb3_extensions.replay.samples import ExpertReplayBufferSamples
from sb3_extensions.sacfd import SACfD

SIDE, CROP, BATCH = 19, 16, 6
OBSERVATIONS = ("observations", "next_observations")
SPACE = spaces.Dict(
    {
        "heightmap": spaces.Box(0.0, 0.4, (2, SIDE, SIDE), np.float32),
        "holding": spaces.Box(0.0, 1.0, (1,), np.float32),
    }
)


def observations(seed: int, batch: int = BATCH) -> dict[str, th.Tensor]:
    """Return observations with a different number in every pixel, to identify windows."""
    pixels = np.random.default_rng(seed).permutation(batch * 2 * SIDE * SIDE).reshape(batch, 2, SIDE, SIDE)
    return {"heightmap": th.from_numpy(pixels.astype(np.float32)), "holding": th.arange(batch)[:, None] % 2.0}


def samples() -> ExpertReplayBufferSamples:
    def column(first: float) -> th.Tensor:
        return th.arange(BATCH, dtype=th.float32)[:, None] + first

    return ExpertReplayBufferSamples(
        observations=observations(0),
        actions=th.rand(BATCH, 5),
        next_observations=observations(1),
        dones=column(0) % 2,
        rewards=column(10),
        discounts=column(20),
        expert_actions=th.rand(BATCH, 5),
        succeeded=column(40) > 41,
        is_expert=column(0) > 2,
        weights=column(30),
        indices=np.arange(BATCH),
    )


def slow_window(image: np.ndarray, row: int, column: int, size: int) -> np.ndarray:
    """Return a window pixel by pixel, with the border of the image repeated outwards."""
    window = np.empty((len(image), size, size), np.float32)
    for c in range(len(image)):
        for i in range(size):
            for j in range(size):
                window[c, i, j] = image[c, min(max(row + i, 0), SIDE - 1), min(max(column + j, 0), SIDE - 1)]
    return window


def find_offset(image: np.ndarray, window: np.ndarray, places: range) -> tuple[int, int]:
    found = [
        (row, column)
        for row in places
        for column in places
        if np.array_equal(slow_window(image, row, column, window.shape[-1]), window)
    ]
    assert len(found) == 1
    return found[0]


def generator(seed: int = 0) -> th.Generator:
    return th.Generator().manual_seed(seed)


def test_rad_crops_both_observations_of_a_step_equally() -> None:
    before = samples()
    after = RAD(CROP)(before, generator())
    offsets = []
    for k in range(BATCH):
        pair = [
            find_offset(old["heightmap"][k].numpy(), new["heightmap"][k].numpy(), range(SIDE - CROP + 1))
            for old, new in (
                (before.observations, after.observations),
                (before.next_observations, after.next_observations),
            )
        ]
        assert pair[0] == pair[1]
        offsets.append(pair[0])
    assert len(set(offsets)) > 3
    assert after.observations["heightmap"].shape == (BATCH, 2, CROP, CROP)
    assert th.equal(after.observations["holding"], before.observations["holding"])
    assert all(after[i] is before[i] for i in range(len(before)) if after._fields[i] not in OBSERVATIONS)


@pytest.mark.parametrize(("k", "m"), [(2, 2), (3, 1), (1, 2)])
def test_drq_shifts_each_view_independently(k: int, m: int) -> None:
    before = samples()
    after = DrQ(k, m)(before, generator())
    for field, copies in (("observations", m), ("next_observations", k)):
        old, new = getattr(before, field), getattr(after, field)
        assert new["heightmap"].shape == (copies * BATCH, 2, SIDE, SIDE)
        offsets = [
            find_offset(old["heightmap"][i % BATCH].numpy(), new["heightmap"][i].numpy(), range(-4, 5))
            for i in range(copies * BATCH)
        ]
        assert len(set(offsets)) > copies * BATCH // 2
        assert th.equal(new["holding"], th.cat([old["holding"]] * copies))
    for field in ("actions", "dones", "rewards", "discounts", "expert_actions", "is_expert", "weights"):
        assert th.equal(getattr(after, field), th.cat([getattr(before, field)] * m)), field
    assert after.indices is before.indices


@pytest.mark.parametrize("augmentation", [RAD(CROP), RAD(5), DrQ(K=3, M=2)])
@pytest.mark.parametrize("first", [True, False])
def test_smaller_images_do_not_change(augmentation: Any, first: bool) -> None:
    """Smaller images have no effect on the windows of the scene, in any order of the entries."""
    before, in_hand = samples(), {"in_hand": th.rand(BATCH, 3, 8, 8)}
    joined = before._replace(
        **{
            field: {**in_hand, **getattr(before, field)} if first else {**getattr(before, field), **in_hand}
            for field in OBSERVATIONS
        }
    )
    after, without = augmentation(joined, generator()), augmentation(before, generator())
    for field in OBSERVATIONS:
        seen, expected = getattr(after, field), getattr(without, field)
        assert th.equal(seen["heightmap"], expected["heightmap"])
        copies = len(expected["holding"]) // BATCH
        assert th.equal(seen["in_hand"], th.cat([in_hand["in_hand"]] * copies))


def test_only_the_largest_images_must_be_larger_than_the_crop() -> None:
    in_hand = spaces.Box(0.0, 0.4, (1, 8, 8), np.float32)
    space = spaces.Dict({**SPACE, "in_hand": in_hand})
    for augmentation in (RAD(18), RAD(8), RAD(5), DrQ()):
        augmentation.check(space)
    with pytest.raises(ValueError, match="larger than 19 x 19"):
        RAD(19).check(space)
    with pytest.raises(ValueError, match="must have images"):
        DrQ().check(SPACE["holding"])


def test_targets_are_means_over_the_views_of_a_next_observation() -> None:
    values = th.tensor([1.0, 2.0, 3.0, 5.0, 7.0, 9.0])[:, None]
    expected = [[(1 + 5) / 2], [(2 + 7) / 2], [(3 + 9) / 2]]
    assert DrQ(2, 2).average_targets(values).tolist() == expected * 2
    assert RAD().average_targets(values) is values


@pytest.mark.parametrize(("augmentation", "places"), [(RAD(CROP), 4), (DrQ(pad=4), 9)])
def test_window_positions_are_uniform_up_to_the_edges(augmentation: Any, places: int) -> None:
    rows, columns = np.divmod(np.arange(SIDE * SIDE, dtype=np.float32).reshape(1, 1, SIDE, SIDE), SIDE)
    image = th.from_numpy(np.concatenate([rows, columns], axis=1)).expand(9_000, -1, -1, -1)
    view = augmentation.view(image, generator())
    # The middle pixel, which no shift moves onto the repeated edge, identifies the position.
    middle = view[:, :, view.shape[-1] // 2, view.shape[-1] // 2].numpy()
    counts = np.stack([np.unique(axis, return_counts=True)[1] for axis in middle.T])
    assert counts.shape == (2, places)
    expected = 9_000 / places
    assert (abs(counts - expected) < 5 * np.sqrt(expected)).all()
    pairs = np.unique(middle, axis=0)
    assert len(pairs) == places**2  # rows and columns are drawn independently


def test_views_of_uint8_images_without_a_dict() -> None:
    image = th.randint(256, (BATCH, 1, SIDE, SIDE), dtype=th.uint8)
    view = DrQ().view(image, generator(), copies=2)
    assert view.dtype == th.uint8 and view.shape == (2 * BATCH, 1, SIDE, SIDE)
    assert th.equal(view, DrQ().view({"image": image}, generator(), copies=2)["image"])


def test_views_depend_on_the_generator_only() -> None:
    first, again, other = (
        RAD(CROP).view(observations(0), generator(seed))["heightmap"] for seed in (3, 3, 4)
    )
    assert th.equal(first, again) and not th.equal(first, other)


@pytest.mark.parametrize(
    ("spec", "expected"),
    [
        (None, None),
        ("rad", RAD(128)),
        ("drq", DrQ(2, 2)),
        ({"rad": {"size": 64}}, RAD(64)),
        ({"drq": {"K": 1, "M": 3}}, DrQ(1, 3)),
        ({"drq": None}, DrQ()),
        (RAD(32), RAD(32)),
    ],
)
def test_make_augmentation_from_names_and_arguments(spec: Any, expected: Any) -> None:
    assert make_augmentation(spec) == expected


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("rda", "one of rotation, rad, drq, .* got"),
        (3, "augmentation must be None, one of rotation"),
        ({"rad": {"sise": 3}}, "unexpected keyword argument 'sise'"),
        ({"rad": {"size": 0}}, "size must be positive, got 0"),
        ({"drq": {"K": -1}}, "K must be positive, got -1"),
    ],
)
def test_make_augmentation_rejects_wrong_names_and_arguments(spec: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_augmentation(spec)


@pytest.mark.parametrize(
    ("augmentation", "message"), [(RAD(16), "larger than 16 x 16"), ("rad", "128 x 128")]
)
def test_images_must_be_larger_than_the_crop(augmentation: Any, message: str, make_toy: Any) -> None:
    with pytest.raises(ValueError, match=message):
        SACfD("MultiInputPolicy", make_toy(), augmentation=augmentation)


@pytest.mark.parametrize("crop", [0, 20])
def test_extractor_rejects_crop_larger_than_the_images(crop: int) -> None:
    with pytest.raises(ValueError, match=f"crop must be from 1 to the images' size, 19, got {crop}"):
        CnnExtractor(SPACE, crop=crop)


def test_extractor_crops_the_centre_of_an_image_and_keeps_a_crop() -> None:
    th.manual_seed(0)
    extractor = CnnExtractor(SPACE, [4, 8, 8], crop=CROP)
    whole = {"heightmap": th.rand(3, 2, SIDE, SIDE) * 0.4, "holding": th.ones(3, 1)}
    centre = {**whole, "heightmap": whole["heightmap"][..., 1:17, 1:17]}
    assert extractor.stack.size == CROP
    assert th.equal(extractor(whole), extractor(centre))
    assert not th.equal(
        extractor({**whole, "heightmap": whole["heightmap"][..., 2:18, 2:18]}), extractor(centre)
    )


SMALL: dict[str, Any] = {"features_extractor_kwargs": {"channels": [8, 16, 32]}, "net_arch": [32]}
# With the side of the toy's images: networks see 16 pixels, moved by at most one.
AUGMENTATIONS = [(RAD(CROP), 18), (DrQ(K=3, M=2, pad=1), 16)]


def make_model(
    env: Any, augmentation: Any, policy: Any = ("MultiInputPolicy", SMALL), **kwargs: Any
) -> SACfD:
    name, policy_kwargs = policy
    kwargs = {"expert_episodes": 5, "batch_size": 16, "buffer_size": 500, "seed": 0, **kwargs}
    return SACfD(name, env, policy_kwargs=policy_kwargs, augmentation=augmentation, device="cpu", **kwargs)


@pytest.mark.parametrize("in_hand_size", [0, 8])
@pytest.mark.parametrize(("augmentation", "side"), AUGMENTATIONS)
def test_run_with_every_policy(
    augmentation: Any, side: int, in_hand_size: int, policy: Any, make_toy: Any, tmp_path: Any
) -> None:
    env = make_toy(2, size=side, in_hand_size=in_hand_size)
    model = make_model(env, augmentation, policy, n_steps=2).learn(8)
    assert model._n_updates == 4
    assert "crop" not in policy[1]["features_extractor_kwargs"]  # the user's mapping stays as it is
    observation = env.reset()
    action, _ = model.predict(observation, deterministic=True)
    model.save(tmp_path / "model")
    loaded = SACfD.load(tmp_path / "model", env=env, device="cpu")
    assert loaded.augmentation == augmentation
    np.testing.assert_array_equal(loaded.predict(observation, deterministic=True)[0], action)


def test_policy_acts_on_the_centre_of_an_image(make_toy: Any) -> None:
    env = make_toy(3, size=18)
    model = make_model(env, RAD(CROP))
    observation = env.reset()
    centre = {**observation, "heightmap": observation["heightmap"][..., 1:17, 1:17]}
    tensors = {key: th.from_numpy(value) for key, value in centre.items()}
    with th.no_grad():
        trained_on = model.policy.unscale_action(model.actor(tensors, deterministic=True).numpy())
    np.testing.assert_array_equal(model.predict(observation, deterministic=True)[0], trained_on)


@pytest.mark.parametrize(("augmentation", "side"), AUGMENTATIONS)
def test_losses_are_means_over_views(augmentation: Any, side: int, make_toy: Any) -> None:
    kwargs = {"bc_weight": 0.7, "gamma": 0.9}
    model = make_model(make_toy(size=side), augmentation, **kwargs).learn(10)
    sample = model.replay_buffer.sample(16)
    sample = sample._replace(weights=th.linspace(0.1, 1, 16)[:, None], dones=th.zeros(16, 1))
    model.replay_buffer.sample = lambda *args, **kwargs: sample  # type: ignore[method-assign]
    priorities: list[Any] = []
    model.replay_buffer.update_priorities = lambda *args: priorities.append(args)  # type: ignore[method-assign]
    state, alpha = model.augmentation_generator.get_state(), model.log_ent_coef.exp().item()
    critic, target = (clone(model, name) for name in ("critic", "critic_target"))
    th.manual_seed(3)
    views = augmentation(sample, th.Generator().set_state(state))
    k_views, m_views = (len(obs["holding"]) // 16 for obs in (views.next_observations, views.observations))
    with th.no_grad():
        actions, log_prob = (x.numpy() for x in model.actor.action_log_prob(views.observations))
        next_actions, next_log_prob = model.actor.action_log_prob(views.next_observations)
        next_q = th.stack(target(views.next_observations, next_actions)).numpy()
        q = th.stack(critic(views.observations, sample.actions.repeat(m_views, 1))).numpy()
    th.manual_seed(3)
    model.train(1, 16)
    logged = model.logger.name_to_value

    critic_loss = bc_loss = 0.0
    errors = np.zeros((16, 1))
    experts = int(sample.is_expert.sum())
    assert 0 < experts < 16
    for b in range(16):
        values = [
            next_q[:, k * 16 + b, 0].min() - alpha * next_log_prob[k * 16 + b].item() for k in range(k_views)
        ]
        y = sample.rewards[b].item() + 0.9 * (1 - sample.dones[b].item()) * sum(values) / k_views
        for m in range(m_views):
            for head in range(2):
                error = q[head, m * 16 + b, 0] - y
                errors[b] += abs(error) / (2 * m_views)
                critic_loss += 0.5 * sample.weights[b].item() * error**2 / (16 * m_views)
            if sample.is_expert[b]:
                squares = (actions[m * 16 + b] - sample.actions[b].numpy()) ** 2
                bc_loss += squares.sum() / (5 * experts * m_views)
    np.testing.assert_allclose(logged["train/critic_loss"], critic_loss, rtol=1e-4)
    np.testing.assert_allclose(logged["train/bc_loss"], bc_loss, rtol=1e-4)
    np.testing.assert_array_equal(priorities[0][0], sample.indices)
    np.testing.assert_allclose(priorities[0][1], errors, rtol=1e-3)
    with th.no_grad():  # the actor's loss uses the critic before its step
        q_pi = th.stack(critic(views.observations, th.as_tensor(actions))).numpy()
    expected = np.mean([alpha * log_prob[i] - q_pi[:, i, 0].min() for i in range(16 * m_views)])
    np.testing.assert_allclose(logged["train/actor_loss"], expected, rtol=1e-4)


def clone(model: SACfD, name: str) -> Any:
    copy = type(model.policy)(
        model.observation_space, model.action_space, lambda _: 0.0, **model.policy_kwargs
    )
    copy.load_state_dict(model.policy.state_dict())
    return getattr(copy, name)


@pytest.mark.parametrize(("augmentation", "side"), AUGMENTATIONS)
def test_learns_to_reach(augmentation: Any, side: int, make_toy: Any) -> None:
    kwargs = {
        "expert_episodes": 20,
        "bc_weight": 10.0,
        "pretrain_steps": 100,
        "learning_rate": 3e-3,
        "batch_size": 32,
    }
    model = make_model(make_toy(2, size=side), augmentation, **kwargs).learn(100)
    trained, _ = evaluate_policy(model, make_toy(seed=9, size=side), 30)
    assert trained >= 0.9
