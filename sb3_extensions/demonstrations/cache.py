"""Episodes kept on disk for the next run with the same environment, noise and seed."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import tempfile
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sb3_extensions.demonstrations.collecting import Episode

logger = logging.getLogger(__name__)

OBSERVATION_PREFIX = "observations."
NO_SEED = -1
KEY_DIGITS = 16


class EpisodeCache:
    """
    A folder of files with episodes, one for each key. Arrays come back bit for bit.

    A file is written whole or not at all; what cannot be read is collected again.

    :param folder: made if needed
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)

    def path(self, key: Mapping[str, Any]) -> Path:
        """
        File of a key.

        :param key: what the episodes depend on, in JSON's types
        :return: its path, whether or not it exists
        """
        digest = hashlib.sha256(json.dumps(key, sort_keys=True).encode()).hexdigest()
        return self.folder / f"episodes_{digest[:KEY_DIGITS]}.npz"

    def load(self, key: Mapping[str, Any], episodes: int) -> list[Episode] | None:
        """
        Look episodes up.

        :param key: what they depend on
        :param episodes: how many are needed
        :return: the first so many, None if there are fewer
        """
        path = self.path(key)
        try:
            with zipfile.ZipFile(path) as archive:
                if archive.testzip() is not None:
                    raise zipfile.BadZipFile("its checksums differ")
            with np.load(path) as file:
                return _unpack(dict(file), episodes)
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, EOFError, zlib.error, zipfile.BadZipFile) as error:
            logger.warning("demonstrations in %s cannot be read, they are collected again: %s", path, error)
            return None

    def save(self, key: Mapping[str, Any], episodes: Sequence[Episode]) -> None:
        """
        Keep episodes, in place of what the file of the key held.

        :param key: what they depend on
        :param episodes: at least one
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self.path(key)
        descriptor, partial = tempfile.mkstemp(prefix=f".{path.name}.", dir=self.folder)
        try:
            with os.fdopen(descriptor, "wb") as file:
                np.savez_compressed(file, **_pack(episodes))  # type: ignore[arg-type]
            os.replace(partial, path)
        except BaseException:
            os.unlink(partial)
            raise


def _pack(episodes: Sequence[Episode]) -> dict[str, npt.NDArray[Any]]:
    """All episodes in one array a part, one after the other."""
    arrays = {
        f"{OBSERVATION_PREFIX}{key}": np.concatenate([episode.observations[key] for episode in episodes])
        for key in episodes[0].observations
    }
    for name in ("actions", "expert_actions", "rewards", "terminations", "truncations"):
        arrays[name] = np.concatenate([getattr(episode, name) for episode in episodes])
    arrays["lengths"] = np.array([len(episode.actions) for episode in episodes])
    arrays["seeds"] = np.array([NO_SEED if episode.seed is None else episode.seed for episode in episodes])
    return arrays


def _unpack(arrays: dict[str, npt.NDArray[Any]], episodes: int) -> list[Episode] | None:
    lengths, seeds = arrays.pop("lengths"), arrays.pop("seeds")
    if len(lengths) < episodes:
        return None
    observations = {
        name.removeprefix(OBSERVATION_PREFIX): array
        for name, array in arrays.items()
        if name.startswith(OBSERVATION_PREFIX)
    }
    steps = {name: array for name, array in arrays.items() if not name.startswith(OBSERVATION_PREFIX)}
    found, start = [], 0
    for index in range(episodes):
        end = start + int(lengths[index])
        # An episode of n steps has n + 1 observations.
        views = {key: array[start + index : end + index + 1] for key, array in observations.items()}
        seed = None if seeds[index] == NO_SEED else int(seeds[index])
        found.append(Episode(views, seed=seed, **{name: array[start:end] for name, array in steps.items()}))
        start = end
    return found
