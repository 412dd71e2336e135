"""Replay in which every transition is kept at several rotations of the scene."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import torch as th
from gymnasium import spaces
from torch.nn import functional as F

from sb3_extensions.common.action_sequence import ActionSequence
from sb3_extensions.common.images import is_point_cloud, scene_images
from sb3_extensions.replay.buffer import EXPERT_ACTION, AnyObservations, Observations
from sb3_extensions.replay.expert import ExpertReplayBuffer
from sb3_extensions.replay.prioritized import PrioritizedReplayBuffer

FloatArray = npt.NDArray[np.float64]


def rotate_images(images: npt.NDArray[Any], angles: FloatArray) -> npt.NDArray[Any]:
    """
    Rotate images about their centres, bilinearly; what comes from outside is the nearest pixel of the border.
    Of integer images of one channel, whose numbers may be names, each pixel is the nearest one.

    :param images: shape (n, channels, size, size), rows along x and columns along y
    :param angles: from x towards y, rad, shape (n,); pi / 2 is ``numpy.rot90(image, k=1)``
    :return: rotated images, of the same shape and type
    """
    cos, sin, zero = np.cos(angles), np.sin(angles), np.zeros(len(angles))
    # Where each pixel of the result comes from, in PyTorch's order: column, row.
    inverse = np.stack([cos, -sin, zero, sin, cos, zero], axis=1).reshape(-1, 2, 3)
    grid = F.affine_grid(th.as_tensor(inverse, dtype=th.float32), list(images.shape), align_corners=False)
    pixels = th.as_tensor(images, dtype=th.float32)
    is_float = np.issubdtype(images.dtype, np.floating)
    mode = "bilinear" if is_float or images.shape[1] > 1 else "nearest"
    rotated = F.grid_sample(pixels, grid, mode, padding_mode="border", align_corners=False).numpy()
    return (rotated if is_float else np.rint(rotated)).astype(images.dtype)


def rotate_points(points: npt.NDArray[Any], angles: FloatArray) -> npt.NDArray[Any]:
    """
    Rotate points about the z axis.

    :param points: shape (n, points, 3)
    :param angles: from x towards y, rad, shape (n,)
    :return: rotated points, of the same shape and type
    """
    cos, sin = np.cos(angles)[:, None], np.sin(angles)[:, None]
    x, y, z = np.moveaxis(points, -1, 0)
    return np.stack([cos * x - sin * y, sin * x + cos * y, z], axis=-1).astype(points.dtype)


def rotate_actions(actions: npt.NDArray[Any], angles: FloatArray, action_sequence: str) -> npt.NDArray[Any]:
    """
    Rotate (dx, dy) of actions and, of three r's, the turns about x and y, and clip them to the bounds of the
    policy's actions, [-1, 1].

    :param actions: in the units of the policy, shape (n, action dimensions)
    :param angles: from x towards y, rad, shape (n,)
    :param action_sequence: one character for each number, see
        :class:`~sb3_extensions.common.action_sequence.ActionSequence`
    :return: actions whose other numbers are untouched, of the same shape and type
    """
    rotated = actions.copy()
    action = ActionSequence(action_sequence, actions.shape[1])
    for pair in ("xy", "uv"):
        if columns := action.places(pair):
            x, y = actions[:, columns].T
            turned = np.cos(angles) * x - np.sin(angles) * y, np.sin(angles) * x + np.cos(angles) * y
            rotated[:, columns] = np.clip(np.stack(turned, axis=1), -1, 1)
    return rotated


class RotatedReplayBuffer(ExpertReplayBuffer):
    """
    :class:`~sb3_extensions.replay.expert.ExpertReplayBuffer` that also keeps rotated copies of every
    transition, the expert's and the others: both observations' images and point clouds and (dx, dy) of the
    action and of the expert's action (with three r's the turns about x and y, too) are rotated by one angle,
    everything else is as it was, also images smaller than the largest: what turns with the gripper is the
    same when scene and gripper turn together.
    An r of the action must be a turn by some angle, as in close loop, not one to turn to.

    Each copy of an episode is rotated by one angle throughout, uniform in [0, 2 pi). So a copy is an episode
    itself: its observations are kept once, and returns over several steps stay within it.

    From the paper's "Equi SACfD + PER + Aug", https://arxiv.org/abs/2205.14292, Section "Close-Loop 4D
    Benchmark".

    :param buffer_size: number of transitions, copies included
    :param observation_space: Box space of images (channels, size, size), or Dict space with at least one
    :param action_space: action space, its bounds on dx and dy alike
    :param n_envs: number of parallel environments
    :param copies: number of rotated copies of every transition
    :param action_sequence: one character for each number of the action, see
        :class:`~sb3_extensions.common.action_sequence.ActionSequence`
    :param kwargs: keyword arguments of :class:`~sb3_extensions.replay.expert.ExpertReplayBuffer`
    :raises ValueError: if there is nothing to rotate, or an argument is out of its range
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        *args: Any,
        n_envs: int = 1,
        copies: int = 4,
        action_sequence: str = "pxyzr",
        **kwargs: Any,
    ) -> None:
        if copies < 1:
            raise ValueError(f"copies must be at least 1, got {copies}")
        # A copy is one more environment to the parent.
        n_streams = n_envs * (1 + copies)
        super().__init__(buffer_size, observation_space, action_space, *args, n_envs=n_streams, **kwargs)
        if "x" not in ActionSequence(action_sequence, self.action_dim):
            raise ValueError(f"action_sequence={action_sequence!r} has no x and y to rotate")
        self.copies = copies
        self.action_sequence = action_sequence
        self._image_keys = set(scene_images(self.frames.shapes))
        shapes = {key: self.frames.shapes[key] for key in self._image_keys}
        if not shapes or any(height != width for _, height, width in shapes.values()):
            raise ValueError(f"observation_space must have images (channels, size, size), got {shapes}")
        self._angles = np.zeros((copies, n_envs))  # of the episodes under way

    def add(
        self,
        obs: AnyObservations,
        next_obs: AnyObservations,
        action: npt.NDArray[Any],
        reward: npt.NDArray[np.float32],
        done: npt.NDArray[np.bool_],
        infos: list[dict[str, Any]],
    ) -> None:
        """
        Add one transition of every environment, and its copies.

        :param obs: observations, first axis of length ``n_envs``
        :param next_obs: observations that followed; the last ones of their episodes where these have ended
        :param action: actions as the policy gave them
        :param reward: rewards, shape (n_envs,)
        :param done: whether the episode ended, shape (n_envs,)
        :param infos: ``"TimeLimit.truncated"`` says that it ended only for want of time;
            :data:`~sb3_extensions.replay.buffer.EXPERT_ACTION` is what an expert would have done instead,
            :data:`~sb3_extensions.replay.buffer.EXPLORED` whether the action was an exploratory one
        """
        obs, next_obs = self._as_dict(obs), self._as_dict(next_obs)
        begins = ~self._continues(obs)
        self._angles[:, begins] = self._draw_angles(int(begins.sum()))
        times = 1 + self.copies
        expert_actions = self._copied_actions(self._read_expert_actions(infos), self._angles)
        super().add(
            self._copied_obs(obs, begins),
            self._copied(next_obs, self._angles),
            self._copied_actions(np.asarray(action).reshape(len(begins), -1), self._angles),
            np.tile(reward, times),
            np.tile(done, times),
            [
                {**info, EXPERT_ACTION: action}
                for info, action in zip(infos * times, expert_actions, strict=True)
            ],
        )

    def add_episode(
        self,
        observations: Observations,
        actions: npt.NDArray[Any],
        rewards: npt.NDArray[Any],
        terminations: npt.NDArray[Any],
        expert_actions: npt.NDArray[Any] | None = None,
    ) -> None:
        """
        Add an episode of the expert, and its copies; only before the first online transition.

        :param observations: for each key an array of n + 1 observations
        :param actions: n actions in the units of the policy, [-1, 1], shape (n, action dimensions)
        :param rewards: n rewards
        :param terminations: n booleans, True where the episode terminated (not where it only ran out of time)
        :param expert_actions: the n actions that the expert wanted, where others were carried out
        :raises ValueError: if the lengths do not fit, the expert rows would fill the buffer, or there are
            online transitions already
        """
        super().add_episode(observations, actions, rewards, terminations, expert_actions)
        wanted = actions if expert_actions is None else expert_actions
        for angle in self._draw_angles(1)[:, 0]:
            rotated = {
                key: self._rotated(key, values, np.full(len(values), angle))
                for key, values in observations.items()
            }
            done, intended = (
                rotate_actions(given, np.full(len(actions), angle), self.action_sequence)
                for given in (actions, wanted)
            )
            super().add_episode(rotated, done, rewards, terminations, intended)

    def _draw_angles(self, count: int) -> FloatArray:
        return self.rng.uniform(0, 2 * np.pi, size=(self.copies, count))

    def _copied_obs(self, obs: Observations, begins: npt.NDArray[np.bool_]) -> Observations:
        """Observations and their copies; those of episodes that go on were rotated a step ago."""
        if self._latest is None or begins.all():
            return self._copied(obs, self._angles)
        copied = {key: values.copy() for key, values in self._latest.items()}
        if begins.any():
            begun = self._copied(
                {key: values[begins] for key, values in obs.items()}, self._angles[:, begins]
            )
            for key, values in copied.items():
                values[np.tile(begins, 1 + self.copies)] = begun[key]
        return copied

    def _copied(self, obs: Observations, angles: FloatArray) -> Observations:
        """
        Observations and their copies.

        :param obs: n of them
        :param angles: shape (copies, n)
        :return: first the n as they are, then the first copies of all, ...; n (1 + copies)
        """
        repeated = {key: np.concatenate([obs[key]] * self.copies) for key in self.frames.keys}
        rotated = {key: self._rotated(key, values, angles.ravel()) for key, values in repeated.items()}
        return {key: np.concatenate([obs[key], values]) for key, values in rotated.items()}

    def _rotated(self, key: str, values: npt.NDArray[Any], angles: FloatArray) -> npt.NDArray[Any]:
        if key in self._image_keys:
            return rotate_images(values, angles)
        return rotate_points(values, angles) if is_point_cloud(values.shape[1:]) else values

    def _copied_actions(self, actions: npt.NDArray[Any], angles: FloatArray) -> npt.NDArray[Any]:
        repeated = np.concatenate([actions] * self.copies)
        return np.concatenate([actions, rotate_actions(repeated, angles.ravel(), self.action_sequence)])


class PrioritizedRotatedReplayBuffer(PrioritizedReplayBuffer, RotatedReplayBuffer):
    """
    Both: :class:`~sb3_extensions.replay.prioritized.PrioritizedReplayBuffer` with the copies of
    :class:`RotatedReplayBuffer`, each with a priority of its own. Takes the arguments of both.
    """
