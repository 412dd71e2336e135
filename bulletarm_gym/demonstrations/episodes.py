"""Episodes, the HDF5 files that hold them, and their replay.

A file holds, compressed, ``episodes/0``, ``episodes/1``, ... Each has ``observations`` (n + 1 for each key),
``actions``, ``rewards``, ``terminations``, ``truncations``, the ``seed`` of its reset if it had one, and as
JSON the ``initial_state`` (see :mod:`~bulletarm_gym.demonstrations.json_state`), the ``configuration`` of its
environment and the ``versions`` of libraries. Heights are counts of 0.1 mm. HDF5's user block holds a
checksum of the content.
"""

import io
import json
import os
import platform
import shutil
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any, overload

import gymnasium
import h5py
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bulletarm_gym.config_checks import check_argument, instance
from bulletarm_gym.demonstrations import json_state
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.registry import register
from bulletarm_gym.scene.state import EnvState

FORMAT = 1
"""Version of the file format."""
HEIGHT = 1e-4
"""Length (m) of a count of stored heights."""
HEIGHTS = ("heightmap", "in_hand")
"""Observations in metres."""
TOLERANCE = HEIGHT / 2.0 + 1e-6
"""Maximum error (m) of a stored height: half a count, and rounding to float32."""
STEPS = ("actions", "rewards", "terminations", "truncations")
LIBRARIES = ("bulletarm-gym", "gymnasium", "h5py", "numba", "numpy", "pybullet")
USER_BLOCK = 512
"""Size (bytes) of HDF5's user block, before its content."""
MAGIC = b"bulletarm-gym demonstrations"
PACKED = {"compression": "gzip", "compression_opts": 4, "shuffle": True}

Step = tuple[NDArray[np.float32], float, bool, bool]
"""Action, reward, termination and truncation of a step."""


@dataclass(frozen=True)
class Episode:
    """Episode of n steps, with Minari's names.

    :param observations: (n + 1, ...) for each key
    :param actions: (n, action dimensions)
    :param rewards: (n,)
    :param terminations: (n,)
    :param truncations: (n,)
    :param seed: seed of its reset; None if it had none or began at a state
    :param initial_state: as JSON
    """

    observations: dict[str, NDArray[Any]]
    actions: NDArray[np.float32]
    rewards: NDArray[np.float32]
    terminations: NDArray[np.bool_]
    truncations: NDArray[np.bool_]
    seed: int | None
    initial_state: str

    def __len__(self) -> int:
        return len(self.actions)

    @cached_property
    def state(self) -> EnvState:
        """State before the first action, for an environment's ``set_state()``."""
        state: EnvState = json_state.loads(self.initial_state)
        return state

    @classmethod
    def of(
        cls,
        observations: Sequence[Mapping[str, NDArray[Any]]],
        steps: Sequence[Step],
        seed: int | None,
        initial_state: str,
    ) -> "Episode":
        """Return the episode of n + 1 observations and n steps."""
        stacked = {key: np.stack([entry[key] for entry in observations]) for key in observations[0]}
        actions, rewards, terminations, truncations = map(np.array, zip(*steps, strict=True))
        rewards = rewards.astype(np.float32)
        return cls(stacked, actions, rewards, terminations, truncations, seed, initial_state)


class Demonstrations(Sequence[Episode]):
    """Episodes of one environment, in the format of a file; each is decompressed when it is read.

    :param image: content of the file
    :param name: name of the file, for errors
    :param object_set: folder of the objects, if it has moved since they were recorded
    :raises ValueError: the file is of another kind or damaged
    """

    def __init__(
        self, image: bytes, name: str = "demonstrations", object_set: str | os.PathLike[str] | None = None
    ) -> None:
        self.image = check_argument("image", image, instance(bytes))
        self._changed = {} if object_set is None else {"object_set": os.path.abspath(object_set)}
        if not image.startswith(MAGIC):
            raise ValueError(f"{name}: not a file of demonstrations")
        if image[:USER_BLOCK] != _user_block(image[USER_BLOCK:]):
            raise ValueError(f"{name}: a file of demonstrations, but damaged: its checksum is wrong")
        with self._file() as file:
            self.about: dict[str, Any] = json.loads(file["about"][()])
            self.attempts = int(file["attempts"][()])
            """Number of episodes that were begun to collect these."""
            self._count = len(file["episodes"])
        if self.about["format"] != FORMAT:
            raise ValueError(f"{name}: the format must be {FORMAT}, got {self.about['format']}")
        self.env_id: str = self.about["env_id"]
        """Id of the environment."""
        self.action_sequence: str = self.about["configuration"]["action_sequence"]
        """Meaning of each number of an action, one character each."""
        self.action_space = spaces.Box(-1.0, 1.0, (len(self.action_sequence),), np.float32)
        """Action space of the environment."""
        self.action_ranges = {n: (low, high) for n, (low, high) in self.about["action_ranges"].items()}
        """Values (m, rad) of -1 and 1 in an action, by name."""

    @property
    def parameters(self) -> dict[str, Any]:
        """Parameters of the environment, with its control and surface, by name."""
        components = {name: self.about["recipe"][name] for name in ("control", "surface")}
        return {**components, **self.about["configuration"], **self._changed}

    def make_env(self, **parameters: Any) -> gymnasium.Env[Any, Any]:
        """Make the environment of the episodes; the module of a user's task is imported.

        :param parameters: parameters with other values
        :raises ValueError: the folder of the objects does not exist
        """
        if self.env_id not in gymnasium.registry:
            register(self.env_id, self.about["recipe"])
        return gymnasium.make(self.env_id, **{**self.parameters, **parameters})

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the file atomically; its folder is made."""
        with atomic_path(Path(path)) as temporary:
            temporary.write_bytes(self.image)

    def __len__(self) -> int:
        return self._count

    def __repr__(self) -> str:
        return f"<Demonstrations: {len(self)} episodes of {self.env_id}>"

    @overload
    def __getitem__(self, index: int) -> Episode: ...
    @overload
    def __getitem__(self, index: slice | Sequence[int] | NDArray[Any]) -> "Demonstrations": ...

    def __getitem__(self, index: int | slice | Sequence[int] | NDArray[Any]) -> "Episode | Demonstrations":
        """Return an episode, or the demonstrations of a slice, of a list of numbers or of a mask.

        The ``attempts`` of a part are its episodes.

        :raises IndexError: the index is not one of NumPy for a one-dimensional array
        """
        chosen = np.arange(self._count)[index]
        if np.ndim(chosen) > 1:
            raise IndexError(f"index must be an integer, a slice or a list of integers, got {index!r}")
        with self._file() as file:
            if np.ndim(chosen) == 0:
                return _read(file["episodes"][str(chosen)])
            recorder = Recorder(self.about)
            for number in chosen:
                recorder.copy(file["episodes"][str(number)])
        part = recorder.finish()
        part._changed = self._changed
        return part

    def _file(self) -> h5py.File:
        return h5py.File(io.BytesIO(self.image), "r")


class Recorder:
    """Writer of the content of a file, in memory.

    :param about: description of the environment and of the collection, which an existing file has already
    :param image: content of an existing file, to which episodes are added
    """

    def __init__(self, about: Mapping[str, Any], image: bytes | None = None) -> None:
        self._versions = json.dumps(versions())
        self._buffer = io.BytesIO(image or b"")
        if image is not None:
            self._file = h5py.File(self._buffer, "r+")
        else:
            self._file = h5py.File(self._buffer, "w", userblock_size=USER_BLOCK)
            about = {"format": FORMAT, "versions": versions(), **about}
            self._file.create_group("episodes")
            self._file["attempts"] = 0
            self._file["about"] = json.dumps(about)
            for name in ("configuration", "versions"):
                self._file[name] = json.dumps(about[name])
        self._episodes = self._file["episodes"]
        self.attempts = int(self._file["attempts"][()])
        """Number of episodes that were begun."""

    def __len__(self) -> int:
        return len(self._episodes)

    def add(self, episode: Episode | None) -> None:
        """Add the episode of an attempt; None counts as a failed attempt."""
        self.attempts += 1
        if episode is None:
            return
        group = self._episodes.create_group(str(len(self)))
        for key, values in episode.observations.items():
            is_height = key in HEIGHTS
            stored = np.rint(values / HEIGHT).astype(np.uint16) if is_height else values
            dataset = group.create_dataset(f"observations/{key}", data=stored, **PACKED)
            dataset.attrs.update({"metres_per_count": HEIGHT} if is_height else {})
        for name in STEPS:
            group[name] = getattr(episode, name)
        if episode.seed is not None:
            group["seed"] = str(episode.seed)  # seeds may exceed 64 bits
        state = np.frombuffer(episode.initial_state.encode(), np.uint8)
        group.create_dataset("initial_state", data=state, **PACKED)
        group["configuration"] = self._file["configuration"]  # a second name of the same data, not a copy
        is_same = self._file["versions"][()].decode() == self._versions
        group["versions"] = self._file["versions"] if is_same else self._versions

    def copy(self, group: h5py.Group) -> None:
        """Add an episode of another file without decompressing it."""
        self.attempts += 1
        self._file.copy(group, self._episodes, str(len(self)))

    def finish(self) -> Demonstrations:
        """Return the demonstrations."""
        self._file["attempts"][()] = self.attempts
        self._file.close()
        content = self._buffer.getvalue()[USER_BLOCK:]
        return Demonstrations(_user_block(content) + content)


def versions() -> dict[str, str]:
    """Return the versions on which the last digits of an episode depend."""
    found = {library: version(library) for library in LIBRARIES}
    return {"python": platform.python_version(), "platform": platform.platform(), **found}


def _user_block(content: bytes) -> bytes:
    """Return the user block with the checksum of the content."""
    return (MAGIC + f" crc32 {zlib.crc32(content):08x}\n".encode()).ljust(USER_BLOCK, b"\0")


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path for a file or folder, which becomes ``path`` if the block succeeds."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}-{os.getpid()}")
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        if error.errno is not None:
            error.filename = error.filename or str(path)  # the error of a full disk has no file name
        raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)  # does nothing to a file
        temporary.unlink(missing_ok=True)


def _read(group: h5py.Group) -> Episode:
    return Episode(
        {key: _observations(dataset) for key, dataset in group["observations"].items()},
        **{name: group[name][()] for name in STEPS},
        seed=int(group["seed"][()]) if "seed" in group else None,
        initial_state=group["initial_state"][()].tobytes().decode(),
    )


def _observations(dataset: h5py.Dataset) -> NDArray[Any]:
    stored: NDArray[Any] = dataset[()]
    unit = dataset.attrs.get("metres_per_count")
    return stored if unit is None else (stored * unit).astype(np.float32)


def load(path: str | os.PathLike[str], object_set: str | os.PathLike[str] | None = None) -> Demonstrations:
    """Return the demonstrations in a file.

    :param object_set: folder of the objects, if it has moved since they were recorded
    :raises OSError: the file cannot be opened
    :raises ValueError: the file is of another kind or damaged
    """
    return Demonstrations(Path(path).read_bytes(), os.fspath(path), object_set)


class ReplayError(RuntimeError):
    """A replayed episode differs from the recorded one."""


def replay(demonstrations: Demonstrations, number: int, env: ManipulationEnv) -> Iterator[int]:
    """Repeat an episode, and yield the number of each of its n + 1 states when the environment is in it.

    :param number: number of the episode
    :param env: environment with the same parameters
    :raises ReplayError: an observation differs from the recorded one, for example with other versions
    """
    episode = demonstrations[number]
    env.set_state(episode.state)
    observation = env.observe()
    for moment in range(len(episode) + 1):
        if moment:
            observation = env.step(episode.actions[moment - 1])[0]
        for key, recorded in episode.observations.items():
            tolerance = TOLERANCE if key in HEIGHTS else 0.0
            if not np.allclose(observation[key], recorded[moment], rtol=0.0, atol=tolerance, equal_nan=True):
                changed = _changed_versions(demonstrations)
                raise ReplayError(
                    f"episode {number}, step {moment}: {key} differs from the recorded one{changed}"
                )
        yield moment


def _changed_versions(demonstrations: Demonstrations) -> str:
    ours = versions()
    changed = [
        f"{name} {theirs}, here {ours.get(name)}"
        for name, theirs in demonstrations.about["versions"].items()
        if theirs != ours.get(name)
    ]
    return f" (recorded with {'; '.join(changed)})" if changed else ""
