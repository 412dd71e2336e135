"""
Checkpoints from which training goes on as if it had never stopped.

A checkpoint is a directory: the algorithm (``model.zip``), its replay buffer (``replay_buffer.pkl``, if it
has one), the state of everything around it (``state.pkl``: random generators, environments, their wrappers),
and ``manifest.json``, which lists these files with their checksums. It is written under a temporary name and
then renamed, so that a directory with a checkpoint's name is always whole.

A resumed run equals an uninterrupted one bit for bit, on the CPU with a ``DummyVecEnv``, if the environments
have methods ``get_state()`` and ``set_state(state)`` whose state includes the environment's random generator.
Others start a new episode. Callbacks (an ``EvalCallback``'s best result) and the state of an
Ornstein-Uhlenbeck ``action_noise``, which Stable-Baselines3 resets at each ``learn()``, are not part of it.
"""

from __future__ import annotations

import importlib
import json
import os
import pickle
import random
import re
import shutil
import warnings
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import stable_baselines3 as sb3
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecFrameStack, VecMonitor, VecNormalize

MANIFEST, MODEL, REPLAY_BUFFER, STATE = "manifest.json", "model.zip", "replay_buffer.pkl", "state.pkl"
FORMAT = 5
PREFIX = "checkpoint_"
NAME = re.compile(rf"{PREFIX}\d+_(?P<number>\d+)")
TEMPORARY_PREFIX = ".incomplete_"
CHUNK = 1 << 20  # bytes

# What changes from step to step in Monitor and TimeLimit. By name: rl_zoo3 puts a class of its own in place
# of TimeLimit, and worker processes do not take one that is no longer found where it says it is.
WRAPPER_STATE = ("rewards", "_elapsed_steps")
VEC_WRAPPER_STATE: dict[type[VecEnvWrapper], tuple[str, ...]] = {
    VecMonitor: ("episode_returns", "episode_lengths", "episode_count"),
    VecNormalize: ("obs_rms", "ret_rms", "returns", "old_obs", "old_reward"),
    VecFrameStack: ("stacked_obs",),
}


class CheckpointError(ValueError):
    """A path holds no checkpoint, or a damaged one."""


class DirectoryCheckpointCallback(BaseCallback):
    """
    Saves a checkpoint directory every so many timesteps, and keeps the latest.

    Checkpoints are taken between two rollouts, after the gradient steps, where everything is in one
    consistent state: the first such moment after the timesteps have passed. A gradient step of pretraining
    counts as one timestep.

    :param save_freq: number of timesteps (of all environments together) from one checkpoint to the next
    :param path: directory of the checkpoints, made if needed
    :param keep: number of checkpoints to keep
    :param verbose: Verbosity level: 0 for no output, 2 for indicating when saving a checkpoint
    :raises ValueError: if ``save_freq`` or ``keep`` is not positive
    """

    def __init__(self, save_freq: int, path: str | os.PathLike[str], keep: int = 2, verbose: int = 0) -> None:
        super().__init__(verbose)
        if save_freq < 1 or keep < 1:
            raise ValueError(f"save_freq and keep must be at least 1, got {save_freq} and {keep}")
        self.save_freq = save_freq
        self.path = Path(path)
        self.keep = keep
        self._last_save = 0

    def _on_training_start(self) -> None:
        self._last_save = self._progress

    @property
    def _progress(self) -> int:
        """Timesteps and gradient steps of pretraining that are done."""
        pretrained: int = getattr(self.model, "n_pretrained", 0)
        return self.model.num_timesteps + pretrained

    def _on_rollout_start(self) -> None:
        if self._progress - self._last_save < self.save_freq:
            return
        self._last_save = self._progress
        checkpoint = save_checkpoint(self.model, self.path, self.keep)
        if self.verbose >= 2:
            print(f"Saved checkpoint {checkpoint}")

    def _on_step(self) -> bool:
        return True


def save_checkpoint(model: BaseAlgorithm, path: str | os.PathLike[str], keep: int = 2) -> Path:
    """
    Write a checkpoint into a directory of checkpoints, whole or not at all; then delete older ones.

    One run writes into a directory: what another, killed one left half written is cleared away.
    Not to be called from a callback's ``_on_step``: there the replay buffer lacks the latest transition.

    :param model: algorithm with an environment
    :param path: directory of the checkpoints, made if needed
    :param keep: number of checkpoints to keep, this one included
    :return: directory of this checkpoint
    """
    path = Path(path)
    path.mkdir(parents=True, exist_ok=True)
    for leftover in path.glob(f"{TEMPORARY_PREFIX}*"):
        shutil.rmtree(leftover)
    final = path / f"{PREFIX}{model.num_timesteps:012d}_{_next_number(path):03d}"
    temporary = path / f"{TEMPORARY_PREFIX}{final.name}"
    temporary.mkdir()
    try:
        _write_files(model, temporary)
    except BaseException:  # on a full disk its first half would fill what is left
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    os.rename(temporary, final)
    _sync(path)
    for old in _checkpoints(path)[:-keep]:
        _remove(old)
    return final


def latest_checkpoint(path: str | os.PathLike[str]) -> Path | None:
    """
    Find the latest checkpoint.

    :param path: directory of checkpoints
    :return: the checkpoint written last, None if there is none
    """
    checkpoints = _checkpoints(Path(path))
    return checkpoints[-1] if checkpoints else None


def latest_whole_checkpoint(path: str | os.PathLike[str]) -> tuple[Path, list[CheckpointError]]:
    """
    Find the latest checkpoint whose files are what was written.

    :param path: directory of checkpoints
    :return: that checkpoint, and what is wrong with each later one
    :raises CheckpointError: if there is none; says what is wrong with the latest
    """
    damaged: list[CheckpointError] = []
    for checkpoint in reversed(_checkpoints(Path(path))):
        try:
            _read_manifest(checkpoint)
            return checkpoint, damaged
        except CheckpointError as error:
            damaged.append(error)
    raise damaged[0] if damaged else CheckpointError(f"{path} holds no checkpoint to go on from")


def resume(path: str | os.PathLike[str], env: GymEnv, device: th.device | str = "auto") -> BaseAlgorithm:
    """
    Load an algorithm from a checkpoint, to go on by ``learn(..., reset_num_timesteps=False)``.

    Sets the global generators of Python, NumPy and PyTorch. As with every pickle: only open files you trust.

    :param path: a checkpoint, or a directory of checkpoints, of which the latest whole one is taken
    :param env: environment made like the one of the interrupted run, with as many copies
    :param device: device on which the algorithm should run
    :return: the algorithm
    :raises CheckpointError: if there is no checkpoint, or it is damaged
    :raises ValueError: if the environment does not fit
    """
    checkpoint = Path(path)
    if not (checkpoint / MANIFEST).is_file():
        checkpoint, damaged = latest_whole_checkpoint(path)
        for error in damaged:
            warnings.warn(f"{error}; going on from {checkpoint}", stacklevel=2)
    manifest = _read_manifest(checkpoint)
    algorithm = _import_algorithm(checkpoint, manifest["algorithm"])
    try:
        state = pickle.loads((checkpoint / STATE).read_bytes())
        model = algorithm.load(checkpoint / MODEL, env=env, device=device, force_reset=False)
        _check_env(model, state["envs"])  # a misfit would show in the replay buffer, too
        if isinstance(model, OffPolicyAlgorithm) and REPLAY_BUFFER in manifest["files"]:
            model.load_replay_buffer(checkpoint / REPLAY_BUFFER, truncate_last_traj=False)
    except (pickle.UnpicklingError, EOFError, zipfile.BadZipFile) as error:
        raise CheckpointError(f"{checkpoint} cannot be read: {error}") from error
    _set_env_state(model, state["envs"])
    _set_generator_state(model, state["generators"])  # last, because all the above may draw numbers
    return model


def _write_files(model: BaseAlgorithm, directory: Path) -> None:
    """Write all files of a checkpoint, and make sure that they are on the disk."""
    state = {"envs": _env_state(model), "generators": _generator_state(model)}
    (directory / STATE).write_bytes(pickle.dumps(state, protocol=pickle.HIGHEST_PROTOCOL))
    model.save(directory / MODEL)
    if isinstance(model, OffPolicyAlgorithm) and model.replay_buffer is not None:
        model.save_replay_buffer(directory / REPLAY_BUFFER)
    files = {file.name: {"bytes": file.stat().st_size, "crc32": _crc32(file)} for file in directory.iterdir()}
    manifest = {
        "format": FORMAT,
        "algorithm": f"{type(model).__module__}:{type(model).__qualname__}",
        "num_timesteps": model.num_timesteps,
        "stable_baselines3": sb3.__version__,
        "torch": th.__version__,
        "numpy": np.__version__,
        "files": files,
    }
    (directory / MANIFEST).write_text(json.dumps(manifest, indent=2), encoding="utf-8")
    for file in directory.iterdir():
        _sync(file)
    _sync(directory)


def _read_manifest(checkpoint: Path) -> dict[str, Any]:
    """Read the manifest of a checkpoint and compare the files with it."""
    try:
        manifest: dict[str, Any] = json.loads((checkpoint / MANIFEST).read_text(encoding="utf-8"))
        version, files = manifest["format"], manifest["files"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CheckpointError(f"{checkpoint / MANIFEST} is not a checkpoint's manifest: {error!r}") from error
    if version != FORMAT:
        raise CheckpointError(f"{checkpoint} has format {version}, this version reads format {FORMAT}")
    for name, entry in files.items():
        file = checkpoint / name
        if not file.is_file():
            raise CheckpointError(f"{checkpoint} is damaged: {name} is missing")
        if file.stat().st_size != entry["bytes"] or _crc32(file) != entry["crc32"]:
            raise CheckpointError(f"{checkpoint} is damaged: {name} is not what was written")
    return manifest


def _import_algorithm(checkpoint: Path, name: str) -> type[BaseAlgorithm]:
    module, _, qualname = name.partition(":")
    try:
        algorithm: type[BaseAlgorithm] = getattr(importlib.import_module(module), qualname)
    except (ImportError, AttributeError) as error:
        raise CheckpointError(f"{checkpoint} needs the algorithm {name}, which cannot be imported") from error
    return algorithm


def _generator_state(model: BaseAlgorithm) -> dict[str, Any]:
    """States of the global generators, of the action space's and of the model's own.

    The replay buffer's is in its own file.
    """
    return {
        "python": random.getstate(),
        "numpy": np.random.get_state(),
        "torch": th.get_rng_state(),
        "cuda": th.cuda.get_rng_state_all() if th.cuda.is_available() else [],
        "action_space": model.action_space.np_random.bit_generator.state,
        "model": {name: generator.get_state() for name, generator in _own_generators(model).items()},
    }


def _set_generator_state(model: BaseAlgorithm, state: dict[str, Any]) -> None:
    random.setstate(state["python"])
    np.random.set_state(state["numpy"])
    th.set_rng_state(state["torch"])
    if len(state["cuda"]) == th.cuda.device_count():
        th.cuda.set_rng_state_all(state["cuda"])
    model.action_space.np_random.bit_generator.state = state["action_space"]
    for name, generator in _own_generators(model).items():
        generator.set_state(state["model"][name])


def _own_generators(model: BaseAlgorithm) -> dict[str, th.Generator]:
    return {name: value for name, value in vars(model).items() if isinstance(value, th.Generator)}


def _env_state(model: BaseAlgorithm) -> dict[str, Any]:
    """States of the environments (None if they have no ``get_state``) and of their wrappers."""
    env = model.get_env()
    assert env is not None, "You must set the environment before saving a checkpoint"
    return {
        "num_envs": env.num_envs,
        "envs": env.env_method("get_state") if env.has_attr("get_state") else None,
        "wrappers": {name: env.get_attr(name) for name in WRAPPER_STATE if env.has_attr(name)},
        "vec_wrappers": [
            {name: getattr(wrapper, name) for name in _vec_wrapper_state(wrapper) if hasattr(wrapper, name)}
            for wrapper in _vec_wrappers(env)
        ],
        "vec_wrapper_names": _vec_wrapper_names(env),
    }


def _check_env(model: BaseAlgorithm, state: dict[str, Any]) -> None:
    env = model.get_env()
    assert env is not None
    if state["num_envs"] != env.num_envs:
        raise ValueError(f"env must have {state['num_envs']} environments, got {env.num_envs}")
    if state["vec_wrapper_names"] != (given := _vec_wrapper_names(env)):
        raise ValueError(f"env must be wrapped in {state['vec_wrapper_names']}, got {given}")


def _set_env_state(model: BaseAlgorithm, state: dict[str, Any]) -> None:
    env = model.get_env()
    assert env is not None
    if state["envs"] is None:
        _start_new_episodes(model, env)
    else:
        env.reset()  # wrappers want it before the first step
        for index, env_state in enumerate(state["envs"]):
            env.env_method("set_state", env_state, indices=index)
            for name, values in state["wrappers"].items():
                env.env_method("set_wrapper_attr", name, values[index], indices=index)
    for wrapper, attributes in zip(_vec_wrappers(env), state["vec_wrappers"], strict=True):
        for name, value in attributes.items():
            setattr(wrapper, name, value)


def _start_new_episodes(model: BaseAlgorithm, env: VecEnv) -> None:
    """Let the next ``learn()`` reset the environments, to other episodes than at the start of the run."""
    warnings.warn("the environments have no get_state(): their episodes start anew", stacklevel=4)
    model._last_obs = None
    if model.seed is not None:
        env.seed(int(np.random.SeedSequence([model.seed, model.num_timesteps]).generate_state(1)[0] >> 1))


def _vec_wrappers(env: VecEnv) -> Iterator[VecEnvWrapper]:
    while isinstance(env, VecEnvWrapper):
        yield env
        env = env.venv


def _vec_wrapper_names(env: VecEnv) -> list[str]:
    """Names of the wrappers around all environments, from the outside in."""
    return [type(wrapper).__name__ for wrapper in _vec_wrappers(env)]


def _vec_wrapper_state(wrapper: VecEnvWrapper) -> tuple[str, ...]:
    return next((names for kind, names in VEC_WRAPPER_STATE.items() if isinstance(wrapper, kind)), ())


def _next_number(path: Path) -> int:
    """How many checkpoints were written before; timesteps do not tell, they stand still in pretraining."""
    checkpoints = _checkpoints(path)
    return _number(checkpoints[-1]) + 1 if checkpoints else 0


def _number(checkpoint: Path) -> int:
    match = NAME.fullmatch(checkpoint.name)
    assert match is not None
    return int(match["number"])


def _checkpoints(path: Path) -> list[Path]:
    """Checkpoints in a directory, in the order in which they were written."""
    named = (entry for entry in path.glob(f"{PREFIX}*") if NAME.fullmatch(entry.name))
    return sorted((entry for entry in named if (entry / MANIFEST).is_file()), key=_number)


def _remove(checkpoint: Path) -> None:
    """Delete a checkpoint, so that it never looks whole while half of it is gone."""
    doomed = checkpoint.with_name(f"{TEMPORARY_PREFIX}{checkpoint.name}")
    os.rename(checkpoint, doomed)
    shutil.rmtree(doomed)


def _crc32(file: Path) -> int:
    checksum = 0
    with file.open("rb") as stream:
        while chunk := stream.read(CHUNK):
            checksum = zlib.crc32(chunk, checksum)
    return checksum


def _sync(path: Path) -> None:
    """Make the operating system write a file, or the entries of a directory, to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
