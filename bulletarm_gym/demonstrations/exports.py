"""Demonstrations as datasets of Minari and LeRobot."""

import os
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from bulletarm_gym.config_checks import check_argument, mapping, rule
from bulletarm_gym.control.open_loop import ANGLES
from bulletarm_gym.demonstrations.episodes import Demonstrations, Episode, atomic_path, replay
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.observations import Rgb, Sensor, State
from bulletarm_gym.observations.sensor import GRIPPER_SIZE

if TYPE_CHECKING:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from minari import MinariDataset

CAMERAS: Mapping[str, Mapping[str, Any]] = {"front": {"size": 240}}
"""Default cameras, by name: parameters of the sensor ``rgb``."""
IMAGES = "observation.images."
"""Beginning of the names of color images."""
GRIPPER = ("opening", "x", "y", "z", "cos_yaw", "sin_yaw", "holding")
POSE = ("present", "x", "y", "z", "qx", "qy", "qz", "qw")


def exported_env(demonstrations: Demonstrations) -> closing[gymnasium.Env[Any, Any]]:
    """Return a context with the environment of demonstrations to export.

    :raises ValueError: there is no episode, or it is something else than demonstrations
    """
    must, kind = "Demonstrations with at least one episode", Demonstrations
    check = rule(must, lambda value: isinstance(value, kind) and len(value) > 0)
    return closing(check_argument("demonstrations", demonstrations, check).make_env())


def export_minari(demonstrations: Demonstrations, dataset_id: str, **metadata: Any) -> "MinariDataset":
    """Store demonstrations as a dataset of Minari; its metadata has the instruction as ``task``.

    :param dataset_id: id such as ``"bulletarm/block-picking/expert-v0"``
    :param metadata: arguments of ``minari.create_dataset_from_buffers()``, such as ``author``
    :raises ImportError: Minari is not installed
    """
    try:
        import minari
        from minari.data_collector import EpisodeBuffer
    except ImportError as error:
        raise ImportError("Minari is missing: pip install 'bulletarm-gym[minari]'") from error
    names = ("observations", "actions", "rewards", "terminations", "truncations", "seed")
    with exported_env(demonstrations) as env:
        buffers = [
            EpisodeBuffer(id=number, **{name: getattr(episode, name) for name in names})
            for number, episode in enumerate(demonstrations)
        ]
        dataset = minari.create_dataset_from_buffers(
            dataset_id, buffers, env=env, **{"algorithm_name": demonstrations.about["planner"], **metadata}
        )
        dataset.storage.update_metadata({"task": env.get_wrapper_attr("instruction")})
        return dataset


def export_lerobot(
    demonstrations: Demonstrations,
    repo_id: str,
    root: str | os.PathLike[str] | None = None,
    *,
    cameras: Mapping[str, Mapping[str, Any]] = CAMERAS,
    object_poses: bool = False,
    heightmaps: bool = False,
    task: str | None = None,
    fps: int | None = None,
) -> "LeRobotDataset":
    """Store demonstrations as a dataset of LeRobot, in its format v3.0, with PNG images.

    The episodes are replayed for images and poses. Each action has a frame with the observation before it:

    - ``observation.images.<camera>``: RGB image, (size, size, 3) uint8
    - ``observation.state``: the gripper's opening ratio, position (m), cosine and sine of its yaw, and
      whether it holds an object, (7,)
    - ``observation.environment_state``, with ``object_poses=True``: for each object 1 if it is present,
      position (m), quaternion, and the positions (m or rad) of its sliding and hinged parts
    - ``observation.images.<name>``, ``observation.<name>``: recorded color images and vectors
    - ``observation.<name>``, with ``heightmaps=True``: other recorded images, such as ``heightmap`` in
      metres, (obs_size, obs_size, 1), channels last
    - ``action``: (n,), named by the characters of ``action_sequence``
    - ``next.reward``, ``next.done``, ``next.success``: result of the action, (1,)

    LeRobot loads ``observation.images.*`` as (3, size, size) and features of shape (1,) as scalars.

    :param repo_id: name such as ``"someone/block-picking"``
    :param root: folder, by default that of LeRobot's datasets; written atomically
    :param cameras: parameters of the sensor ``rgb``, by the names of cameras
    :param object_poses: export the poses of the objects, which LeRobot's policies use as an observation
    :param heightmaps: export recorded images that are not color images. LeRobot's policies do not use them,
        and its loader converts them for each action of a chunk
    :param task: description of the task, by default the environment's ``instruction``
    :param fps: frames per second, by default ``render_fps``
    :return: the dataset
    :raises FileExistsError: ``root`` exists
    :raises ImportError: LeRobot is not installed
    :raises ReplayError: a replayed episode differs from the recorded one
    :raises ValueError: the parameters of a camera are invalid, or two features have the same name
    """
    try:
        from lerobot.datasets.lerobot_dataset import LeRobotDataset
        from lerobot.utils.constants import HF_LEROBOT_HOME
    except ImportError as error:
        raise ImportError(f"LeRobot is missing ({error}): pip install 'bulletarm-gym[lerobot]'") from error
    target = Path(HF_LEROBOT_HOME) / repo_id if root is None else Path(root)
    if target.exists():
        raise FileExistsError(f"root must be a new folder, got {target}, which exists")
    with exported_env(demonstrations) as env, atomic_path(target) as temporary, _without_bars():
        core: ManipulationEnv = env.unwrapped  # type: ignore[assignment]

        def exported(number: int) -> Iterator[dict[str, NDArray[Any]]]:
            found = observations(number, demonstrations, core, cameras, object_poses)
            for frame in frames(demonstrations[number], found):
                yield {
                    name: values
                    for name, values in frame.items()
                    if heightmaps or values.ndim < 3 or name.startswith(IMAGES)
                }

        dataset = LeRobotDataset.create(
            repo_id,
            fps=core.metadata["render_fps"] if fps is None else fps,
            features=features(core, next(exported(0))),
            root=temporary,
            robot_type=core.config.robot,
            use_videos=False,
        )
        words = core.instruction if task is None else task
        try:
            for number in tqdm(range(len(demonstrations)), "lerobot", unit="episode", disable=None):
                for frame in exported(number):
                    dataset.add_frame({**frame, "task": words})
                dataset.save_episode()
        finally:
            dataset.finalize()  # else it writes when it is collected as garbage
    return LeRobotDataset(repo_id, root=target)


def frames(
    episode: Episode, observations: Iterator[dict[str, NDArray[Any]]]
) -> Iterator[dict[str, NDArray[Any]]]:
    """Yield the values of a frame for each action of an episode, by the names of features.

    :param observations: the n + 1 observations of :func:`observations`
    """
    for step, observation in zip(range(len(episode)), observations, strict=False):
        end = np.array([step + 1 == len(episode)])  # all episodes are successful
        outcomes = {"next.reward": episode.rewards[step, None], "next.done": end, "next.success": end}
        yield {**observation, "action": episode.actions[step], **outcomes}


def observations(
    number: int,
    demonstrations: Demonstrations,
    env: ManipulationEnv,
    cameras: Mapping[str, Mapping[str, Any]] = CAMERAS,
    object_poses: bool = False,
) -> Iterator[dict[str, NDArray[Any]]]:
    """Replay an episode of n actions, and yield its n + 1 observations, by the names of features.

    :param number: number of the episode
    :param env: environment with the same parameters
    :raises ValueError: the parameters of a camera are invalid, or two features have the same name
    """
    episode, state = demonstrations[number], State(env.scene)
    sensors: dict[str, Sensor] = {}
    check_argument("cameras", cameras, mapping)
    for name, parameters in cameras.items():
        try:
            sensors[name] = Rgb(env.scene, **parameters)
        except (TypeError, ValueError) as error:
            raise ValueError(f"cameras: {name}: {error}") from error
    states = [name for name, source, _ in env.config.sensors if source == "state"]
    for step in replay(demonstrations, number, env):
        view = env.look()
        poses = state.read(view)
        gripper = np.append(poses[:GRIPPER_SIZE], np.float32(view.is_holding))
        found = [
            *((IMAGES + name, np.moveaxis(sensor.read(view), 0, -1)) for name, sensor in sensors.items()),
            ("observation.state", gripper),
            *([("observation.environment_state", poses[GRIPPER_SIZE:])] if object_poses else []),
            *(_recorded(name, v[step]) for name, v in episode.observations.items() if name not in states),
        ]
        names = [name for name, _ in found]
        if taken := {name for name in names if names.count(name) > 1}:
            raise ValueError(f"cameras must have other names, got two features {', '.join(sorted(taken))}")
        yield dict(found)


def short_name(name: str) -> str:
    """Return the name of an observation in the files of robomimic and RLDS, such as ``front_image``."""
    return f"{name[len(IMAGES) :]}_image" if name.startswith(IMAGES) else name.split(".", 1)[1]


def features(env: ManipulationEnv, frame: Mapping[str, NDArray[Any]]) -> dict[str, dict[str, Any]]:
    """Return type, shape and names of the axes or numbers of each value of a frame, as LeRobot expects.

    LeRobot computes one statistic for each index of the last axis, so the channels of images come last.
    """
    angles = iter(ANGLES if env.action_sequence.count("r") == len(ANGLES) else "r")
    known = {
        "action": [next(angles) if name == "r" else name for name in env.action_sequence],
        "observation.state": list(GRIPPER),
        "observation.environment_state": [
            f"{item.slot.name}.{part}"
            for item in env.scene.all_objects
            for part in (*POSE, *(f"joint_{number}" for number in range(len(item.spec.parts))))
        ],
    }
    return {
        name: {
            "dtype": "image" if name.startswith(IMAGES) else str(values.dtype),
            "shape": values.shape,
            "names": ["height", "width", "channels"] if values.ndim == 3 else known.get(name),
        }
        for name, values in frame.items()
    }


def _recorded(name: str, values: NDArray[Any]) -> tuple[str, NDArray[Any]]:
    is_image = values.ndim == 3
    is_color = is_image and values.dtype == np.uint8 and len(values) == 3
    prefix = IMAGES if is_color else "observation."
    return prefix + name, np.moveaxis(values, 0, -1) if is_image else values


@contextmanager
def _without_bars() -> Iterator[None]:
    """Disable the progress bars of ``datasets``."""
    from datasets.utils import are_progress_bars_disabled, disable_progress_bars, enable_progress_bars

    were_disabled = are_progress_bars_disabled()
    disable_progress_bars()
    try:
        yield
    finally:
        if not were_disabled:
            enable_progress_bars()
