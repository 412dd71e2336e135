"""Environments in parallel processes, whose failures are told apart.

``gymnasium.make_vec(id, num_envs=n, vectorization_mode="async")`` steps environments in processes, too: when
one of them is killed, it raises whatever its pipe gives (``EOFError``, ``ConnectionResetError``), and the
other workers go on until the program ends.
"""

import traceback
from collections.abc import Callable, Iterable, Sequence
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, NoReturn

import gymnasium
import numpy as np
from gymnasium.vector import AsyncVectorEnv, VectorEnv
from gymnasium.vector.async_vector_env import _async_worker

from bulletarm_gym.state import EnvState


def reset_to_states(envs: VectorEnv[Any, Any, Any], states: Sequence[EnvState]) -> tuple[Any, dict[str, Any]]:
    """Begin the episodes of a vector environment, each member at a state of its own.

    :param envs: vector environment of Gymnasium, or :class:`ParallelEnv`
    :param states: one state per member
    :return: observations and infos, as ``envs.reset()`` returns them
    :raises ValueError: the number of states differs from that of the members, or ``envs`` has
        ``shared_memory=False``
    """
    if not getattr(envs.unwrapped, "shared_memory", True):
        # Its workers reset ended members again at the next step: findings/gymnasium_async_resets_twice.sh
        raise ValueError("envs must have shared_memory=True, got shared_memory=False")
    if len(states) != envs.num_envs:
        raise ValueError(f"states must be {envs.num_envs} states, one per member, got {len(states)}")
    observations, infos = envs.reset(options={"state": states[0]})
    for number, state in enumerate(states[1:], 1):
        mask = np.arange(envs.num_envs) == number
        observations, later = envs.reset(options={"state": state, "reset_mask": mask})
        infos = _masked(infos, later, mask)
    return observations, infos


def _masked(value: Any, later: Any, mask: Any) -> Any:
    """Return infos, or an entry of infos, with the later values of the members in a mask."""
    if isinstance(value, dict):
        return {name: _masked(entry, later[name], mask) for name, entry in value.items()}
    return np.where(mask, later, value)


class WorkerError(RuntimeError):
    """A worker process ended, or failed with the traceback that this error is raised from."""


class ParallelEnv(AsyncVectorEnv):
    """Gymnasium's ``AsyncVectorEnv`` that neither hangs nor leaves workers behind when one of them fails.

    A worker's error arrives with its traceback, a killed worker is named, and either ends all of them::

        make = partial(gymnasium.make, "bulletarm_gym:BulletArm/CloseLoopBlockPicking-v0", obs_size=64)
        environments = ParallelEnv([make] * 4)

    :param env_fns: make an environment each, in a process of its own
    :param options: of ``AsyncVectorEnv``, such as ``context="spawn"`` or ``autoreset_mode="SameStep"``
    :raises ValueError: there is no environment to make, or a parameter of one is wrong
    """

    def __init__(self, env_fns: Sequence[Callable[[], gymnasium.Env[Any, Any]]], **options: Any) -> None:
        if not env_fns:
            raise ValueError("env_fns: got none, takes at least one")
        super().__init__(env_fns, **{"worker": _work, **options})

    def _check_spaces(self) -> None:
        """Begin to watch the workers, before the first word from them."""
        watched: list[Any] = [
            _WatchedPipe(pipe, process, self)
            for pipe, process in zip(self.parent_pipes, self.processes, strict=True)
        ]
        self.parent_pipes = watched
        super()._check_spaces()  # type: ignore[no-untyped-call]

    def _raise_if_errors(self, successes: Iterable[bool]) -> None:
        failed = list(successes).count(False)
        if not failed:
            return
        index, _, value, trace = [self.error_queue.get() for _ in range(failed)][-1]
        self.abandon()
        raise WorkerError(f"worker {index} failed: {value}") from _RemoteTraceback(trace)

    def abandon(self) -> None:
        """End all workers at once, whatever they are doing."""
        for process in self.processes:
            process.kill()
        for process in self.processes:
            process.join()
        for pipe in self.parent_pipes:
            pipe.close()
        self.closed = True


def _work(
    index: int,
    env_fn: Callable[[], gymnasium.Env[Any, Any]],
    pipe: Connection,
    parent_pipe: Connection,
    shared_memory: Any,
    error_queue: Any,
    *more: Any,
) -> None:
    """Work as Gymnasium's workers do, but tell why an environment could not be made."""
    try:
        env = env_fn()
    except Exception as error:  # whatever an environment raises
        pipe.recv()  # the first word, which is answered
        error_queue.put((index, type(error), str(error), traceback.format_exc()))
        pipe.send((None, False))
        return
    _async_worker(index, lambda: env, pipe, parent_pipe, shared_memory, error_queue, *more)


class _RemoteTraceback(Exception):
    """Shows a worker's traceback as the cause of the error raised here."""

    def __str__(self) -> str:
        return f"\n{self.args[0]}"


class _WatchedPipe:
    """A pipe to a worker that notices when the worker is gone.

    Under fork other workers hold copies of the pipe's far end, so its closing alone tells nothing.
    """

    def __init__(self, pipe: Connection, process: BaseProcess, owner: ParallelEnv) -> None:
        self._pipe = pipe
        self._process = process
        self._owner = owner

    @property
    def closed(self) -> bool:
        """Whether this end is closed."""
        return self._pipe.closed

    def close(self) -> None:
        """Close this end."""
        self._pipe.close()

    def poll(self, timeout: float | None = 0.0) -> bool:
        """Whether there is something to receive, or to learn of the worker's end."""
        return bool(wait([self._pipe, self._process.sentinel], timeout))

    def send(self, message: Any) -> None:
        """Send a command to the worker.

        :raises WorkerError: the worker is gone
        """
        try:
            self._pipe.send(message)
        except (BrokenPipeError, ConnectionResetError):
            self._fail()

    def recv(self) -> Any:
        """Return what the worker answers.

        :raises WorkerError: the worker is gone
        """
        if self._pipe not in wait([self._pipe, self._process.sentinel]):
            self._fail()
        try:
            return self._pipe.recv()
        except (EOFError, ConnectionResetError):
            self._fail()

    def _fail(self) -> NoReturn:
        self._process.join(timeout=1.0)
        name, code = self._process.name, self._process.exitcode
        self._owner.abandon()
        raise WorkerError(f"{name} ended with exit code {code} in the middle of its work")
