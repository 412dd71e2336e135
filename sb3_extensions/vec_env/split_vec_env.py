"""A vector environment whose calling process does its share."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from copy import deepcopy
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.vector.utils import create_shared_memory
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

from sb3_extensions.vec_env import requests
from sb3_extensions.vec_env.lending import Lent, Outcome, pickled_if_movable
from sb3_extensions.vec_env.requests import AnyEnv, Stepped
from sb3_extensions.vec_env.workers import PATIENCE, Request, SharedArrays, Worker, write


class SplitVecEnv(VecEnv):
    """
    Environments divided among this process and workers, a worker for each further core.

    ``SubprocVecEnv`` has a process for each environment and passes every observation through a pipe, while
    the process that called waits. Here each process steps several, the calling one among them, and
    observations lie in shared memory. Environments that are left over, as the fifth of five on two cores, are
    stepped by whoever is done first. They need ``get_state()`` and ``set_state(state)`` that change nothing
    else and hold the random generator, too, as checkpoints do; without them they stay in this process.

    It returns what ``DummyVecEnv`` returns; what it gives out are copies, as with ``SubprocVecEnv``. An error
    in a worker arrives with its traceback, a killed worker is named. After any error it is closed.

    :param env_fns: make an environment each
    :param processes: how many share the work, this one included; by default as many as there are cores for it
    :param start_method: of the workers: ``"forkserver"`` (the default, where there is such), ``"spawn"`` or
        ``"fork"``
    :raises ValueError: if there is no environment to make, or ``processes`` is not positive
    """

    def __init__(
        self,
        env_fns: Sequence[Callable[[], AnyEnv]],
        processes: int | None = None,
        start_method: str | None = None,
    ) -> None:
        if not env_fns:
            raise ValueError("env_fns: got none, takes at least one")
        if processes is not None and processes < 1:
            raise ValueError(f"processes: got {processes}, takes at least 1")
        self.waiting = self.closed = False
        self._workers: list[Worker] = []
        self._actions: npt.NDArray[Any] = np.empty(0)
        self._offered: list[int] = []
        count = min(processes or _cores(), len(env_fns))
        share = len(env_fns) // count
        left_over = range(share * count, len(env_fns))
        self._envs = {row: env_fns[row]() for row in (*range(share), *left_over)}
        context: Any = multiprocessing.get_context(start_method or _start_method())
        self._lent = self._lend(left_over, context) if count > 1 else {}
        space, action_space = self._envs[0].observation_space, self._envs[0].action_space
        shared = SharedArrays(space, create_shared_memory(space, len(env_fns), context), len(env_fns))
        self._arrays = shared.arrays()
        copies = {row: (lent.pickled, lent.lock) for row, lent in self._lent.items()}
        with self._closed_by_errors():
            for number in range(1, count):
                makers = {row: env_fns[row] for row in range(number * share, (number + 1) * share)}
                self._workers.append(Worker(context, number, makers, copies, shared))
            super().__init__(len(env_fns), space, action_space)

    def _lend(self, rows: Sequence[int], context: Any) -> dict[int, Lent]:
        found = {}
        for row in rows:
            if (pickled := pickled_if_movable(self._envs[row])) is not None:
                found[row] = Lent(self._envs[row], context.Lock(), pickled)
                self._envs[row] = found[row].env
        return found

    # Steps

    def step_async(self, actions: npt.NDArray[Any]) -> None:
        """
        Have the workers step.

        :param actions: one an environment
        :raises WorkerError: if a worker is gone
        """
        with self._closed_by_errors():
            self._check_idle()
            self._actions = actions
            self._offered = [row for row, lent in self._lent.items() if not lent.stays]
            states = {
                row: pickle.dumps(self._lent[row].state, pickle.HIGHEST_PROTOCOL) for row in self._offered
            }
            self.waiting = True
            for worker in self._workers:
                known = {row: worker.versions[row] == self._lent[row].version for row in states}
                offers = {row: (actions[row], None if known[row] else state) for row, state in states.items()}
                worker.step(actions[worker.rows], offers)

    def step_wait(self) -> VecEnvStepReturn:
        """
        Step the environments of this process and those that no worker took, and wait for the workers.

        :return: observations, rewards, whether episodes were over, infos
        :raises WorkerError: if a worker has failed, or is gone
        """
        with self._closed_by_errors():
            steps = {row: self._step(row) for row in self._envs if row not in self._offered}
            for row in self._offered:
                if self._lent[row].lock.acquire(block=False):
                    steps[row] = self._step(row)
            for worker in self._workers:
                own, outcomes = worker.receive()
                steps.update((row, Stepped(*step)) for row, step in zip(worker.rows, own, strict=True))
                for row, outcome in outcomes.items():
                    steps[row] = self._step(row, outcome)
                    worker.versions[row] = self._lent[row].version if self._lent[row].agrees else -1
            for row in self._offered:
                self._lent[row].lock.release()
        self.waiting = False
        return self._collect([steps[row] for row in range(self.num_envs)])

    def _step(self, row: int, outcome: Outcome | None = None) -> Stepped:
        """Step an environment of this process; if it was lent, the copy may have been stepped already."""
        if row in self._lent:
            stepped = self._lent[row].step(self._actions[row], outcome)
        else:
            stepped = requests.step(self._envs[row], self._actions[row])
        write(self._arrays, row, stepped.observation)
        return stepped._replace(info=deepcopy(stepped.info))  # some environments go on writing into theirs

    def _collect(self, steps: Sequence[Stepped]) -> VecEnvStepReturn:
        for row, stepped in enumerate(steps):
            if stepped.reset_info is not None:
                self.reset_infos[row] = stepped.reset_info
        rewards = np.array([stepped.reward for stepped in steps], np.float32)
        dones = np.array([stepped.done for stepped in steps])
        return deepcopy(self._arrays), rewards, dones, [stepped.info for stepped in steps]

    def reset(self) -> VecEnvObs:
        """
        Begin episodes, with the seeds and options that were set.

        :return: first observations
        """
        given = {row: (self._seeds[row], self._options[row]) for row in range(self.num_envs)}
        for row, (observation, info) in enumerate(self._ask(requests.reset, given)):
            write(self._arrays, row, observation)
            self.reset_infos[row] = info
        self._reset_seeds()
        self._reset_options()
        return deepcopy(self._arrays)  # type: ignore[no-any-return]

    # What is asked of single environments

    def _ask(self, request: Request, given: Mapping[int, tuple[Any, ...]]) -> list[Any]:
        """
        Ask environments something, all processes at the same time.

        :param request: what
        :param given: arguments of the request, by rows
        :return: the answers, in the order of the rows
        """
        with self._closed_by_errors():
            self._check_idle()
            parts = [
                (worker, part)
                for worker in self._workers
                if (part := {row: given[row] for row in given if row in worker.rows})
            ]
            for worker, part in parts:
                worker.ask(request, part)
            answers = {row: request(self._envs[row], *given[row]) for row in given if row in self._envs}
            for worker, part in parts:
                answers.update(zip(part, worker.receive(), strict=True))
        return [answers[row] for row in given]

    def _ask_alike(self, request: Request, indices: VecEnvIndices, *arguments: Any) -> list[Any]:
        return self._ask(request, dict.fromkeys(self._get_indices(indices), arguments))

    def has_attr(self, attr_name: str) -> bool:
        """
        Whether all environments have an attribute.

        :param attr_name: its name
        :return: whether they, or wrappers of theirs, have it
        """
        return all(self._ask_alike(requests.has, None, attr_name))

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """
        Read an attribute.

        :param attr_name: its name
        :param indices: of environments, all by default
        :return: copies of its values
        """
        return [
            pickle.loads(pickle.dumps(item)) for item in self._ask_alike(requests.get, indices, attr_name)
        ]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """
        Set an attribute of the outermost wrappers.

        :param attr_name: its name
        :param value: its value
        :param indices: of environments, all by default
        """
        with self._noticed(""):
            self._ask_alike(requests.put, indices, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """
        Call a method.

        :param method_name: its name
        :param method_args: its arguments
        :param indices: of environments, all by default
        :param method_kwargs: its arguments by name
        :return: what it returned
        """
        with self._noticed(method_name):
            return self._ask_alike(requests.call, indices, method_name, method_args, method_kwargs)

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper[Any, Any, Any, Any]], indices: VecEnvIndices = None
    ) -> list[bool]:
        """
        Whether environments have a wrapper.

        :param wrapper_class: its class
        :param indices: of environments, all by default
        :return: for each whether it has
        """
        return self._ask_alike(requests.wrapped, indices, wrapper_class)

    def get_images(self) -> Sequence[npt.NDArray[np.uint8] | None]:
        """
        Draw the environments.

        :return: a picture each, none unless they were made with ``render_mode="rgb_array"``
        """
        if self.render_mode != "rgb_array":
            warnings.warn(f"render_mode: is {self.render_mode!r}, pictures need 'rgb_array'", stacklevel=2)
            return [None] * self.num_envs
        return self._ask_alike(requests.render, None)

    # The end

    def close(self) -> None:
        """Close all environments and end the workers; a second call does nothing."""
        if self.closed:
            return
        self.closed = True
        for worker in self._workers:
            worker.dismiss()
        for worker in self._workers:
            worker.end(PATIENCE)
        for env in self._envs.values():
            env.close()

    @contextmanager
    def _closed_by_errors(self) -> Iterator[None]:
        """Close everything where something goes wrong: nobody could tell what they have done."""
        try:
            yield
        except BaseException:
            self.closed = True
            for worker in self._workers:
                worker.end()
            for env in self._envs.values():
                with suppress(Exception):  # the first error is the one to tell
                    env.close()
            raise

    @contextmanager
    def _noticed(self, name: str) -> Iterator[None]:
        """Look what a call has done to environments that are lent."""
        for lent in self._lent.values():
            lent.watch()
        yield
        for lent in self._lent.values():
            lent.called(name)

    def _check_idle(self) -> None:
        if self.closed:
            raise RuntimeError("the environments are closed")
        if self.waiting:
            raise RuntimeError("step_async() waits for its step_wait()")


def _cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _start_method() -> str:
    known = multiprocessing.get_all_start_methods()
    return "forkserver" if "forkserver" in known else "spawn"
