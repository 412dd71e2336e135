"""Where an algorithm gets its demonstrations from, composed into the algorithm."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, Any

import numpy.typing as npt
from stable_baselines3.common.vec_env import VecEnv

from sb3_extensions.demonstrations.checking import checked_episodes
from sb3_extensions.demonstrations.collecting import (
    AnyEnv,
    EpisodeData,
    Hand,
    collect_episodes,
    make_expert_env,
)
from sb3_extensions.demonstrations.noise import UnsteadyHand
from sb3_extensions.demonstrations.snapping import SnappingHand
from sb3_extensions.replay.expert import ExpertReplayBuffer

if TYPE_CHECKING:  # the codec's package imports this one
    from sb3_extensions.spatial_dqn.codec import SpatialActionCodec

Rescale = Callable[[npt.NDArray[Any]], npt.NDArray[Any]]


class DemonstrationSource:
    """
    Episodes that were handed over, or of the expert of an environment like the one trained in.

    :param episodes: number of successful episodes of the expert, unless ``data`` is given
    :param noise: standard deviation of a normal error with which the expert's actions are carried out, see
        :class:`~sb3_extensions.demonstrations.noise.UnsteadyHand`
    :param data: episodes to take instead, with Minari's attributes
        (see :class:`~sb3_extensions.demonstrations.collecting.EpisodeData`), in the environment's units
    :param snap: grid that the expert's actions are carried out on, see
        :class:`~sb3_extensions.demonstrations.snapping.SnappingHand`; None carries them out as they are
    :param progress_bar: whether to show progress; None shows it on a terminal
    :raises ValueError: if ``episodes`` or ``noise`` is negative, or ``data`` are no episodes
    """

    def __init__(
        self,
        episodes: int = 100,
        noise: float = 0.0,
        data: Iterable[EpisodeData] | None = None,
        snap: SpatialActionCodec | None = None,
        progress_bar: bool | None = None,
    ) -> None:
        if isinstance(data, str | os.PathLike) or not isinstance(data, Iterable | None):
            raise ValueError(
                f"expert_data must be episodes, read from a file where they are in one, got {data!r}"
            )
        for name, value in {"expert_episodes": episodes, "expert_noise": noise}.items():
            if value < 0:
                raise ValueError(f"{name} must not be negative, got {value}")
        self.episodes = episodes
        self.noise = noise
        self.data = data
        self.snap = snap
        self.progress_bar = progress_bar

    @property
    def is_empty(self) -> bool:
        """Whether there is nothing to show."""
        return self.data is None and self.episodes == 0

    def fill(self, buffer: ExpertReplayBuffer, env: VecEnv, seed: int | None, rescale: Rescale) -> None:
        """
        Add all episodes to a replay buffer.

        :param buffer: buffer without online transitions
        :param env: environment to train in
        :param seed: seed of the episodes, None draws one
        :param rescale: from actions in the environment's units to those of the policy
        :raises ValueError: if ``data`` has no episode, or is of another environment
        """
        episodes = self._expert_episodes(env, seed) if self.data is None else checked_episodes(self.data, env)
        for episode in episodes:
            wanted = getattr(episode, "expert_actions", episode.actions)
            buffer.add_episode(
                episode.observations,
                rescale(episode.actions),
                episode.rewards,
                episode.terminations,
                expert_actions=rescale(wanted),
            )
        if self.data is not None and not buffer.expert_size:
            raise ValueError(
                "expert_data must have at least one episode, got none. Pass a list: an iterator is empty "
                "after its first use"
            )

    def _expert_episodes(self, vec_env: VecEnv, seed: int | None) -> Iterable[EpisodeData]:
        if not self.episodes:
            return
        with contextlib.closing(make_expert_env(vec_env)) as env:
            yield from self._collect(env, seed)

    def _collect(self, env: AnyEnv, seed: int | None) -> Iterator[Any]:
        hand: Hand | None = UnsteadyHand(env.action_space, self.noise) if self.noise else None
        if self.snap is not None:
            hand = SnappingHand(env.action_space, self.snap, hand)
        return collect_episodes(env, self.episodes, seed, progress_bar=self.progress_bar, hand=hand)
