"""Episodes, and the HDF5 files they are kept in.

A file holds, compressed, ``episodes/0``, ``episodes/1``, ...: each with ``observations`` (n + 1 of each key),
``actions``, ``rewards``, ``terminations``, ``truncations``, the ``seed`` of its reset if it had one, and as
JSON the ``initial_state`` (see :mod:`~bulletarm_gym.plain`), the ``configuration`` of its environment and
the ``versions`` of what it was recorded with. Heights are counts of 0.1 mm. Before it, in HDF5's user block,
is a checksum of all that.
"""

import io
import json
import os
import platform
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium
import h5py
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bulletarm_gym.demonstrations import plain
from bulletarm_gym.registry import register
from bulletarm_gym.scene.state import EnvState

FORMAT = 1
"""Of the file; raised when older readers could no longer read it."""
HEIGHT = 1e-4
"""Metres a count of what is stored of a height: 0.1 mm."""
HEIGHTS = ("heightmap", "in_hand")
"""Observations in metres."""
STEPS = ("actions", "rewards", "terminations", "truncations")
LIBRARIES = ("bulletarm-gym", "gymnasium", "h5py", "numba", "numpy", "pybullet")
USER_BLOCK = 512
"""Bytes before the HDF5 content proper: HDF5's smallest block for other things than its own."""
LARGEST_SEED = 2**63 - 1
"""Largest seed that HDF5 stores as an integer; larger seeds are decimal text."""
MAGIC = b"bulletarm-gym demonstrations"
PACKED = {"compression": "gzip", "compression_opts": 4, "shuffle": True}


@dataclass(frozen=True)
class Episode:
    """An episode of n steps, its parts named as Minari names them.

    :param observations: for each key (n + 1, ...) observations
    :param actions: (n, action dimensions)
    :param rewards: (n,)
    :param terminations: (n,) whether it terminated
    :param truncations: (n,) whether it was truncated
    :param seed: of the reset it began with; None if it began without a seed or at a state
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
        """Return the number of steps."""
        return len(self.actions)

    @cached_property
    def state(self) -> EnvState:
        """The state before the first action, for an environment's ``set_state()``."""
        state: EnvState = plain.loads(self.initial_state)
        return state


Step = tuple[NDArray[np.float32], float, bool, bool]
"""Action, reward, whether it terminated, whether it was truncated."""


def assemble(
    observations: Sequence[Mapping[str, NDArray[np.float32]]],
    steps: Sequence[Step],
    seed: int | None,
    initial_state: str,
) -> Episode:
    """Put an episode together from what was observed, n + 1 times, and done, n times."""
    stacked = {key: np.stack([entry[key] for entry in observations]) for key in observations[0]}
    actions, rewards, terminations, truncations = map(np.array, zip(*steps, strict=True))
    rewards = rewards.astype(np.float32)
    return Episode(stacked, actions, rewards, terminations, truncations, seed, initial_state)


class Demonstrations:
    """Episodes of one environment, as they are in a file; read one at a time.

    :param image: the content of the file
    :param name: of the file, for errors
    :param object_set: folder of the objects, if it is not where it was when they were recorded
    :raises ValueError: it is of another kind, or damaged
    """

    def __init__(
        self, image: bytes, name: str = "demonstrations", object_set: str | os.PathLike[str] | None = None
    ) -> None:
        self.image = image
        self._name = name
        self._changed = {} if object_set is None else {"object_set": os.path.abspath(object_set)}
        if not image.startswith(MAGIC):
            raise ValueError(f"{name}: not a file of demonstrations")
        if image[:USER_BLOCK] != _user_block(image[USER_BLOCK:]):
            raise ValueError(f"{name}: a file of demonstrations, but damaged: its checksum is wrong")
        with self._file() as file:
            self.about: dict[str, Any] = json.loads(file["about"][()])
            self._count = len(file["episodes"])
            version = self.about["format"]
        if version != FORMAT:
            raise ValueError(f"{name}: its format is {version}, this version reads {FORMAT}")

    @property
    def env_id(self) -> str:
        """Id of the environment."""
        return str(self.about["env_id"])

    @property
    def attempts(self) -> int:
        """Number of episodes begun for those that are here."""
        return int(self.about["attempts"])

    @property
    def action_sequence(self) -> str:
        """Meaning of each number of an action, one character each."""
        return str(self.about["configuration"]["action_sequence"])

    @property
    def action_space(self) -> spaces.Box:
        """Action space of the environment."""
        return spaces.Box(-1.0, 1.0, (len(self.action_sequence),), np.float32)

    @property
    def action_ranges(self) -> dict[str, tuple[float, float]] | None:
        """Values (m, rad) of -1 and 1 in an action, by name; None in older files."""
        ranges = self.about.get("action_ranges")
        return ranges and {name: (low, high) for name, (low, high) in ranges.items()}

    def make_env(self, **parameters: Any) -> gymnasium.Env[Any, Any]:
        """Make an environment like the one they were recorded in; the module of a user's task is imported.

        :param parameters: parameters with other values
        :raises ValueError: the folder of the objects does not exist
        """
        if self.env_id not in gymnasium.registry and "recipe" in self.about:
            register(self.env_id, self.about["recipe"])
        parameters = {**self.about["configuration"], **self._changed, **parameters}
        folder = parameters.get("object_set")
        if isinstance(folder, str) and not os.path.isdir(folder):
            raise ValueError(
                f"object_set must be the folder of the objects that were recorded, got {folder!r}, "
                "which does not exist. Use load(path, object_set=FOLDER)."
            )
        return gymnasium.make(self.env_id, **parameters)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the file, whole or not at all; its folder is made."""
        with whole_file(Path(path)) as partial:
            partial.write_bytes(self.image)

    def __len__(self) -> int:
        """Return the number of episodes."""
        return self._count

    def __getitem__(self, index: int) -> Episode:
        """Return an episode.

        :raises ValueError: the file lacks a part of it
        """
        if not -self._count <= index < self._count:
            raise IndexError(f"there are {self._count} episodes, no number {index}")
        with self._file() as file:
            return _read(file["episodes"][str(index % self._count)])

    def __iter__(self) -> Iterator[Episode]:
        """Iterate over the episodes."""
        return (self[index] for index in range(self._count))

    @contextmanager
    def _file(self) -> Iterator[h5py.File]:
        """Open the file.

        :raises ValueError: there is not in it what should be
        """
        try:
            with h5py.File(io.BytesIO(self.image), "r") as file:
                yield file
        except (AttributeError, LookupError, OSError, RuntimeError, TypeError, ValueError) as error:
            raise ValueError(f"{self._name}: not a file of demonstrations, or damaged: {error}") from error


class Recorder:
    """Makes the file, episode by episode, in memory: until it is whole there is none on the disk.

    :param environment: description of the environment, with its parameters as ``configuration``
    """

    def __init__(self, environment: Mapping[str, Any]) -> None:
        self._about = {"format": FORMAT, **environment, "versions": versions()}
        self.attempts = 0
        """Number of episodes begun."""
        self._buffer = io.BytesIO()
        self._file = h5py.File(self._buffer, "w", userblock_size=USER_BLOCK)
        self._episodes = self._file.create_group("episodes", track_order=True)
        for name in ("configuration", "versions"):
            self._file[name] = json.dumps(self._about[name])

    def __len__(self) -> int:
        """Return the number of episodes so far."""
        return len(self._episodes)

    def add(self, episode: Episode | None) -> None:
        """Add the episode of an attempt; None counts as one that failed."""
        self.attempts += 1
        if episode is not None:
            self._write(episode)

    def _write(self, episode: Episode) -> None:
        group = self._episodes.create_group(str(len(self._episodes)))
        for key, values in episode.observations.items():
            _write_observations(group.require_group("observations"), key, values)
        for name in STEPS:
            group[name] = getattr(episode, name)
        if episode.seed is not None:
            group["seed"] = episode.seed if episode.seed <= LARGEST_SEED else str(episode.seed)
        state = np.frombuffer(episode.initial_state.encode(), np.uint8)
        group.create_dataset("initial_state", data=state, **PACKED)
        for name in ("configuration", "versions"):
            group[name] = self._file[name]  # a second name of the same thing, not a copy

    def finish(self, **about: Any) -> Demonstrations:
        """Return what was recorded.

        :param about: what else is to be known of it; JSON values
        """
        self._file["about"] = json.dumps({**self._about, "attempts": self.attempts, **about})
        self._file.close()
        content = self._buffer.getvalue()[USER_BLOCK:]
        return Demonstrations(_user_block(content) + content)


def versions() -> dict[str, str]:
    """Return what an episode's last digits depend on."""
    found = {library: version(library) for library in LIBRARIES}
    return {"python": platform.python_version(), "platform": platform.platform(), **found}


def _user_block(content: bytes) -> bytes:
    """Return what comes before the content: its checksum, for HDF5 itself meets damages late or never."""
    return (MAGIC + f" crc32 {zlib.crc32(content):08x}\n".encode()).ljust(USER_BLOCK, b"\0")


def _remove(path: Path) -> None:
    path.unlink(missing_ok=True)


@contextmanager
def whole_file(path: Path, discard: Callable[[Path], None] = _remove) -> Iterator[Path]:
    """Give a temporary path beside ``path``, which takes its place if the block succeeds, and else goes.

    :param discard: removes what stands at the temporary path, if anything does
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}-{os.getpid()}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        discard(temporary)


def _write_observations(group: h5py.Group, key: str, values: NDArray[Any]) -> None:
    unit = HEIGHT if key in HEIGHTS else None
    stored = values if unit is None else np.rint(values / unit).astype(np.uint16)
    dataset = group.create_dataset(key, data=stored, **PACKED)
    if unit is not None:
        dataset.attrs["metres_per_count"] = unit


def _read(group: h5py.Group) -> Episode:
    return Episode(
        {key: _read_observations(dataset) for key, dataset in group["observations"].items()},
        group["actions"][()],
        group["rewards"][()],
        group["terminations"][()],
        group["truncations"][()],
        int(group["seed"][()]) if "seed" in group else None,
        group["initial_state"][()].tobytes().decode(),
    )


def _read_observations(dataset: h5py.Dataset) -> NDArray[Any]:
    stored: NDArray[Any] = dataset[()]
    unit = dataset.attrs.get("metres_per_count")
    return stored if unit is None else (stored * unit).astype(np.float32)


def load(path: str | os.PathLike[str], object_set: str | os.PathLike[str] | None = None) -> Demonstrations:
    """Return the demonstrations in a file.

    :param object_set: folder of the objects, if it is not where it was when they were recorded
    :raises OSError: it cannot be opened
    :raises ValueError: it is of another kind, or damaged; so it may turn out when an episode is read
    """
    return Demonstrations(Path(path).read_bytes(), os.fspath(path), object_set)
