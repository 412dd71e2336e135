"""Demonstrations as datasets of LeRobot."""

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

from bulletarm_gym.demonstrations.episodes import Demonstrations, Episode, whole_file
from bulletarm_gym.demonstrations.replaying import replay
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.observations import Holding, Rgb, Sensor, State, View
from bulletarm_gym.observations.state import GRIPPER_SIZE

if TYPE_CHECKING:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

CAMERAS: Mapping[str, Mapping[str, Any]] = {"front": {"size": 240}}
"""What pictures are taken with unless told."""
GRIPPER = ("opening", "x", "y", "z", "cos_yaw", "sin_yaw", "holding")
POSE = ("present", "x", "y", "z", "qx", "qy", "qz", "qw")
IMAGE_AXES = ("height", "width", "channels")
"""Axes of images. LeRobot computes one statistic for each index of the last axis, so channels come last."""
COLOURS = 3
TILTING = ("theta", "phi", "psi")
"""What three r's of an action are: turns about z, y and x."""


class Moment(NamedTuple):
    """A frame to be.

    :param view: what is to be seen
    :param episode: what was recorded
    :param step: the action that comes next
    """

    view: View
    episode: Episode
    step: int


class Feature(NamedTuple):
    """A column of the dataset.

    :param dtype: as LeRobot names it
    :param shape: of a frame's value
    :param names: of its axes, or of its numbers
    :param read: returns the value
    """

    dtype: str
    shape: tuple[int, ...]
    names: tuple[str, ...] | None
    read: Callable[[Moment], NDArray[Any]]


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
    """Store demonstrations as a dataset of LeRobot, in its format v3.0, pictures as PNG.

    Episodes are repeated from their first states; pictures are taken and poses read as they go. There is a
    frame an action, with what was seen before it:

    - ``observation.images.<camera>``: red, green and blue, (size, size, 3) uint8
    - ``observation.state``: the gripper's opening ratio, position (m), cosine and sine of its yaw, and
      whether it holds something, (7,)
    - ``observation.environment_state``, with ``object_poses=True``: for each item 1 if it is present,
      position (m), quaternion, and the positions (m or rad) of its sliding and hinged parts
    - ``observation.<name>``: the recorded observation, such as ``heightmap`` in metres, (obs_size, obs_size,
      1), channels last; color images are ``observation.images.<name>``
    - ``action``: (n,), named by the characters of ``action_sequence``
    - ``next.reward``, ``next.done``, ``next.success``: the outcome of the action, (1,)

    LeRobot loads ``observation.images.*`` as (3, size, size) and features of shape (1,) as scalars.

    :param repo_id: such as ``"someone/block-picking"``
    :param root: its folder, by default among LeRobot's own datasets; written whole or not at all
    :param cameras: parameters of the sensor ``rgb``, by the names of cameras
    :param object_poses: export the poses of the objects. LeRobot's policies use them as an observation
    :param task: what is done, in words; by default ``task_description``
    :param fps: frames a second; by default ``render_fps``, for environments step and keep no time
    :param progress: show a progress bar; by default on a terminal
    :return: the dataset, as LeRobot loads it
    :raises FileExistsError: ``root`` is there already
    :raises ImportError: LeRobot is not installed
    :raises ReplayError: an episode does not go as it was recorded
    :raises ValueError: a camera cannot be had so, or two features would have one name
    """
    try:
        from lerobot.datasets.lerobot_dataset import LeRobotDataset
        from lerobot.utils.constants import HF_LEROBOT_HOME
    except ImportError as error:
        raise ImportError(f"LeRobot is missing ({error}): pip install 'bulletarm-gym[lerobot]'") from error
    target = Path(HF_LEROBOT_HOME) / repo_id if root is None else Path(root)
    with closing(inner(demonstrations)) as env, whole_folder(target) as temporary, _without_bars():
        features = make_features(env, demonstrations[0], cameras, object_poses)
        dataset = LeRobotDataset.create(
            repo_id,
            fps=env.metadata["render_fps"] if fps is None else fps,
            features={name: _described(feature) for name, feature in features.items()},
            root=temporary,
            robot_type=env.config.robot,
            use_videos=False,
        )
        words = env.task_description if task is None else task
        silent = None if progress is None else not progress
        try:
            for number in tqdm(range(len(demonstrations)), "lerobot", unit="episode", disable=silent):
                for frame in frames(demonstrations, number, env, features):
                    dataset.add_frame({**frame, "task": words})
                dataset.save_episode()
        finally:
            dataset.finalize()  # else it writes when it is collected as garbage
    return LeRobotDataset(repo_id, root=target)


def inner(demonstrations: Demonstrations) -> ManipulationEnv:
    """Make the environment itself, whose state can be set without a reset."""
    env: ManipulationEnv = demonstrations.make_env().unwrapped  # type: ignore[assignment]
    return env


def frames(
    demonstrations: Demonstrations, number: int, env: ManipulationEnv, features: Mapping[str, Feature]
) -> Iterator[dict[str, NDArray[Any]]]:
    """Repeat an episode, and yield a frame before each action."""
    episode = demonstrations[number]
    for step in replay(demonstrations, number, env):
        if step < len(episode):
            moment = Moment(env.look(), episode, step)
            yield {name: feature.read(moment) for name, feature in features.items()}


def make_features(
    env: ManipulationEnv,
    episode: Episode,
    cameras: Mapping[str, Mapping[str, Any]],
    object_poses: bool = False,
) -> dict[str, Feature]:
    """Return the columns of the dataset, by name.

    :param episode: any, as an example
    :raises ValueError: a camera cannot be had so, or two columns would have one name
    """
    found = [
        *(_camera(env, name, parameters) for name, parameters in cameras.items()),
        *_poses(env, object_poses),
        *(
            _recorded(name, values)
            for name, values in episode.observations.items()
            if not _is_state(env, name)
        ),
        *_outcomes(env, episode),
    ]
    names = [name for name, _ in found]
    if taken := {name for name in names if names.count(name) > 1}:
        raise ValueError(f"cameras: two features would be called {', '.join(sorted(taken))}")
    return dict(found)


def _camera(env: ManipulationEnv, name: str, parameters: Mapping[str, Any]) -> tuple[str, Feature]:
    try:
        camera: Sensor = Rgb(env.scene, **parameters)
    except (TypeError, ValueError) as error:
        raise ValueError(f"cameras: {name}: {error}") from error
    shape = (*camera.space.shape[1:], camera.space.shape[0])
    return f"observation.images.{name}", Feature(
        "image", shape, IMAGE_AXES, lambda moment: np.moveaxis(camera.read(moment.view), 0, -1)
    )


def _poses(env: ManipulationEnv, object_poses: bool) -> list[tuple[str, Feature]]:
    """Return the state of the gripper and, if required, the poses of the objects."""
    state, holding = State(env.scene), Holding(env.scene)

    def read_gripper(moment: Moment) -> NDArray[Any]:
        return np.concatenate([state.read(moment.view)[:GRIPPER_SIZE], holding.read(moment.view)])

    def read_items(moment: Moment) -> NDArray[Any]:
        return state.read(moment.view)[GRIPPER_SIZE:]

    gripper = Feature("float32", (len(GRIPPER),), GRIPPER, read_gripper)
    parts = [
        f"{item.slot.name}.{part}"
        for item in env.scene.objects
        for part in (*POSE, *(f"joint_{number}" for number in range(len(item.spec.parts))))
    ]
    items = Feature("float32", (len(parts),), tuple(parts), read_items)
    found = [("observation.state", gripper), ("observation.environment_state", items)]
    return found if parts and object_poses else found[:1]


def _is_state(env: ManipulationEnv, name: str) -> bool:
    """Return True if an observation is that of the sensor ``state``, which contains the poses of objects."""
    return any((name, "state") == (known, source) for known, source, _ in env.config.sensors)


def _recorded(name: str, values: NDArray[Any]) -> tuple[str, Feature]:
    shape = values.shape[1:]
    is_image = len(shape) == len(IMAGE_AXES)
    is_picture = is_image and values.dtype == np.uint8 and shape[0] == COLOURS
    shape = (*shape[1:], shape[0]) if is_image else shape

    def read(moment: Moment) -> NDArray[Any]:
        value = moment.episode.observations[name][moment.step]
        return np.moveaxis(value, 0, -1) if is_image else value

    dtype = "image" if is_picture else str(values.dtype)
    feature = Feature(dtype, shape, IMAGE_AXES if is_image else None, read)
    return f"observation.images.{name}" if is_picture else f"observation.{name}", feature


def _outcomes(env: ManipulationEnv, episode: Episode) -> list[tuple[str, Feature]]:
    """Return the action, and what comes of it: only episodes that succeed are kept."""
    actions = Feature(
        "float32",
        episode.actions.shape[1:],
        _names(env.action_sequence),
        lambda moment: moment.episode.actions[moment.step],
    )
    reward = Feature("float32", (1,), None, lambda moment: moment.episode.rewards[moment.step, None])
    end = Feature("bool", (1,), None, lambda moment: np.array([moment.step + 1 == len(moment.episode)]))
    return [("action", actions), ("next.reward", reward), ("next.done", end), ("next.success", end)]


def _names(sequence: str) -> tuple[str, ...]:
    """Return a name for each number of an action, no two alike."""
    turns = iter(TILTING if sequence.count("r") == len(TILTING) else "r")
    return tuple(next(turns) if character == "r" else character for character in sequence)


def _described(feature: Feature) -> dict[str, Any]:
    """Return a feature as LeRobot wants it."""
    names = None if feature.names is None else list(feature.names)
    return {"dtype": feature.dtype, "shape": feature.shape, "names": names}


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """Give a path for a new folder, which takes the place of ``path`` if the block succeeds, and else goes.

    :raises FileExistsError: ``path`` is there already
    """
    if path.exists():
        raise FileExistsError(f"root: {path} is there already")
    with whole_file(path, discard=partial(shutil.rmtree, ignore_errors=True)) as temporary:
        yield temporary


@contextmanager
def _without_bars() -> Iterator[None]:
    """Keep ``datasets`` from a progress bar an episode."""
    from datasets.utils import are_progress_bars_disabled, disable_progress_bars, enable_progress_bars

    were_disabled = are_progress_bars_disabled()
    disable_progress_bars()
    try:
        yield
    finally:
        if not were_disabled:
            enable_progress_bars()
