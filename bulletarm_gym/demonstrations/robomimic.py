"""Demonstrations as an HDF5 file of robomimic."""

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from bulletarm_gym.config_checks import check_argument, fraction
from bulletarm_gym.demonstrations.episodes import PACKED, Demonstrations, Episode, atomic_path
from bulletarm_gym.demonstrations.exports import CAMERAS, exported_env, observations, short_name
from bulletarm_gym.env import ManipulationEnv


def export_robomimic(
    demonstrations: Demonstrations,
    path: str | os.PathLike[str],
    *,
    cameras: Mapping[str, Mapping[str, Any]] = CAMERAS,
    object_poses: bool = False,
    valid_ratio: float = 0.1,
) -> Path:
    """Store demonstrations as an HDF5 file of robomimic, with images.

    The episodes are replayed for images and poses. ``data/demo_0`` and so on have ``actions``, ``rewards``
    and ``dones`` of n steps, and in ``obs`` and ``next_obs`` the observations before and after each action:

    - ``<camera>_image``: RGB image, (n, height, width, 3) uint8
    - ``state``, ``heightmap`` and so on, and ``environment_state`` with ``object_poses=True``, as
      ``observation.state`` and so on of
      :func:`~bulletarm_gym.demonstrations.exports.export_lerobot`

    The attribute ``ep_meta`` of a demonstration has the environment's ``instruction`` as ``lang``. The filter
    keys ``train`` and ``valid`` divide the demonstrations.

    :param path: file, written atomically
    :param cameras: parameters of the sensor ``rgb``, by the names of cameras
    :param valid_ratio: fraction of the demonstrations in ``valid``, the last ones
    :return: ``path``
    :raises FileExistsError: ``path`` exists
    :raises ReplayError: a replayed episode differs from the recorded one
    :raises ValueError: a parameter is invalid, or two observations have the same name
    """
    check_argument("valid_ratio", valid_ratio, fraction)
    path = Path(path)
    if path.exists():
        raise FileExistsError(f"path must be a new file, got {path}, which exists")
    with exported_env(demonstrations) as env, atomic_path(path) as temporary:
        core: ManipulationEnv = env.unwrapped  # type: ignore[assignment]
        names = [f"demo_{index}" for index in range(len(demonstrations))]
        with h5py.File(temporary, "w") as file:
            data = file.create_group("data")
            for index, name in enumerate(tqdm(names, "robomimic", unit="episode", disable=None)):
                found = observations(index, demonstrations, core, cameras, object_poses)
                group = _write(data.create_group(name), demonstrations[index], list(found))
                group.attrs["ep_meta"] = json.dumps({"lang": core.instruction})
            gym_type, kwargs = 2, demonstrations.parameters  # 2 is in robomimic's EnvType
            env_args = {"env_name": demonstrations.env_id, "type": gym_type, "env_kwargs": kwargs}
            data.attrs["env_args"] = json.dumps(env_args)
            data.attrs["total"] = sum(group.attrs["num_samples"] for group in data.values())
            first = len(names) - round(valid_ratio * len(names))
            file["mask/train"], file["mask/valid"] = (
                np.array(names[:first], "S"),
                np.array(names[first:], "S"),
            )
    return path


def _write(
    group: h5py.Group, episode: Episode, observations: Sequence[Mapping[str, NDArray[Any]]]
) -> h5py.Group:
    """Write an episode of n actions and n + 1 observations."""
    group.attrs["num_samples"] = len(episode)
    group["actions"], group["rewards"] = episode.actions, episode.rewards
    group["dones"] = np.arange(len(episode)) + 1 == len(episode)
    for name in observations[0]:
        values = np.stack([observation[name] for observation in observations])
        key = short_name(name)
        group.create_dataset(f"obs/{key}", data=values[:-1], **PACKED)
        group.create_dataset(f"next_obs/{key}", data=values[1:], **PACKED)
    return group
