"""Where an algorithm gets its demonstrations from, composed into the algorithm."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy.typing as npt
from stable_baselines3.common.vec_env import VecEnv

from sb3_extensions.common.codec import SpatialActionCodec
from sb3_extensions.demonstrations.cache import EpisodeCache
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

Rescale = Callable[[npt.NDArray[Any]], npt.NDArray[Any]]


class DemonstrationSource:
    """
    Episodes that were handed over, or of the expert of an environment like the one trained in.

    :param episodes: number of successful episodes of the expert, unless ``data`` is given
    :param noise: standard deviation of a normal error with which the expert's actions are carried out, see
        :class:`~sb3_extensions.demonstrations.noise.UnsteadyHand`
    :param data: episodes to take instead, with Minari's attributes
        (see :class:`~sb3_extensions.demonstrations.collecting.EpisodeData`), in the environment's units
    :param cache: folder in which the expert's episodes are kept for the next run; None keeps none
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
        cache: str | os.PathLike[str] | None = None,
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
        self.cache = None if cache is None else EpisodeCache(cache)

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
        :raises ValueError: if ``data`` are of another environment
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

    def _expert_episodes(self, vec_env: VecEnv, seed: int | None) -> Iterable[EpisodeData]:
        if not self.episodes:
            return
        with contextlib.closing(make_expert_env(vec_env)) as env:
            environment = None if self.cache is None or seed is None else _describe(env)
            if self.cache is None or environment is None:
                yield from self._collect(env, seed)
                return
            key = {"environment": environment, "noise": self.noise, "seed": seed}
            key |= {} if self.snap is None else {"grid": self.snap.describe()}
            episodes = self.cache.load(key, self.episodes)
            if episodes is None:
                episodes = list(self._collect(env, seed))
                self.cache.save(key, episodes)
        yield from episodes

    def _collect(self, env: AnyEnv, seed: int | None) -> Iterator[Any]:
        hand: Hand | None = UnsteadyHand(env.action_space, self.noise) if self.noise else None
        if self.snap is not None:
            hand = SnappingHand(env.action_space, self.snap, hand)
        return collect_episodes(env, self.episodes, seed, progress_bar=self.progress_bar, hand=hand)


def _describe(env: AnyEnv) -> dict[str, Any] | None:
    """
    What an environment is made of: its spec, the source of its package, and the versions of that and of what
    it needs; None where that cannot be written down.
    """
    assert env.spec is not None  # it was made from one
    entry_point = env.spec.entry_point
    if callable(entry_point):
        entry_point = f"{entry_point.__module__}:{getattr(entry_point, '__qualname__', entry_point)}"
    try:
        spec = json.loads(dataclasses.replace(env.spec, entry_point=entry_point).to_json())
    except ValueError:  # a parameter is no value of JSON
        return None
    package = type(env.unwrapped).__module__.partition(".")[0]
    source = _digest(package)
    if source is None:
        return None
    return {"spec": spec, "source": source, "versions": _versions(package)}


def _digest(package: str) -> str | None:
    """Of the source of a package, or of a module of its own; None where there is none, as in a notebook."""
    module = sys.modules.get(package)
    folders = getattr(module, "__path__", None)
    if folders is not None:
        files = sorted(file for folder in folders for file in Path(folder).rglob("*.py"))
    else:
        files = [Path(file)] if (file := getattr(module, "__file__", None)) else []
    digest = hashlib.sha256()
    for file in files:
        digest.update(file.read_bytes())
    return digest.hexdigest() if files else None


def _versions(package: str) -> dict[str, str]:
    """Of the distributions of a package, of what they need, and of Gymnasium and NumPy, where installed."""
    distributions = metadata.packages_distributions().get(package, [])
    requirements = (line for name in distributions for line in metadata.requires(name) or [])
    needed = (line for line in requirements if "extra ==" not in line)
    names = {re.split(r"[^\w.-]", name, maxsplit=1)[0].lower() for name in needed}
    versions = {}
    for name in sorted({*distributions, *names, "gymnasium", "numpy"}):
        with contextlib.suppress(metadata.PackageNotFoundError):
            versions[name] = metadata.version(name)
    return versions
