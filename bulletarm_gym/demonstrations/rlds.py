"""Demonstrations as an RLDS dataset (Ramos et al. 2021), in the format of TensorFlow Datasets."""

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from bulletarm_gym.demonstrations.episodes import Demonstrations, Episode, atomic_path
from bulletarm_gym.demonstrations.exports import CAMERAS, exported_env, observations, short_name
from bulletarm_gym.env import ManipulationEnv

if TYPE_CHECKING:
    from tensorflow_datasets.core import DatasetInfo


def export_rlds(
    demonstrations: Demonstrations,
    folder: str | os.PathLike[str],
    *,
    name: str = "bulletarm",
    cameras: Mapping[str, Mapping[str, Any]] = CAMERAS,
    object_poses: bool = False,
) -> Path:
    """Store demonstrations as an RLDS dataset, which ``tfds.builder_from_directory()`` opens.

    The episodes are replayed for images and poses. An episode of n actions has n + 1 ``steps``. A step has
    the ``observation`` before its ``action``, and the ``reward`` and ``discount`` after it. The last step has
    the last observation, and zeros for the others, as RLDS defines. The observation has:

    - ``<camera>_image``: RGB image, (height, width, 3) uint8
    - ``state``, ``heightmap`` and so on, and ``environment_state`` with ``object_poses=True``, as
      ``observation.state`` and so on of
      :func:`~bulletarm_gym.demonstrations.exports.export_lerobot`

    Each step has the environment's ``instruction`` as ``language_instruction``, as in Open X-Embodiment.

    :param folder: new folder, written atomically
    :param cameras: parameters of the sensor ``rgb``, by the names of cameras
    :return: ``folder``
    :raises FileExistsError: ``folder`` exists
    :raises ImportError: TensorFlow or TensorFlow Datasets is not installed
    :raises ReplayError: a replayed episode differs from the recorded one
    :raises ValueError: a parameter is invalid, or two observations have the same name
    """
    try:
        import tensorflow  # noqa: F401, which TensorFlow Datasets imports later
        import tensorflow_datasets as tfds
    except ImportError as error:
        raise ImportError(f"{error}: pip install 'bulletarm-gym[rlds]'") from error
    folder = Path(folder)
    if folder.exists():
        raise FileExistsError(f"folder must be a new folder, got {folder}, which exists")
    with exported_env(demonstrations) as env, atomic_path(folder) as temporary:
        core: ManipulationEnv = env.unwrapped  # type: ignore[assignment]
        arguments = (demonstrations, core, cameras, object_poses)
        first = next(steps(demonstrations[0], observations(0, *arguments), core.instruction))
        temporary.mkdir()
        writer = tfds.core.SequentialWriter(_info(name, temporary, first), max_examples_per_shard=100)
        writer.initialize_splits(["train"])
        for number in tqdm(range(len(demonstrations)), "rlds", unit="episode", disable=None):
            found = observations(number, *arguments)
            episode = list(steps(demonstrations[number], found, core.instruction))
            writer.add_examples({"train": [{"steps": episode}]})
        writer.close_all()
    return folder


def steps(
    episode: Episode, observations: Iterator[dict[str, NDArray[Any]]], instruction: str
) -> Iterator[dict[str, Any]]:
    """Yield the n + 1 steps of an episode of n actions."""
    nothing = np.zeros_like(episode.actions[:1])
    actions, rewards = np.concatenate([episode.actions, nothing]), np.append(episode.rewards, 0.0)
    for step, observation in enumerate(observations):
        is_last = step == len(episode)
        yield {
            "observation": {short_name(name): value for name, value in observation.items()},
            "action": actions[step],
            "reward": np.float32(rewards[step]),
            "discount": np.float32(step + 1 < len(episode)),
            "is_first": step == 0,
            "is_last": is_last,
            "is_terminal": is_last,  # all episodes are successful
            "language_instruction": instruction,
        }


def _info(name: str, folder: Path, step: Mapping[str, Any]) -> "DatasetInfo":
    """Return the description of the dataset; ``step`` has the types and shapes of all steps."""
    import tensorflow_datasets as tfds
    from tensorflow_datasets.rlds import rlds_base

    tensor, scalar = tfds.features.Tensor, tfds.features.Scalar(dtype=np.float32)
    config = rlds_base.DatasetConfig(
        name=name,
        observation_info=tfds.features.FeaturesDict(
            {
                key: tfds.features.Image(shape=value.shape)
                if value.dtype == np.uint8 and value.shape[2:] == (3,)
                else tensor(shape=value.shape, dtype=value.dtype, encoding="zlib")
                for key, value in step["observation"].items()
            }
        ),
        action_info=tensor(shape=step["action"].shape, dtype=np.float32),
        reward_info=scalar,
        discount_info=scalar,
        step_metadata_info={"language_instruction": tfds.features.Text()},
    )
    version = tfds.core.Version("1.0.0")
    identity = tfds.core.DatasetIdentity(name, version, str(folder), module_name=__name__)
    return rlds_base.build_info(config, identity)
