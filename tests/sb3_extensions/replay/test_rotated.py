"""Rotated copies of transitions in the replay buffer."""

import math
import pickle
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_extensions.replay import rotated as rotated_replay
from sb3_extensions.replay.buffer import EXPERT_ACTION
from sb3_extensions.replay.rotated import (
    PrioritizedRotatedReplayBuffer,
    RotatedReplayBuffer,
    rotate_actions,
    rotate_images,
    rotate_points,
)
from sb3_extensions.sacfd import SACfD

SIZE, COPIES = 17, 4
LEVEL = 0.4 / 255  # of the stored images, m
SPACE = spaces.Dict(
    {
        "heightmap": spaces.Box(0.0, 0.4, (1, SIZE, SIZE), np.float32),
        "rgb": spaces.Box(0, 255, (3, SIZE, SIZE), np.uint8),
        "in_hand": spaces.Box(0.0, 0.4, (1, 8, 8), np.float32),
        "holding": spaces.Box(0.0, 1.0, (1,), np.float32),
    }
)
ACTIONS = spaces.Box(-1, 1, (5,), np.float32)
both_buffers = pytest.mark.parametrize("cls", [RotatedReplayBuffer, PrioritizedRotatedReplayBuffer])


def draw(x: float, y: float, number: float) -> dict[str, np.ndarray]:
    """A bump at a place of a square of 2 m, drawn wide enough for bilinear interpolation."""
    rows, columns = np.meshgrid(*[np.linspace(-1, 1, SIZE)] * 2, indexing="ij")
    image = 0.3 * np.exp(-((rows - x) ** 2 + (columns - y) ** 2) / 0.2)[None].astype(np.float32)
    rgb = np.repeat(np.rint(image * 600), 3, axis=0).astype(np.uint8)
    in_hand = image[:, 2:10, 2:10]  # a corner, so that turned it would differ
    return {
        "heightmap": image,
        "rgb": rgb,
        "in_hand": in_hand,
        "holding": np.array([number], np.float32),
    }


def stack(observations: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    return {key: np.stack([o[key] for o in observations]) for key in observations[0]}


def turn(x: float, y: float, angle: float) -> tuple[float, float]:
    return math.cos(angle) * x - math.sin(angle) * y, math.sin(angle) * x + math.cos(angle) * y


def make_buffer(cls: type = RotatedReplayBuffer, size: int = 400, **kwargs: Any) -> Any:
    kwargs = {"gamma": 0.9, "seed": 3, "device": "cpu", "action_sequence": "pxyzr", **kwargs}
    return cls(size, SPACE, ACTIONS, **kwargs)


class Wanderers:
    """Points that wander, one an environment; reward and ``holding`` tell the steps apart."""

    def __init__(self, buffer: Any, n_envs: int) -> None:
        self.buffer, self.n_envs, self.rng = buffer, n_envs, np.random.default_rng(0)
        self.places = self.rng.uniform(-0.5, 0.5, (n_envs, 2))
        self.count = 0

    def obs(self) -> dict[str, np.ndarray]:
        return stack([draw(x, y, (self.count % 50) / 50) for x, y in self.places])

    def step(self, ends: Any = False) -> None:
        obs = self.obs()
        actions = self.rng.uniform(-1, 1, (self.n_envs, 5)).astype(np.float32)
        self.places = np.clip(self.places + 0.1 * actions[:, 1:3], -0.6, 0.6)
        self.count += 1
        done = np.broadcast_to(ends, self.n_envs)
        rewards = self.count + 1000 * np.arange(self.n_envs, dtype=np.float32)
        # The first one's expert would have gone the other way; of the others nobody was asked.
        infos: list[dict[str, Any]] = [{EXPERT_ACTION: -actions[0]}, *[{}] * (self.n_envs - 1)]
        self.buffer.add(obs, self.obs(), actions, rewards, done, infos)
        self.places[done] = self.rng.uniform(-0.5, 0.5, (int(done.sum()), 2))


def expert_episode(n: int) -> tuple[Any, ...]:
    observations = stack([draw(0.4 - 0.1 * k, -0.3, 0) for k in range(n + 1)])
    actions = np.tile(np.array([0.2, 0.9, -0.9, 0.3, -0.6], np.float32), (n, 1))
    return observations, actions, np.arange(n, dtype=np.float32), np.arange(n) == n - 1


@pytest.mark.parametrize("quarter", range(4))
@pytest.mark.parametrize("size", [4, 5])
def test_quarter_turns_are_exact(quarter: int, size: int) -> None:
    images = np.random.default_rng(0).random((3, 2, size, size)).astype(np.float32)
    rotated = rotate_images(images, np.full(3, quarter * math.pi / 2))
    np.testing.assert_allclose(rotated, np.rot90(images, quarter, axes=(2, 3)), atol=1e-5)
    levels = (images * 255).astype(np.uint8)
    rotated = rotate_images(levels, np.full(3, quarter * math.pi / 2))
    np.testing.assert_array_equal(rotated, np.rot90(levels, quarter, axes=(2, 3)))


@pytest.mark.parametrize("angle", [0.3, 2.0, 4.5])
def test_a_turned_scene_is_the_turned_image(angle: float) -> None:
    x, y = 0.4, -0.3
    before, after = draw(x, y, 0), draw(*turn(x, y, angle), 0)
    rotated = rotate_images(before["heightmap"][None], np.array([angle]))[0]
    assert np.abs(before["heightmap"] - after["heightmap"]).max() > 0.06
    # Within the circle that no corner of the image turns into
    inside = np.hypot(*(np.indices((SIZE, SIZE)) - SIZE // 2)) <= SIZE // 2
    np.testing.assert_allclose(rotated[0][inside], after["heightmap"][0][inside], atol=0.02)  # of 0.3 m


def test_beyond_the_border_is_the_nearest_pixel() -> None:
    image = np.zeros((1, 1, 5, 5), np.float32)
    image[0, 0, 0, 0] = 1.0
    rotated = rotate_images(image, np.array([math.pi / 4]))[0, 0]
    # The first row's centre comes from beyond the corner that held the 1.
    assert rotated[0, 2] < 1 and rotated.argmax() in (1, 2, 5, 6, 10)
    assert (rotate_images(np.ones((1, 1, 5, 5), np.float32), np.array([0.7])) == 1).all()


@pytest.mark.parametrize("sequence", ["pxyzr", "rzyxp", "pxyz"])
def test_only_x_and_y_of_actions_turn(sequence: str) -> None:
    rng = np.random.default_rng(0)
    actions = rng.uniform(-0.7, 0.7, (50, len(sequence))).astype(np.float32)
    angles = rng.uniform(0, 2 * math.pi, 50)
    rotated = rotate_actions(actions, angles, sequence)
    x, y = sequence.index("x"), sequence.index("y")
    for before, after, angle in zip(actions, rotated, angles, strict=True):
        np.testing.assert_allclose((after[x], after[y]), turn(before[x], before[y], angle), atol=1e-6)
        others = [k for k in range(len(sequence)) if k not in (x, y)]
        np.testing.assert_array_equal(after[others], before[others])
    corner = np.zeros((1, len(sequence)), np.float32)
    corner[0, [x, y]] = 1
    clipped = rotate_actions(corner, np.array([math.pi / 4]), sequence)
    np.testing.assert_allclose((clipped[0, x], clipped[0, y]), (0, 1), atol=1e-6)


def test_turns_about_x_and_y_are_turned() -> None:
    """As the rotation that they are a vector of: by a quarter, about x becomes about y."""
    action = np.array([[0.5, 1, 0, 0.1, 0.3, 0.2, 0.4]], np.float32)
    rotated = rotate_actions(action, np.array([math.pi / 2]), "pxyzrrr")
    np.testing.assert_allclose(rotated, [[0.5, 0, 1, 0.1, -0.2, 0.3, 0.4]], atol=1e-6)


@both_buffers
@pytest.mark.parametrize("n_steps", [1, 3])
def test_copies_are_the_transitions_turned(cls: type, n_steps: int) -> None:
    buffer = make_buffer(cls, size=260, n_envs=2, n_steps=n_steps, copies=COPIES, frames_per_transition=2)
    buffer.add_episode(*expert_episode(4))
    assert buffer.expert_size == 4 * (1 + COPIES)
    wanderers = Wanderers(buffer, 2)
    for k in range(40):  # once around and more
        wanderers.step(ends=[k % 7 == 6, k % 5 == 4])
    assert buffer.size() == 260 and buffer.expert_size == 4 * (1 + COPIES)
    samples = buffer.sample(3000)
    by_step: dict[Any, dict[int, int]] = {}
    for k, (reward, expert) in enumerate(zip(samples.rewards.tolist(), samples.is_expert, strict=True)):
        by_step.setdefault((bool(expert), reward[0]), {})[samples.indices[k]] = k
    whole = [list(rows.values()) for rows in by_step.values() if len(rows) == 1 + COPIES]
    assert len(whole) >= 260 / (1 + COPIES) - 5  # the oldest step may have lost some
    angles = []
    for rows in whole:
        stored = np.sort([samples.indices[k] for k in rows])
        original = next(k for k in rows if samples.indices[k] == stored[0])
        for k in set(rows) - {original}:
            angle = check_copy(samples, original, k)
            angles.append(angle)
    quadrants = np.bincount((np.array(angles) // (math.pi / 2)).astype(int), minlength=4)
    assert (quadrants > 0.08 * len(angles)).all()


def check_copy(samples: Any, original: int, copy: int) -> float:
    """Find the angle of a copy by its actions or images, and check that all of it agrees."""
    tensors = {"obs": samples.observations, "next": samples.next_observations}
    images = {name: t["heightmap"][original].numpy() for name, t in tensors.items()}
    seen = {name: t["heightmap"][copy].numpy() for name, t in tensors.items()}
    candidates = np.linspace(0, 2 * math.pi, 721)[:-1]
    turned = rotate_images(np.repeat(images["obs"][None], len(candidates), axis=0), candidates)
    angle = candidates[np.abs(turned - seen["obs"]).mean(axis=(1, 2, 3)).argmin()]
    for name in ("obs", "next"):
        again = rotate_images(images[name][None], np.array([angle]))[0]
        np.testing.assert_allclose(seen[name], again, atol=0.01)
        rgb = tensors[name]["rgb"].numpy()
        again = rotate_images(rgb[original][None], np.array([angle]))[0].astype(float)
        assert np.abs(rgb[copy] - again).max() < 8
        assert tensors[name]["holding"][original] == tensors[name]["holding"][copy]
        assert th.equal(tensors[name]["in_hand"][original], tensors[name]["in_hand"][copy])
    action, turned_action = samples.actions[[original, copy]].numpy()
    expected = np.clip(turn(action[1], action[2], angle), -1, 1)
    np.testing.assert_allclose(turned_action[1:3], expected, atol=0.02)
    np.testing.assert_array_equal(turned_action[[0, 3, 4]], action[[0, 3, 4]])
    direction = 1.0 if samples.is_expert[original] else -1.0 if samples.rewards[original] < 1000 else np.nan
    for k in (original, copy):
        np.testing.assert_array_equal(samples.expert_actions[k], direction * samples.actions[k])
    for name in ("rewards", "dones", "discounts", "is_expert"):
        assert getattr(samples, name)[original] == getattr(samples, name)[copy], name
    return float(angle)


def test_every_image_is_kept_once() -> None:
    buffer = make_buffer(n_envs=2, copies=COPIES)
    wanderers = Wanderers(buffer, 2)
    for _ in range(6):
        wanderers.step()
    assert buffer.frames.ring.end == (1 + COPIES) * 2 * 7
    wanderers.step(ends=[True, False])
    wanderers.step()
    assert buffer.frames.ring.end == (1 + COPIES) * (2 * 9 + 1)


def test_images_are_turned_once(monkeypatch: pytest.MonkeyPatch) -> None:
    counted = []
    original = rotated_replay.rotate_images
    monkeypatch.setattr(
        rotated_replay,
        "rotate_images",
        lambda images, a: (counted.append(len(images)), original(images, a))[1],
    )
    wanderers = Wanderers(make_buffer(n_envs=2, copies=COPIES), 2)
    wanderers.step()
    wanderers.step(ends=[True, False])
    counted.clear()
    wanderers.step()
    assert sum(counted) == 2 * COPIES * (2 + 1)  # two keys: both next observations, and one that begins


def test_a_reset_amid_an_episode_breaks_the_copies_too() -> None:
    buffer = make_buffer(n_steps=3)
    wanderers = Wanderers(buffer, 1)
    wanderers.step()
    wanderers.places += 0.05  # as env.reset() does between two learn()
    wanderers.step()
    np.testing.assert_array_equal(buffer.table["next_row"][:10], -1)


@both_buffers
def test_same_seed_same_copies_and_pickle(cls: type) -> None:
    buffers = [make_buffer(cls, n_envs=2, copies=2) for _ in range(2)]
    players = []
    for buffer in buffers:
        buffer.add_episode(*expert_episode(3))
        players.append(Wanderers(buffer, 2))
        for _ in range(8):
            players[-1].step()
    buffers[1] = players[1].buffer = pickle.loads(pickle.dumps(buffers[1]))
    for _ in range(3):
        for player in players:
            player.step(ends=[True, False])
        ours, theirs = (buffer.sample(50) for buffer in buffers)
        np.testing.assert_array_equal(ours.indices, theirs.indices)
        np.testing.assert_array_equal(ours.weights, theirs.weights)
        for key, values in ours.observations.items():
            np.testing.assert_array_equal(values, theirs.observations[key])
        np.testing.assert_array_equal(ours.actions, theirs.actions)


@both_buffers
def test_sacfd_learns_from_copies(cls: type, make_toy: Any) -> None:
    model = SACfD(
        "EquivariantPolicy",
        make_toy(2),
        replay_buffer_class=cls,
        replay_buffer_kwargs={"copies": 2},
        n_steps=2,
        expert_episodes=3,
        policy_kwargs={"features_extractor_kwargs": {"n": 4, "channels": [2, 4, 8]}},
        seed=0,
        device="cpu",
    )
    model.learn(10)
    buffer = model.replay_buffer
    assert buffer.size() == buffer.expert_size + 3 * 10 and buffer.expert_size % 3 == 0
    # What the copies teach is what the equivariant policy knows.
    observations = stack([buffer.frames.read(np.array([0]))])
    image, holding = observations["heightmap"][0], observations["holding"][0]
    angle = np.array([math.pi / 2])
    turned = {"heightmap": rotate_images(image, angle), "holding": holding}
    action, _ = model.predict({"heightmap": image, "holding": holding}, deterministic=True)
    expected = rotate_actions(action, angle, "pxyzr")
    np.testing.assert_allclose(model.predict(turned, deterministic=True)[0], expected, atol=1e-4)
    assert th.isfinite(model.actor(buffer.sample(4).observations)).all()


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"copies": 0}, "copies"),
        ({"action_sequence": "pxy"}, "action_sequence"),
        ({"observation_space": SPACE["holding"]}, "images"),
        ({"observation_space": spaces.Box(0, 1, (1, 4, 5))}, "images"),
    ],
)
def test_bad_arguments(kwargs: dict[str, Any], message: str) -> None:
    arguments = {"observation_space": SPACE, "action_space": ACTIONS, **kwargs}
    with pytest.raises(ValueError, match=message):
        RotatedReplayBuffer(50, **arguments)


def test_without_motion_in_the_plane_there_is_nothing_to_turn() -> None:
    with pytest.raises(ValueError, match="no x and y"):
        RotatedReplayBuffer(50, SPACE, spaces.Box(-1, 1, (2,)), action_sequence="pz")


def test_names_in_images_of_one_channel_stay_names() -> None:
    labels = np.zeros((1, 1, 33, 33), np.uint8)
    labels[0, 0, 8:20, 5:25] = 200
    turned = rotate_images(labels, np.array([0.7]))
    assert set(np.unique(turned)) == {0, 200}
    assert (turned > 0).sum() == pytest.approx((labels > 0).sum(), rel=0.05)


def test_colours_turn_with_heights_and_points() -> None:
    """A quarter turn from x towards y: (x, y) becomes (-y, x), an image ``rot90`` of itself."""
    colours = np.arange(3 * 9 * 9, dtype=np.uint8).reshape(1, 3, 9, 9)
    np.testing.assert_array_equal(
        rotate_images(colours, np.array([np.pi / 2])), np.rot90(colours, axes=(2, 3))
    )
    points = np.array([[[1.0, 2.0, 3.0]], [[0.5, 0.0, -1.0]]], np.float32)
    turned = rotate_points(points, np.array([np.pi / 2, np.pi]))
    np.testing.assert_allclose(turned, [[[-2.0, 1.0, 3.0]], [[-0.5, 0.0, -1.0]]], atol=1e-6)
    assert turned.dtype == np.float32


def test_copies_of_points_turn() -> None:
    space = spaces.Dict(
        {
            "image": spaces.Box(0.0, 1.0, (1, 8, 8), np.float32),
            "points": spaces.Box(-np.inf, np.inf, (4, 3), np.float32),
        }
    )
    buffer = RotatedReplayBuffer(
        100, space, spaces.Box(-1.0, 1.0, (2,), np.float32), copies=2, action_sequence="xy", seed=0
    )
    points = np.random.default_rng(0).normal(size=(3, 4, 3)).astype(np.float32)
    observations = {"image": np.zeros((3, 1, 8, 8), np.float32), "points": points}
    buffer.add_episode(observations, np.array([[1.0, 0.0], [0.6, 0.0]]), np.zeros(2), np.array([False, True]))
    batch = buffer._get_samples(np.arange(6))
    for first, action in zip(range(0, 6, 2), batch.actions[::2].numpy(), strict=True):
        angle = np.arctan2(action[1], action[0])
        seen = batch.observations["points"][first : first + 2].numpy()
        np.testing.assert_allclose(seen, rotate_points(points[:2], np.full(2, angle)), atol=1e-5)
