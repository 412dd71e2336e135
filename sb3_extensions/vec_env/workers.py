"""Processes that step environments."""

from __future__ import annotations

import contextlib
import pickle
import signal
import time
import traceback
from collections.abc import Callable, Mapping
from multiprocessing.connection import Connection, wait
from multiprocessing.synchronize import Lock
from typing import Any, NamedTuple, NoReturn

import gymnasium as gym
from gymnasium.vector.utils import read_from_shared_memory
from stable_baselines3.common.vec_env.base_vec_env import CloudpickleWrapper

from sb3_extensions.vec_env import requests
from sb3_extensions.vec_env.lending import Copy, Outcome
from sb3_extensions.vec_env.requests import AnyEnv

SPIN = 1e-4
"""Seconds of looking for a message before going to sleep: to be woken takes about as long."""
PATIENCE = 5.0
"""Seconds that a worker has to close its environments."""
STEP, ASK, CLOSE = range(3)
PROTOCOL = pickle.HIGHEST_PROTOCOL
"""Pipes of ``multiprocessing`` pickle more, and so slower, than passes here."""

Request = Callable[..., Any]
"""One of :mod:`~sb3_extensions.vec_env.requests`."""


class WorkerError(RuntimeError):
    """A worker process has ended, or failed with the traceback that this error is raised from."""


class SharedArrays(NamedTuple):
    """
    Observations in memory that processes share.

    :param space: of an environment's observations
    :param buffer: from ``gymnasium.vector.utils.create_shared_memory``
    :param rows: environments
    """

    space: gym.Space[Any]
    buffer: Any
    rows: int

    def arrays(self) -> Any:
        """The memory as arrays in the structure of the space, an environment a row."""
        return read_from_shared_memory(self.space, self.buffer, self.rows)


def write(arrays: Any, row: int, observation: Any) -> None:
    """
    Write an observation into arrays.

    :param arrays: of all environments, in the structure of the space
    :param row: of the environment
    :param observation: in the structure of the space
    """
    if isinstance(arrays, Mapping):
        for key, array in arrays.items():
            write(array, row, observation[key])
    elif isinstance(arrays, tuple):
        for array, part in zip(arrays, observation, strict=True):
            write(array, row, part)
    else:
        arrays[row] = observation


class Worker:
    """
    A process that steps some environments, seen from the one that started it.

    :param context: of ``multiprocessing``
    :param number: of the worker
    :param makers: make its environments, by their rows in the vector environment
    :param copies: environments that it may step besides, by their rows: pickled, with their locks
    :param shared: where observations go
    """

    def __init__(
        self,
        context: Any,
        number: int,
        makers: Mapping[int, Callable[[], AnyEnv]],
        copies: Mapping[int, tuple[bytes, Lock]],
        shared: SharedArrays,
    ) -> None:
        self.rows = list(makers)
        self.versions = dict.fromkeys(copies, -1)
        """Versions of the states that its copies are in, by rows."""
        self._pipe, there = context.Pipe()
        self.process = context.Process(
            target=_work,
            name=f"SplitVecEnv worker {number}",
            args=(there, self._pipe, CloudpickleWrapper(dict(makers)), dict(copies), shared),
            daemon=True,
        )
        self.process.start()
        there.close()

    def step(self, actions: Any, offers: Mapping[int, tuple[Any, bytes | None]]) -> None:
        """
        Have it step; :meth:`receive` returns its steps and, by rows, outcomes of the copies that it took.

        :param actions: of its environments
        :param offers: by rows, actions of what it may take, with the state where its copy is in another
        :raises WorkerError: if it is gone
        """
        self._send(STEP, actions, offers)

    def ask(self, request: Request, arguments: Mapping[int, tuple[Any, ...]]) -> None:
        """
        Ask its environments something; :meth:`receive` returns the answers.

        :param request: what
        :param arguments: of the request, by rows
        :raises WorkerError: if it is gone
        """
        self._send(ASK, request, arguments)

    def receive(self) -> Any:
        """
        Return what it answers.

        :raises WorkerError: if it has failed, or is gone
        """
        _look(self._pipe)
        if self._pipe not in wait([self._pipe, self.process.sentinel]):
            self._fail()
        try:
            good, answer = pickle.loads(self._pipe.recv_bytes())
        except (EOFError, ConnectionResetError):
            self._fail()
        if not good:
            what, trace = answer
            raise WorkerError(f"{self.process.name} failed: {what}") from _RemoteTraceback(trace)
        return answer

    def _send(self, *message: Any) -> None:
        try:
            self._pipe.send_bytes(pickle.dumps(message, PROTOCOL))
        except (BrokenPipeError, ConnectionResetError):
            self._fail()

    def _fail(self) -> NoReturn:
        self.process.join(timeout=1.0)
        ended = f"ended with exit code {self.process.exitcode} in the middle of its work"
        raise WorkerError(f"{self.process.name} {ended}")

    def dismiss(self) -> None:
        """Tell it to end."""
        with contextlib.suppress(OSError):
            self._pipe.send_bytes(pickle.dumps((CLOSE,)))

    def end(self, patience: float = 0.0) -> None:
        """
        Wait for its end, and bring it about then.

        :param patience: how long to wait, in seconds
        """
        self.process.join(timeout=patience)
        self.process.kill()
        self.process.join()
        self._pipe.close()


class _RemoteTraceback(Exception):
    """Shows a worker's traceback as the cause of an error raised here."""

    def __str__(self) -> str:
        return f"\n{self.args[0]}"


def _look(pipe: Connection) -> None:
    """Look for a message for a while, awake."""
    end = time.perf_counter() + SPIN
    while not pipe.poll() and time.perf_counter() < end:
        pass


def _work(
    pipe: Connection,
    other_end: Connection,
    makers: Any,
    copies: Mapping[int, tuple[bytes, Lock]],
    shared: SharedArrays,
) -> None:
    """Do what comes through the pipe, until it says to end or nobody is at its other end."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all: who called closes its workers
    other_end.close()
    try:
        desk = _Desk(makers.var, copies, shared)
        while (message := _next(pipe))[0] != CLOSE:
            pipe.send_bytes(pickle.dumps((True, desk.answer(*message)), PROTOCOL))
        desk.close()
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return
    except BaseException as error:
        trace = traceback.format_exc()
        with contextlib.suppress(OSError):
            pipe.send_bytes(pickle.dumps((False, (f"{type(error).__name__}: {error}", trace))))


def _next(pipe: Connection) -> Any:
    _look(pipe)
    return pickle.loads(pipe.recv_bytes())


class _Desk:
    """What a worker works at: its environments, and copies of others."""

    def __init__(
        self,
        makers: Mapping[int, Callable[[], AnyEnv]],
        copies: Mapping[int, tuple[bytes, Lock]],
        shared: SharedArrays,
    ) -> None:
        self._envs = {row: make() for row, make in makers.items()}
        self._copies = {row: Copy(*copy) for row, copy in copies.items()}
        self._arrays = shared.arrays()

    def answer(self, command: int, *arguments: Any) -> Any:
        return self._step(*arguments) if command == STEP else self._ask(*arguments)

    def _step(
        self, actions: Any, offers: Mapping[int, tuple[Any, bytes | None]]
    ) -> tuple[list[tuple[Any, ...]], dict[int, Outcome]]:
        steps = []  # plain tuples, which are pickled in half the time
        for (row, env), action in zip(self._envs.items(), actions, strict=True):
            stepped = requests.step(env, action)
            write(self._arrays, row, stepped.observation)
            steps.append((None, *stepped[1:]))
        outcomes = {}
        for row, (action, state) in offers.items():
            if self._copies[row].lock.acquire(block=False):
                outcomes[row] = self._copies[row].step(action, state)
        return steps, outcomes

    def _ask(self, request: Request, arguments: Mapping[int, tuple[Any, ...]]) -> list[Any]:
        return [request(self._envs[row], *given) for row, given in arguments.items()]

    def close(self) -> None:
        for env in (*self._envs.values(), *(copy.env for copy in self._copies.values())):
            env.close()
