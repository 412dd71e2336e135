"""Demonstrations of an algorithm: passed by the user, or collected from the expert of the environment."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from stable_baselines3.common.vec_env import VecEnv

from sb3_extensions.common.components import check_integer, check_not_negative
from sb3_extensions.demonstrations.action_transforms import ActionTransform, GaussianExpertNoise, GridSnapping
from sb3_extensions.demonstrations.collection import collect_episodes
from sb3_extensions.demonstrations.episodes import EpisodeData
from sb3_extensions.demonstrations.expert_envs import make_expert_envs
from sb3_extensions.demonstrations.validation import validate_episodes
from sb3_extensions.replay.buffer import ExpertReplayBuffer

if TYPE_CHECKING:  # the codec's package imports this one
    from sb3_extensions.spatial_dqn.codec import SpatialActionCodec

ExpertData = Iterable[EpisodeData] | str | os.PathLike[str]
"""Episodes, or the path of a file of ``bulletarm_gym.demonstrations``."""


def load_episodes(data: ExpertData | None) -> Iterable[EpisodeData] | None:
    """
    Return episodes that were passed or that are in a file, or None.

    :raises ImportError: if ``data`` is a path and bulletarm-gym is not installed
    :raises OSError: if the file cannot be opened
    :raises ValueError: if the file is not a file of demonstrations, or ``data`` is something else
    """
    if not isinstance(data, Iterable | os.PathLike | None):
        raise ValueError(f"expert_data must be an iterable of episodes or the path of a file, got {data!r}")
    if not isinstance(data, str | os.PathLike):
        return data
    try:
        from bulletarm_gym.demonstrations import load
    except ImportError as error:
        raise ImportError(f"expert_data={data!r} requires: pip install bulletarm-gym") from error
    return load(data)


@dataclass(frozen=True)
class DemonstrationSource:
    """
    Source of the demonstrations.

    :param episodes: number of successful episodes of the expert, if ``data`` is None. Different environments
        contribute in proportion
    :param noise: standard deviation of Gaussian noise on the expert's executed actions, in the policy's units
    :param data: episodes in the environment's units, with Minari's attributes
    :param snap: grid to which the expert's actions are moved before they are executed, instead of noise
    :param progress_bar: whether to show progress; None shows it on a terminal only
    :raises ValueError: if ``episodes`` is not an integer of at least 0, or ``noise`` is negative
    """

    episodes: int = 100
    noise: float = 0.0
    data: Iterable[EpisodeData] | None = None
    snap: SpatialActionCodec | None = None
    progress_bar: bool | None = None

    def __post_init__(self) -> None:
        check_integer(0, expert_episodes=self.episodes)
        check_not_negative(expert_noise=self.noise)

    @property
    def is_empty(self) -> bool:
        """True without any demonstrations."""
        return self.data is None and self.episodes == 0

    def fill(
        self,
        buffer: ExpertReplayBuffer,
        env: VecEnv,
        seed: int | None,
        rescale: Callable[[npt.NDArray[Any]], npt.NDArray[Any]],
    ) -> None:
        """
        Add all episodes to a replay buffer.

        :param buffer: buffer without online steps
        :param env: training environment
        :param seed: seed of the episodes, None for a random one
        :param rescale: function from actions in the environment's units to actions in the policy's units
        :raises ValueError: if ``data`` has no episode or does not fit the environment
        """
        # Episodes of the environment itself need no validation.
        episodes = self._collect(env, seed) if self.data is None else validate_episodes(self.data, env)
        for episode in episodes:
            intended = getattr(episode, "expert_actions", None)
            buffer.add_episode(
                episode.observations,
                rescale(episode.actions),
                episode.rewards,
                episode.terminations,
                expert_actions=None if intended is None else rescale(intended),
            )
        if self.data is not None and not buffer.expert_size:
            raise ValueError(
                "expert_data must have at least one episode, got none. Pass a list: an iterator is empty "
                "after its first use"
            )

    def _collect(self, vec_env: VecEnv, seed: int | None) -> Iterator[EpisodeData]:
        """Yield episodes of copies of the training environments."""
        if not self.episodes:
            return
        expert_envs = make_expert_envs(vec_env)
        ends = np.cumsum([count for _, count in expert_envs]) * self.episodes / vec_env.num_envs
        shares = np.diff(ends.round().astype(int), prepend=0).tolist()
        for index, ((env, _), share) in enumerate(zip(expert_envs, shares, strict=True)):
            env_seed = None if seed is None else seed + index
            with contextlib.closing(env):
                yield from collect_episodes(env, share, env_seed, self.progress_bar, self._transform(env))

    def _transform(self, env: VecEnv) -> ActionTransform | None:
        if self.snap is not None:
            return GridSnapping(env.action_space, self.snap)
        return GaussianExpertNoise(env.action_space, self.noise) if self.noise else None
