"""Policies on scenes of the simulator, turned and mirrored: where environments and learners meet."""

import functools
import math
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th

from bulletarm_gym.geometry import Pose
from sb3_extensions.common.action_sequence import ActionSequence
from sb3_extensions.replay.rotation import rotate_actions, rotate_images
from sb3_extensions.sacfd import SACfD

SYMMETRIC = [f"BulletArm/CloseLoopBlock{name}-v0" for name in ("Picking", "Pulling")]
SIZE = 64
NETWORK = {"channels": [4, 4, 8, 8, 8]}
TOLERANCE = 1e-4  # of a network's output, which is of the order of 0.1 to 1
ACTION = np.array([0.3, 0.7, -0.4, 0.2, 0.6], np.float32)
Observation = dict[str, np.ndarray[Any, np.dtype[np.float32]]]


@pytest.fixture(scope="module", params=SYMMETRIC)
def env(request: pytest.FixtureRequest) -> Iterator[Any]:
    made = gym.make(request.param, obs_size=SIZE).unwrapped
    made.reset(seed=5)
    yield made
    made.close()


@pytest.fixture(scope="module", params=[("cyclic", 4), ("cyclic", 8), ("dihedral", 4)], ids=str)
def model(request: pytest.FixtureRequest) -> SACfD:
    group, n = request.param
    kwargs = {"features_extractor_kwargs": {"group": group, "n": n, **NETWORK}}
    made = gym.make("BulletArm/CloseLoopBlockPicking-v0", obs_size=SIZE)
    return SACfD("EquivariantPolicy", made, buffer_size=100, seed=0, policy_kwargs=kwargs, device="cpu")


def turned(pose: Pose, about: Pose, angle: float = math.pi / 2) -> Pose:
    """About the vertical through a point."""
    x, y = rotate_actions(
        th.tensor([[pose.x - about.x, pose.y - about.y]], dtype=th.float64),
        th.tensor([angle], dtype=th.float64),
        ActionSequence("xy", 2),
    )[0].tolist()
    return Pose.planar(about.x + x, about.y + y, pose.z, pose.yaw + angle)


def mirrored(pose: Pose, about: Pose) -> Pose:
    """Left and right of the world's x axis exchanged."""
    return Pose.planar(pose.x, 2.0 * about.y - pose.y, pose.z, -pose.yaw)


def look_twice(env: Any, move: Any) -> tuple[Observation, Observation]:
    """What is seen of a scene, and of the scene moved about the gripper."""
    env.reset(seed=5)
    hand = Pose.planar(*env.scene.robot.pose.position[:3], 0.4)
    env.scene.robot.home(hand)
    before = env.observe()
    for item in list(env.scene):
        item.place(move(item.pose, hand))
    env.scene.robot.home(move(hand, hand))
    return before, env.observe()


def outputs(model: SACfD, observation: Observation, action: Any) -> tuple[Any, Any]:
    """The actor's mean before it is squashed, and both Q-values of an action."""
    seen, _ = model.policy.obs_to_tensor(observation)
    with th.no_grad():
        mean, _, _ = model.actor.get_action_dist_params(seen)
        values = model.critic(seen, th.as_tensor(action)[None])
    return mean[0].numpy(), th.cat(values).numpy().ravel()


def test_turning_the_scene_turns_the_actor_and_not_the_critic(env: Any, model: SACfD) -> None:
    before, after = look_twice(env, turned)
    np.testing.assert_array_equal(np.rot90(before["heightmap"], 1, axes=(1, 2)), after["heightmap"])
    p, x, y, z, r = ACTION
    mean, values = outputs(model, before, ACTION)
    turned_mean, turned_values = outputs(model, after, np.array([p, -y, x, z, r], np.float32))
    expected = [mean[0], -mean[2], mean[1], mean[3], mean[4]]
    np.testing.assert_allclose(turned_mean, expected, atol=TOLERANCE)
    np.testing.assert_allclose(turned_values, values, atol=TOLERANCE)


def test_mirroring_the_scene_turns_the_sign_of_the_rotation(env: Any, model: SACfD) -> None:
    before, after = look_twice(env, mirrored)
    p, x, y, z, r = ACTION
    mean, values = outputs(model, before, ACTION)
    mirrored_mean, mirrored_values = outputs(model, after, np.array([p, x, -y, z, -r], np.float32))
    expected = np.array([mean[0], mean[1], -mean[2], mean[3], -mean[4]])
    holds = np.allclose(mirrored_mean, expected, atol=TOLERANCE)
    holds &= np.allclose(mirrored_values, values, atol=TOLERANCE)
    assert holds == (model.policy_kwargs["features_extractor_kwargs"]["group"] == "dihedral")


@pytest.mark.parametrize("angle", [0.5, 2.5, 4.0])
def test_rotated_samples_are_what_a_turned_scene_shows(env: Any, angle: float) -> None:
    before, after = look_twice(env, functools.partial(turned, angle=angle))
    angles = np.arange(0, 2 * math.pi, 0.1)
    images = th.from_numpy(before["heightmap"]).expand(len(angles), -1, -1, -1)
    rotated = rotate_images(images, th.from_numpy(angles))[:, 0].numpy()
    # Within the circle that no corner of the image turns into
    rows, columns = np.indices((SIZE, SIZE)) - (SIZE - 1) / 2
    inside = np.hypot(rows, columns) < SIZE / 2 - 1
    errors = np.abs(rotated - after["heightmap"])[:, inside].mean(axis=1)
    assert math.isclose(angles[errors.argmin()], angle)
    assert errors.min() < 0.4 * np.median(errors)
