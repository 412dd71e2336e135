"""Environments that any process may step, because their state is data.

The home of such an environment keeps it with all its wrappers, other processes have copies of what is inside
the wrappers, and what moves is the state. The home goes through its wrappers in any case: where a copy was
stepped, they get what it returned.
"""

from __future__ import annotations

import pickle
from dataclasses import dataclass
from multiprocessing.synchronize import Lock
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from sb3_extensions.vec_env import requests
from sb3_extensions.vec_env.requests import AnyEnv, Stepped

Transition = tuple[Any, Any, bool, bool, dict[str, Any]]

GET_STATE, SET_STATE = "get_state", "set_state"
READING = (GET_STATE, "expert_action")
"""Methods that change nothing."""


class Begun(NamedTuple):
    """
    A new episode.

    :param observation: its first observation
    :param info: what ``reset()`` returned beside it
    :param state: of the environment then
    """

    observation: Any
    info: dict[str, Any]
    state: Any


@dataclass(frozen=True)
class Outcome:
    """
    What became of a copy.

    :param action: what it did
    :param transition: what ``step()`` returned
    :param state: of the environment then
    :param begun: the episode that follows, if this one was over
    """

    action: Any
    transition: Transition
    state: Any
    begun: Begun | None

    @property
    def last_state(self) -> Any:
        """The state that the copy is in."""
        return self.state if self.begun is None else self.begun.state


class Copy:
    """
    An environment without its wrappers, away from home.

    :param pickled: the environment
    :param lock: whoever has it may step the environment
    """

    def __init__(self, pickled: bytes, lock: Lock) -> None:
        self.env: Any = pickle.loads(pickled)
        self.lock = lock

    def step(self, action: Any, state: bytes | None) -> Outcome:
        """
        Do what its home would do.

        :param action: as the environment gets it
        :param state: the present state, pickled; None if the copy is in it
        :return: what became of it
        """
        if state is not None:
            self.env.set_state(pickle.loads(state))
        transition = self.env.step(action)
        after, begun = self.env.get_state(), None
        if transition[2] or transition[3]:
            observation, info = self.env.reset()
            begun = Begun(observation, info, self.env.get_state())
        return Outcome(action, transition, after, begun)


class Lent:
    """
    An environment at home, of which there are copies.

    :param env: with its wrappers
    :param lock: whoever has it may step the environment
    :param pickled: the environment without its wrappers
    """

    def __init__(self, env: AnyEnv, lock: Lock, pickled: bytes) -> None:
        self.lock = lock
        self.pickled = pickled
        self.version = 0
        """Grows with every change of the state: a copy of another version is not in it."""
        self.stays = False
        """Whether it is lent no more: somebody may have changed what is not in the state."""
        self.agrees = False
        """Whether the copy that was stepped last is in the present state."""
        self._touched = False
        self._inner: Any = env.unwrapped
        self._ahead: Any | None = None  # the state it is to be in, where a copy was faster
        self._outcome: Outcome | None = None
        self._begun: Begun | None = None
        door = _Door(self._inner, self)
        self.env = door if env is self._inner else env
        if env is not self._inner:
            _innermost(env).env = door

    @property
    def state(self) -> Any:
        """The present state."""
        return self._inner.get_state() if self._ahead is None else self._ahead

    def step(self, action: Any, outcome: Outcome | None = None) -> Stepped:
        """
        Step it with all its wrappers.

        :param action: as the outermost wrapper gets it
        :param outcome: what became of a copy that was in the present state
        :return: what the step returned
        """
        self._touched, self._outcome = False, outcome
        stepped = requests.step(self.env, action)
        self._outcome = self._begun = None
        self.agrees = outcome is not None and self._ahead is outcome.last_state
        # Wrappers that look inside, or act otherwise than they are told, will do so again
        self.stays |= self._touched or (outcome is not None and not self.agrees)
        return stepped

    def called(self, name: str) -> None:
        """
        Note what a method may have done.

        :param name: of the method that was called
        """
        self.version += name not in READING
        self.stays |= self._touched and name not in (*READING, SET_STATE)

    def watch(self) -> None:
        """See whether somebody comes to the environment from now on."""
        self._touched = False

    def enter(self) -> Any:
        """Return the environment in its present state to somebody who may change it."""
        self._touched = True
        return self._present()

    def _present(self) -> Any:
        if self._ahead is not None:
            self._inner.set_state(self._ahead)
            self._ahead = None
        return self._inner

    def step_inside(self, action: Any) -> Transition:
        """Step without wrappers, or return what a copy returned if that did the same."""
        outcome, self._outcome = self._outcome, None
        self.version += 1
        if outcome is None or not np.array_equal(action, outcome.action):
            return self._present().step(action)  # type: ignore[no-any-return]
        self._ahead, self._begun = outcome.state, outcome.begun
        return outcome.transition

    def reset_inside(self, seed: int | None, options: dict[str, Any] | None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode without wrappers, or return what a copy returned that has begun one."""
        begun, self._begun = self._begun, None
        self.version += 1
        if begun is None or seed is not None or options:
            return self._present().reset(seed=seed, options=options)  # type: ignore[no-any-return]
        self._ahead = begun.state
        return begun.observation, begun.info


class _Door(gym.Wrapper[Any, Any, Any, Any]):
    """The innermost wrapper of an environment that is lent."""

    def __init__(self, env: AnyEnv, lent: Lent) -> None:
        self._lent = lent
        super().__init__(env)
        # Wrappers ask for these in every step, and it is no reason to look inside
        self._observation_space, self._action_space = env.observation_space, env.action_space
        self._metadata = env.metadata

    @property
    def env(self) -> Any:
        return self._lent.enter()

    @env.setter
    def env(self, env: AnyEnv) -> None:
        """It is the one that is lent."""

    def step(self, action: Any) -> Transition:
        return self._lent.step_inside(action)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        return self._lent.reset_inside(seed, options)


def pickled_if_movable(env: AnyEnv) -> bytes | None:
    """
    Look whether copies of an environment can stand in for it.

    :param env: with its wrappers
    :return: what is inside them, pickled; None if its state cannot move: it has none to get and set, or it
        cannot be pickled, or it has a window
    """
    inner = env.unwrapped
    if not (hasattr(inner, GET_STATE) and hasattr(inner, SET_STATE)) or inner.render_mode == "human":
        return None
    try:
        return pickle.dumps(inner)
    except Exception:  # whatever the parts of an unknown environment raise
        return None


def _innermost(env: Any) -> Any:
    while isinstance(env.env, gym.Wrapper):
        env = env.env
    return env
