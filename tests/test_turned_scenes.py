"""Symmetry of the equivariant policy on rotated and mirrored scenes of the simulator."""

import math

import gymnasium as gym
import numpy as np
import pytest
import torch as th

from bulletarm_gym.geometry import Pose
from sb3_extensions.sacfd import SACfD

TOLERANCE = 1e-4
ACTION = np.array([0.3, 0.7, -0.4, 0.2, 0.6], np.float32)


def moved(pose, centre, angle, mirror):
    """Rotate a pose about the vertical through a point, then mirror it along y."""
    x, y = pose.x - centre[0], pose.y - centre[1]
    x, y = math.cos(angle) * x - math.sin(angle) * y, math.sin(angle) * x + math.cos(angle) * y
    sign = -1.0 if mirror else 1.0
    return Pose.planar(centre[0] + x, centre[1] + sign * y, pose.z, sign * (pose.yaw + angle))


def look_twice(env, angle, mirror):
    """Return the observations of a scene and of the moved scene with the moved gripper."""
    env.reset(seed=5)
    tool = Pose.planar(*env.scene.robot.pose.position, 0.4)
    env.scene.robot.home(tool)
    before = env.observe()
    for obj in list(env.scene):
        obj.place(moved(obj.pose, tool.position, angle, mirror))
    env.scene.robot.home(moved(tool, tool.position, angle, mirror))
    return before, env.observe()


def outputs(model, observation, action):
    """Return the mean of the actor before the squashing, and both Q values of an action."""
    tensors, _ = model.policy.obs_to_tensor(observation)
    with th.no_grad():
        mean, _, _ = model.actor.get_action_dist_params(tensors)
        values = model.critic(tensors, th.as_tensor(action, dtype=th.float32)[None])
    return th.cat([mean[0], *(value[0] for value in values)]).numpy()


@pytest.mark.parametrize(("group", "n"), [("cyclic", 8), ("dihedral", 4)])
def test_actor_moves_with_the_scene_and_the_critic_is_invariant(group, n):
    env = gym.make("BulletArm/CloseLoopBlockPulling-v0", obs_size=64)
    kwargs = {"features_extractor_kwargs": {"group": group, "n": n, "channels": [4, 4, 8, 8, 8]}}
    model = SACfD("EquivariantPolicy", env, buffer_size=100, seed=0, policy_kwargs=kwargs, device="cpu")
    for mirror in (False, True):
        before, after = look_twice(env.unwrapped, 0.0 if mirror else math.pi / 2, mirror)
        if not mirror:
            np.testing.assert_array_equal(np.rot90(before["heightmap"], 1, axes=(1, 2)), after["heightmap"])

        def move(action, mirror=mirror):
            p, x, y, z, r, *values = action
            return [p, x, -y, z, -r, *values] if mirror else [p, -y, x, z, r, *values]

        expected, found = move(outputs(model, before, ACTION)), outputs(model, after, move(ACTION))
        assert np.allclose(found, expected, atol=TOLERANCE) == (group == "dihedral" or not mirror)
    env.close()
