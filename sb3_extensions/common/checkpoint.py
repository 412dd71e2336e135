"""
Checkpoints: directories with algorithm, replay buffer, checksums, and states of environments and generators.

A resumed run equals an uninterrupted one bit for bit on the CPU with a ``DummyVecEnv``. This requires
environments with ``get_state()`` and ``set_state(state)`` whose state includes the random generator. Other
environments start a new episode. The state of callbacks is not stored. Ornstein-Uhlenbeck noise and
state-dependent exploration start again, as in every ``learn()``.
"""

import json
import os
import pickle
import random
import shutil
import warnings
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from torch.utils._pytree import tree_map_only

from sb3_extensions.common.components import check_integer

MANIFEST, MODEL, REPLAY_BUFFER, STATE = "manifest.json", "model.zip", "replay_buffer.pkl", "state.pkl"
FORMAT = 7
"""Version of the format of a checkpoint."""
PREFIX, TEMPORARY_PREFIX = "checkpoint_", ".incomplete_"
MONITOR_TOTALS = ("total_steps", "t_start")
"""Attributes of ``Monitor`` that count from the start of the training."""
WRAPPER_STATE = (
    *MONITOR_TOTALS,
    *("rewards", "_elapsed_steps", "timesteps"),
    *("observation_queue", "obs_queue", "padding_value"),
    *("obs_rms", "return_rms", "discounted_reward"),
    *("last_action", "is_sticky_actions", "num_repeats", "repeats_taken"),
    *("_reset_options", "_instruction_rng"),
)
"""Attributes of ``Monitor`` and of wrappers of Gymnasium and ``bulletarm_gym`` that change in a training."""
VEC_WRAPPER_STATE = (
    *("episode_returns", "episode_lengths", "episode_count"),
    *("obs_rms", "ret_rms", "returns", "old_obs", "old_reward"),
    "stacked_obs",
)
"""Attributes of ``VecMonitor``, ``VecNormalize`` and ``VecFrameStack`` that change in an episode."""
LSTM_STATE = "_last_lstm_states"
"""Attribute of ``RecurrentPPO`` that its ``save()`` leaves out."""


class CheckpointError(ValueError):
    """Error of a path without a checkpoint, or of a damaged checkpoint."""


class DirectoryCheckpointCallback(BaseCallback):
    """
    Callback that saves a checkpoint directory every ``save_freq`` timesteps and keeps the latest ones.

    A gradient step of the pretraining counts as one timestep.

    :param save_freq: number of timesteps of all environments between two checkpoints
    :param path: directory of the checkpoints, created if it does not exist
    :param keep: number of checkpoints to keep
    :raises ValueError: if ``save_freq`` or ``keep`` is not a positive integer
    """

    def __init__(self, save_freq: int, path: str | os.PathLike[str], keep: int = 2) -> None:
        super().__init__()
        check_integer(1, save_freq=save_freq, keep=keep)
        self.save_freq = save_freq
        self.path = Path(path)
        self.keep = keep
        self._last_save = 0

    def _on_training_start(self) -> None:
        self._last_save = self._progress

    @property
    def _progress(self) -> int:
        """Number of timesteps and gradient steps of the pretraining so far."""
        pretrained: int = getattr(self.model, "n_pretrained", 0)
        return self.model.num_timesteps + pretrained

    def _on_rollout_start(self) -> None:
        if self._progress - self._last_save < self.save_freq:
            return
        self._last_save = self._progress
        save_checkpoint(self.model, self.path, self.keep)

    def _on_step(self) -> bool:
        return True


def save_checkpoint(model: BaseAlgorithm, path: str | os.PathLike[str], keep: int = 2) -> Path:
    """
    Write a checkpoint atomically, then delete older ones and incomplete ones of an interrupted run.

    Only one run may write to a directory. Do not call this function in a callback's ``_on_step``, where the
    replay buffer lacks the latest step.

    :param model: algorithm with an environment
    :param path: directory of the checkpoints, created if it does not exist
    :param keep: number of checkpoints to keep, including the new one
    :return: directory of the new checkpoint
    :raises ValueError: if ``keep`` is not a positive integer
    """
    check_integer(1, keep=keep)
    path = Path(path)
    path.mkdir(parents=True, exist_ok=True)
    for leftover in path.glob(f"{TEMPORARY_PREFIX}*"):
        shutil.rmtree(leftover)
    # Numbers order the checkpoints, because the pretraining has no timesteps.
    number = max(map(_number, _checkpoints(path)), default=-1) + 1
    final = path / f"{PREFIX}{model.num_timesteps:012d}_{number:03d}"
    temporary = path / f"{TEMPORARY_PREFIX}{final.name}"
    temporary.mkdir()
    try:
        _write_files(model, temporary)
        os.rename(temporary, final)
    except BaseException as error:
        if isinstance(error, OSError):  # the error of a full disk has no file name
            error.filename = error.filename or str(final)
        shutil.rmtree(temporary, ignore_errors=True)  # frees the space on a full disk
        raise
    _sync(path)
    for old in _checkpoints(path)[:-keep]:
        # An interrupted deletion leaves a directory with a temporary name.
        renamed = path / f"{TEMPORARY_PREFIX}{old.name}"
        os.rename(old, renamed)
        shutil.rmtree(renamed)
    return final


def latest_checkpoint(path: str | os.PathLike[str]) -> Path | None:
    """Return the latest checkpoint in a directory, without reading it, None if there is none."""
    return next(reversed(_checkpoints(Path(path))), None)


def latest_valid_checkpoint(path: str | os.PathLike[str]) -> tuple[Path, list[CheckpointError]]:
    """
    Return the latest checkpoint whose files match their checksums, and the errors of later ones.

    :raises CheckpointError: if there is none; the error is that of the latest checkpoint
    """
    errors: list[CheckpointError] = []
    for checkpoint in reversed(_checkpoints(Path(path))):
        try:
            _check_files(checkpoint)
            return checkpoint, errors
        except CheckpointError as error:
            errors.append(error)
    raise errors[0] if errors else CheckpointError(f"{path} must have a checkpoint, got none")


def resume(path: str | os.PathLike[str], env: GymEnv, device: th.device | str = "auto") -> BaseAlgorithm:
    """
    Load an algorithm from a checkpoint. Continue with ``learn(..., reset_num_timesteps=False)``.

    This sets all global generators. Only open files that you trust, because a pickle can run code.

    :param path: a checkpoint, or a directory of checkpoints, of which the latest valid one is loaded
    :param env: environment with the arguments, wrappers and number of copies of the interrupted run
    :param device: device on which the algorithm should run
    :raises CheckpointError: if the checkpoint is missing or damaged
    :raises ValueError: if the environment does not fit
    """
    checkpoint = Path(path)
    errors: list[CheckpointError] = []
    if (checkpoint / MANIFEST).is_file():
        _check_files(checkpoint)
    else:
        checkpoint, errors = latest_valid_checkpoint(path)
    for error in errors:
        warnings.warn(f"{error}. Resuming from {checkpoint}", stacklevel=2)
    try:
        state = pickle.loads((checkpoint / STATE).read_bytes())
        model: BaseAlgorithm = state["algorithm"].load(
            checkpoint / MODEL, env=env, device=device, force_reset=False
        )
        vec_env = model.get_env()
        assert vec_env is not None
        _check_env(vec_env, state["envs"])  # before the replay buffer, whose errors are less clear
        if isinstance(model, OffPolicyAlgorithm) and (checkpoint / REPLAY_BUFFER).exists():
            model.load_replay_buffer(checkpoint / REPLAY_BUFFER, truncate_last_traj=False)
    except (pickle.UnpicklingError, EOFError, ImportError, AttributeError, zipfile.BadZipFile) as error:
        raise CheckpointError(f"{checkpoint} cannot be read: {error}") from error
    if (lstm := state.get("lstm")) is not None:
        setattr(model, LSTM_STATE, tree_map_only(th.Tensor, lambda values: values.to(model.device), lstm))
    _set_env_state(model, vec_env, state["envs"])
    _set_generator_state(model, state["generators"])  # last, because the calls above can sample numbers
    return model


def _write_files(model: BaseAlgorithm, directory: Path) -> None:
    """Write all files of a checkpoint to the disk."""
    env = model.get_env()
    assert env is not None, "You must set the environment before saving a checkpoint"
    state = {"algorithm": type(model), "envs": _env_state(env), "generators": _generator_state(model)}
    state["lstm"] = tree_map_only(th.Tensor, th.Tensor.cpu, getattr(model, LSTM_STATE, None))
    (directory / STATE).write_bytes(pickle.dumps(state, protocol=pickle.HIGHEST_PROTOCOL))
    model.save(directory / MODEL)
    if isinstance(model, OffPolicyAlgorithm) and model.replay_buffer is not None:
        model.save_replay_buffer(directory / REPLAY_BUFFER)
    manifest = {"format": FORMAT, "crc32": {file.name: _crc32(file) for file in directory.iterdir()}}
    (directory / MANIFEST).write_text(json.dumps(manifest, indent=2), encoding="utf-8")
    for file in (*directory.iterdir(), directory):
        _sync(file)


def _check_files(checkpoint: Path) -> None:
    """Raise a CheckpointError if a file of a checkpoint is missing or has another checksum."""
    try:
        manifest = json.loads((checkpoint / MANIFEST).read_text(encoding="utf-8"))
        version, checksums = manifest["format"], manifest["crc32"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CheckpointError(f"{checkpoint / MANIFEST} must be a manifest, got {error!r}") from error
    if version != FORMAT:
        raise CheckpointError(f"{checkpoint} must have format {FORMAT}, got format {version}")
    for name, checksum in checksums.items():
        if not (checkpoint / name).is_file():
            raise CheckpointError(f"{checkpoint} is damaged: {name} is missing")
        if _crc32(checkpoint / name) != checksum:
            raise CheckpointError(f"{checkpoint} is damaged: {name} has another checksum")


def _generator_state(model: BaseAlgorithm) -> dict[str, Any]:
    """Return the states of all random generators except the replay buffer's, which the buffer stores."""
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


def _env_state(env: VecEnv) -> dict[str, Any]:
    """Return the states of the environments, None if they have none, and of their wrappers."""
    return {
        "num_envs": env.num_envs,
        "envs": env.env_method("get_state") if all(map(env.has_attr, ("get_state", "set_state"))) else None,
        "wrappers": {name: env.get_attr(name) for name in WRAPPER_STATE if env.has_attr(name)},
        "vec_wrappers": [
            {name: vars(wrapper)[name] for name in VEC_WRAPPER_STATE if name in vars(wrapper)}
            for wrapper in _vec_wrappers(env)
        ],
        "vec_wrapper_names": _vec_wrapper_names(env),
    }


def _check_env(env: VecEnv, state: dict[str, Any]) -> None:
    if state["num_envs"] != env.num_envs:
        raise ValueError(f"env must have {state['num_envs']} environments, got {env.num_envs}")
    if state["vec_wrapper_names"] != (names := _vec_wrapper_names(env)):
        raise ValueError(f"env must be wrapped in {state['vec_wrapper_names']}, got {names}")


def _set_env_state(model: BaseAlgorithm, env: VecEnv, state: dict[str, Any]) -> None:
    kept = state["wrappers"]
    if state["envs"] is None:
        _start_new_episodes(model, env)
        kept = {name: values for name, values in kept.items() if name in MONITOR_TOTALS}
    else:
        env.reset()  # required by wrappers before the first step
        for index, env_state in enumerate(state["envs"]):
            env.env_method("set_state", env_state, indices=index)
    for name, values in kept.items():
        for index, value in enumerate(values):
            env.env_method("set_wrapper_attr", name, value, indices=index)
    for wrapper, attributes in zip(_vec_wrappers(env), state["vec_wrappers"], strict=True):
        vars(wrapper).update(attributes)


def _start_new_episodes(model: BaseAlgorithm, env: VecEnv) -> None:
    """Let the next ``learn()`` reset the environments, with other seeds than at the start of the run."""
    warnings.warn("the environments have no get_state(), so new episodes start", stacklevel=4)
    model._last_obs = None
    if model.seed is not None:
        env.seed(int(np.random.SeedSequence([model.seed, model.num_timesteps]).generate_state(1)[0] >> 1))


def _vec_wrappers(env: VecEnv) -> Iterator[VecEnvWrapper]:
    while isinstance(env, VecEnvWrapper):
        yield env
        env = env.venv


def _vec_wrapper_names(env: VecEnv) -> list[str]:
    return [type(wrapper).__name__ for wrapper in _vec_wrappers(env)]


def _checkpoints(path: Path) -> list[Path]:
    """Return the checkpoints in a directory in the order in which they were written."""
    found = (manifest.parent for manifest in path.glob(f"{PREFIX}[0-9]*_[0-9]*/{MANIFEST}"))
    return sorted(found, key=_number)


def _number(checkpoint: Path) -> int:
    return int(checkpoint.name.rpartition("_")[2])


def _crc32(file: Path) -> int:
    contents: Any = np.memmap(file, mode="r") if file.stat().st_size else b""
    return zlib.crc32(contents)


def _sync(path: Path) -> None:
    """Write a file, or the entries of a directory, from the cache of the operating system to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
