"""Demonstrations as datasets of Minari and LeRobot."""

import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from bulletarm_gym.demonstrations.collecting import is_silent
from bulletarm_gym.demonstrations.episodes import Demonstrations, Episode, atomic_path
from bulletarm_gym.demonstrations.replaying import replay
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.observations import Holding, Rgb, Sensor, State, View
from bulletarm_gym.observations.state import GRIPPER_SIZE

if TYPE_CHECKING:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from minari import MinariDataset

CAMERAS: Mapping[str, Mapping[str, Any]] = {"front": {"size": 240}}
"""Default cameras, by name: parameters of the sensor ``rgb``."""
GRIPPER = ("opening", "x", "y", "z", "cos_yaw", "sin_yaw", "holding")
POSE = ("present", "x", "y", "z", "qx", "qy", "qz", "qw")
IMAGE_AXES = ("height", "width", "channels")
"""Axes of images. LeRobot computes one statistic for each index of the last axis, so channels come last."""
COLOURS = 3
"""Number of channels of color images."""
ANGLES = ("theta", "phi", "psi")
"""Names of three r's in an action sequence."""


def export_minari(demonstrations: Demonstrations, dataset_id: str, **metadata: Any) -> "MinariDataset":
    """Store demonstrations as a dataset of Minari.

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
    buffers = [
        EpisodeBuffer(id=number, **{name: getattr(episode, name) for name in names})
        for number, episode in enumerate(demonstrations)
    ]
    with closing(demonstrations.make_env()) as env:
        return minari.create_dataset_from_buffers(
            dataset_id, buffers, env=env, **{"algorithm_name": demonstrations.about["planner"], **metadata}
        )


class Feature(NamedTuple):
    """Column of a LeRobot dataset.

    :param dtype: LeRobot's name of the type
    :param shape: shape of a frame's value
    :param names: names of the axes or of the numbers
    :param read: function that returns the value from the view, the recorded episode and the step
    """

    dtype: str
    shape: tuple[int, ...]
    names: tuple[str, ...] | None
    read: Callable[[View, Episode, int], NDArray[Any]]


def export_lerobot(
    demonstrations: Demonstrations,
    repo_id: str,
    root: str | os.PathLike[str] | None = None,
    *,
    cameras: Mapping[str, Mapping[str, Any]] = CAMERAS,
    object_poses: bool = False,
    task: str | None = None,
    fps: int | None = None,
    progress: bool | None = None,
) -> "LeRobotDataset":
    """Store demonstrations as a dataset of LeRobot, in its format v3.0, with PNG images.

    The episodes are replayed for images and poses. Each action has a frame with the observation before it:

    - ``observation.images.<camera>``: RGB image, (size, size, 3) uint8
    - ``observation.state``: the gripper's opening ratio, position (m), cosine and sine of its yaw, and
    whether it
      holds an object, (7,)
    - ``observation.environment_state``, with ``object_poses=True``: for each object 1 if it is present,
    position
      (m), quaternion, and the positions (m or rad) of its sliding and hinged parts
    - ``observation.<name>``: the recorded observation, such as ``heightmap`` in metres, (obs_size, obs_size,
    1),
      channels last; color images are ``observation.images.<name>``
    - ``action``: (n,), named by the characters of ``action_sequence``
    - ``next.reward``, ``next.done``, ``next.success``: result of the action, (1,)

    LeRobot loads ``observation.images.*`` as (3, size, size) and features of shape (1,) as scalars.

    :param repo_id: name such as ``"someone/block-picking"``
    :param root: folder, by default that of LeRobot's datasets; written atomically
    :param cameras: parameters of the sensor ``rgb``, by the names of cameras
    :param object_poses: export the poses of the objects, which LeRobot's policies use as an observation
    :param task: description of the task, by default ``task_description``
    :param fps: frames per second, by default ``render_fps``
    :param progress: show a progress bar, by default on a terminal
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
    with closing(unwrapped_env(demonstrations)) as env, atomic_folder(target) as temporary, _without_bars():
        features = make_features(env, demonstrations[0], cameras, object_poses)
        dataset = LeRobotDataset.create(
            repo_id,
            fps=env.metadata["render_fps"] if fps is None else fps,
            features={
                name: {"dtype": one.dtype, "shape": one.shape, "names": one.names and list(one.names)}
                for name, one in features.items()
            },
            root=temporary,
            robot_type=env.config.robot,
            use_videos=False,
        )
        words = env.task_description if task is None else task
        numbers = tqdm(range(len(demonstrations)), "lerobot", unit="episode", disable=is_silent(progress))
        try:
            for number in numbers:
                for frame in frames(demonstrations, number, env, features):
                    dataset.add_frame({**frame, "task": words})
                dataset.save_episode()
        finally:
            dataset.finalize()  # else it writes when it is collected as garbage
    return LeRobotDataset(repo_id, root=target)


def unwrapped_env(demonstrations: Demonstrations) -> ManipulationEnv:
    """Make the environment without wrappers, so that its state can be set before a reset."""
    env: ManipulationEnv = demonstrations.make_env().unwrapped  # type: ignore[assignment]
    return env


def frames(
    demonstrations: Demonstrations, number: int, env: ManipulationEnv, features: Mapping[str, Feature]
) -> Iterator[dict[str, NDArray[Any]]]:
    """Replay an episode, and yield a frame before each action."""
    episode = demonstrations[number]
    for step in replay(demonstrations, number, env):
        if step < len(episode):
            view = env.look()
            yield {name: feature.read(view, episode, step) for name, feature in features.items()}


def make_features(
    env: ManipulationEnv,
    episode: Episode,
    cameras: Mapping[str, Mapping[str, Any]],
    object_poses: bool = False,
) -> dict[str, Feature]:
    """Return the columns of the dataset, by name.

    :param episode: any episode, as an example
    :raises ValueError: the parameters of a camera are invalid, or two columns have the same name
    """
    states = [name for name, source, _ in env.config.sensors if source == "state"]
    found = [
        *(_camera(env, name, parameters) for name, parameters in cameras.items()),
        *_poses(env, object_poses),
        *(_recorded(name, values) for name, values in episode.observations.items() if name not in states),
        *_outcomes(env, episode),
    ]
    names = [name for name, _ in found]
    if taken := {name for name in names if names.count(name) > 1}:
        raise ValueError(f"cameras must have other names, got two features {', '.join(sorted(taken))}")
    return dict(found)


def _camera(env: ManipulationEnv, name: str, parameters: Mapping[str, Any]) -> tuple[str, Feature]:
    try:
        camera: Sensor = Rgb(env.scene, **parameters)
    except (TypeError, ValueError) as error:
        raise ValueError(f"cameras: {name}: {error}") from error
    shape = (*camera.space.shape[1:], camera.space.shape[0])
    return f"observation.images.{name}", Feature(
        "image", shape, IMAGE_AXES, lambda view, *_: np.moveaxis(camera.read(view), 0, -1)
    )


def _poses(env: ManipulationEnv, object_poses: bool) -> list[tuple[str, Feature]]:
    """Return the state of the gripper and, if required, the poses of the objects."""
    state, holding = State(env.scene), Holding(env.scene)

    def read_gripper(view: View, *_: Any) -> NDArray[Any]:
        return np.concatenate([state.read(view)[:GRIPPER_SIZE], holding.read(view)])

    gripper = Feature("float32", (len(GRIPPER),), GRIPPER, read_gripper)
    parts = [
        f"{item.slot.name}.{part}"
        for item in env.scene.objects
        for part in (*POSE, *(f"joint_{number}" for number in range(len(item.spec.parts))))
    ]
    objects = Feature(
        "float32", (len(parts),), tuple(parts), lambda view, *_: state.read(view)[GRIPPER_SIZE:]
    )
    found = [("observation.state", gripper), ("observation.environment_state", objects)]
    return found if parts and object_poses else found[:1]


def _recorded(name: str, values: NDArray[Any]) -> tuple[str, Feature]:
    shape = values.shape[1:]
    is_image = len(shape) == len(IMAGE_AXES)
    is_color = is_image and values.dtype == np.uint8 and shape[0] == COLOURS
    shape = (*shape[1:], shape[0]) if is_image else shape

    def read(_: View, episode: Episode, step: int) -> NDArray[Any]:
        value = episode.observations[name][step]
        return np.moveaxis(value, 0, -1) if is_image else value

    dtype = "image" if is_color else str(values.dtype)
    feature = Feature(dtype, shape, IMAGE_AXES if is_image else None, read)
    return f"observation.images.{name}" if is_color else f"observation.{name}", feature


def _outcomes(env: ManipulationEnv, episode: Episode) -> list[tuple[str, Feature]]:
    """Return the action and its results; all episodes are successful."""
    angles = iter(ANGLES if env.action_sequence.count("r") == len(ANGLES) else "r")
    names = tuple(next(angles) if character == "r" else character for character in env.action_sequence)
    shape = episode.actions.shape[1:]
    actions = Feature("float32", shape, names, lambda _, episode, step: episode.actions[step])
    reward = Feature("float32", (1,), None, lambda _, episode, step: episode.rewards[step, None])
    end = Feature("bool", (1,), None, lambda _, episode, step: np.array([step + 1 == len(episode)]))
    return [("action", actions), ("next.reward", reward), ("next.done", end), ("next.success", end)]


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary path for a new folder, which becomes ``path`` if the block succeeds.

    :raises FileExistsError: ``path`` exists
    """
    if path.exists():
        raise FileExistsError(f"root must be a new folder, got {path}, which exists")
    with atomic_path(path, discard=partial(shutil.rmtree, ignore_errors=True)) as temporary:
        yield temporary


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
