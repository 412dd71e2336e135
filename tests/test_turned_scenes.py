"""Symmetries of policies, networks and samples on rotated and mirrored scenes of the simulator."""

import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces

import bulletarm_gym  # noqa: F401  registers the environments
from bulletarm_gym.geometry import Pose
from sb3_extensions.replay.rotation import rotate_images
from sb3_extensions.sacfd import SACfD
from sb3_extensions.spatial_dqn import EquivariantASRPolicy

CLOSE_LOOP = [f"BulletArm/CloseLoopBlock{name}-v0" for name in ("Picking", "Pulling")]
OPEN_LOOP = "BulletArm/OpenLoopHouseBuilding2-v0"
SIZE, SIDE, YAWS = 48, 12, 4
TOLERANCE = 1e-4
ACTION = np.array([0.3, 0.7, -0.4, 0.2, 0.6], np.float32)
NETWORK = {
    **{"fields": [4, 4, 6], "in_hand_channels": [4, 4, 6, 6], "hidden": [16, 16], "pool_encoding": True},
    **{"patch_fields": [4, 4, 6, 4], "patch_channels": [4, 4, 6, 6], "patch_hidden": [16, 8]},
}
Observation = dict[str, Any]


def make_env(env_id, **sizes):
    made = gym.make(env_id, **sizes).unwrapped
    yield made
    made.close()


@pytest.fixture(scope="module", params=CLOSE_LOOP)
def env(request):
    yield from make_env(request.param, obs_size=64)


@pytest.fixture(scope="module")
def open_loop():
    yield from make_env(OPEN_LOOP, obs_size=SIZE, in_hand_size=SIDE)


def moved(pose, centre, angle, mirror):
    """Rotate a pose about the vertical through a point, then mirror it along y."""
    x, y = pose.x - centre[0], pose.y - centre[1]
    x, y = math.cos(angle) * x - math.sin(angle) * y, math.sin(angle) * x + math.cos(angle) * y
    sign = -1.0 if mirror else 1.0
    return Pose.planar(centre[0] + x, centre[1] + sign * y, pose.z, sign * (pose.yaw + angle))


def look_twice(env, angle, mirror=False):
    """Return the observations of a scene and of the moved scene; in closed loop the gripper moves, too."""
    env.reset(seed=5)
    is_closed = env.config.control == "close_loop"
    tool = Pose.planar(*env.scene.robot.pose.position, 0.4)
    centre = tool.position if is_closed else env.config.centre
    if is_closed:
        env.scene.robot.home(tool)
    before = env.observe()
    for obj in list(env.scene):
        obj.place(moved(obj.pose, centre, angle, mirror))
    if is_closed:
        env.scene.robot.home(moved(tool, centre, angle, mirror))
    return before, env.observe()


# Actor and critic of closed-loop control


@pytest.fixture(scope="module", params=[("cyclic", 4), ("cyclic", 8), ("dihedral", 4)], ids=str)
def model(request):
    group, n = request.param
    kwargs = {"features_extractor_kwargs": {"group": group, "n": n, "channels": [4, 4, 8, 8, 8]}}
    made = gym.make(CLOSE_LOOP[0], obs_size=64)
    return SACfD("EquivariantPolicy", made, buffer_size=100, seed=0, policy_kwargs=kwargs, device="cpu")


def outputs(model, observation, action):
    """Return the mean of the actor before the squashing, and both Q values of an action."""
    tensors, _ = model.policy.obs_to_tensor(observation)
    with th.no_grad():
        mean, _, _ = model.actor.get_action_dist_params(tensors)
        values = model.critic(tensors, th.as_tensor(action, dtype=th.float32)[None])
    return th.cat([mean[0], *(value[0] for value in values)]).numpy()


@pytest.mark.parametrize("mirror", [False, True])
def test_actor_moves_with_the_scene_and_the_critic_is_invariant(env, model, mirror):
    before, after = look_twice(env, 0.0 if mirror else math.pi / 2, mirror)
    if not mirror:
        np.testing.assert_array_equal(np.rot90(before["heightmap"], 1, axes=(1, 2)), after["heightmap"])

    def move(action):
        p, x, y, z, r, *values = action
        return [p, x, -y, z, -r, *values] if mirror else [p, -y, x, z, r, *values]

    expected, found = move(outputs(model, before, ACTION)), outputs(model, after, move(ACTION))
    is_symmetric = not mirror or model.policy_kwargs["features_extractor_kwargs"]["group"] == "dihedral"
    assert np.allclose(found, expected, atol=TOLERANCE) == is_symmetric


@pytest.mark.parametrize("angle", [0.5, 2.5, 4.0])
def test_rotated_samples_equal_a_rotated_scene(env, angle):
    before, after = look_twice(env, angle)
    angles = np.arange(0, 2 * math.pi, 0.1)
    images = th.from_numpy(before["heightmap"]).expand(len(angles), -1, -1, -1)
    rotated = rotate_images(images, th.from_numpy(angles))[:, 0].numpy()
    rows, columns = np.indices(rotated.shape[1:]) - 31.5
    inside = np.hypot(rows, columns) < 31.0  # no corner of the image moves there
    errors = np.abs(rotated - after["heightmap"])[:, inside].mean(axis=1)
    assert math.isclose(angles[errors.argmin()], angle) and errors.min() < 0.4 * np.median(errors)


# Networks of open-loop control


def assert_same(found, expected):
    for sample, other in zip(expected, found, strict=True):
        assert sample.std() > 0 and (other - sample).abs().max() < TOLERANCE * sample.std()


def test_all_levels_rotate_with_the_scene(open_loop):
    """Yaws shift; heights and tilts do not change if the gripper need not be rotated by pi."""
    in_hand = 0.05 * th.rand(1, 3, SIDE, SIDE, generator=th.Generator().manual_seed(0))
    shared = {"in_hand": in_hand.expand(2, -1, -1, -1), "holding": th.tensor([[0.0], [1.0]])}
    images = [th.as_tensor(seen["heightmap"]) for seen in look_twice(open_loop, math.pi / 2)]
    before, after = ({"heightmap": image.expand(2, 1, SIZE, SIZE), **shared} for image in images)
    th.manual_seed(0)
    in_hand_space = spaces.Box(0.0, 0.4, (3, SIDE, SIDE), np.float32)
    policy = EquivariantASRPolicy(
        spaces.Dict({**open_loop.observation_space.spaces, "in_hand": in_hand_space}),
        spaces.Box(-1.0, 1.0, (7,), np.float32),
        lambda _: 0.0,
        action_sequence="pxyzrrr",
        codec_kwargs={"num_rotations": YAWS},
        network_kwargs=NETWORK,
        standardise=(0.0, 0.02),
        quantise=None,
    )
    highest = before["heightmap"].flatten(1).argmax(dim=1)
    indices = th.stack([highest // SIZE, highest % SIZE, *th.tensor([[1, 0], [3, 1], [5, 2], [1, 4]])], dim=1)
    rotated = indices.clone()
    rotated[:, 0], rotated[:, 1] = SIZE - 1 - indices[:, 1], indices[:, 0]
    rotated[:, 2] += YAWS // 2
    with th.no_grad():
        views = [policy.q_net.scene_view(batch) for batch in (before, after)]
        maps, rotated_maps = (policy.q_net.pixel_maps(view)[0] for view in views)
        first, second = policy.q_net.values(before, indices), policy.q_net.values(after, rotated)
    assert_same(rotated_maps, th.rot90(maps, 1, (2, 3)))
    assert_same(second[1], first[1].roll(YAWS // 2, dims=1))
    for here, there in zip(first[2:], second[2:], strict=True):
        assert_same(there, here)
