"""Recording the actions of a person, a policy or an expert of another kind."""

import fcntl
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import wrappers
from gymnasium.utils import RecordConstructorArgs

from bulletarm_gym.demonstrations import plain
from bulletarm_gym.demonstrations.collecting import describe, writable
from bulletarm_gym.demonstrations.episodes import Demonstrations, Episode, Recorder, Step, assemble, load
from bulletarm_gym.env import Action, ManipulationEnv, Observation

PASSIVE = (
    wrappers.OrderEnforcing,
    wrappers.PassiveEnvChecker,
    wrappers.RecordEpisodeStatistics,
    wrappers.RecordVideo,
    wrappers.HumanRendering,
    wrappers.RenderCollection,
)
"""Wrappers that override ``step()`` and change neither actions nor observations."""
MONITOR = "stable_baselines3.common.monitor.Monitor"
"""Another such wrapper, of a library that this package does not import."""


class RecordDemonstrations(
    gymnasium.Wrapper[Observation, Action, Observation, Action], RecordConstructorArgs
):
    """Wrapper that writes successful episodes to a file like those of :func:`collect`.

    Several recorders, also of several processes, can write to one file. :meth:`close` adds the attempts since
    the last success to the file's count.

    :param env: an environment of this package, without inner wrappers that change actions or observations
    :param path: file to write; episodes of an existing file are kept
    :param planner: name of the acting person or policy, for readers of the file
    :raises OSError: the folder of ``path`` cannot be made or written to
    :raises ValueError: ``path`` holds episodes of another environment or of other parameters, or is not a
        file of demonstrations; ``env`` is of another package or has such a wrapper
    """

    def __init__(
        self, env: gymnasium.Env[Observation, Action], path: str | os.PathLike[str], planner: str = "human"
    ) -> None:
        RecordConstructorArgs.__init__(self, path=os.fspath(path), planner=planner)
        gymnasium.Wrapper.__init__(self, env)
        self._inner = _recorded_env(env)
        self._about = describe(self._inner)
        self._path, self._planner = writable(Path(path).absolute()), planner
        self._count = len(self._earlier() or ())
        self._unsaved: list[Episode] = []
        self._attempts = 0  # since the last write
        self._observations: list[Observation] = []
        self._steps: list[Step] = []
        self._seed: int | None = None
        self._initial_state = self._state = ""

    def __len__(self) -> int:
        """Return the number of episodes, including those of the file at the last write."""
        return self._count + len(self._unsaved)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode."""
        observation, info = self.env.reset(seed=seed, options=options)
        at_state = "state" in (options or {})
        self._begin(plain.dumps(self._inner.get_state()), observation, None if at_state else seed)
        return observation, info

    def _begin(self, state: str, observation: Observation, seed: int | None) -> None:
        self._initial_state = self._state = state
        self._observations, self._steps, self._seed = [observation], [], seed
        self._attempts += 1

    def step(self, action: Action) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Carry out an action; at the end of a successful episode, write the file.

        If the state has changed since the last step, as by ``set_state()``, the episode begins there.
        """
        state = plain.dumps(self._inner.get_state())
        if state != self._state:
            if self._observations and not self._steps:
                self._attempts -= 1  # the attempt that the reset began goes on
            self._begin(state, self._inner.observe(), None)
        action = self._inside(action)
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._state = plain.dumps(self._inner.get_state())
        self._observations.append(observation)
        self._steps.append((action, float(reward), terminated, truncated))
        if (terminated or truncated) and info["is_success"]:
            episode = assemble(self._observations, self._steps, self._seed, self._initial_state)
            self._unsaved.append(episode)
            self._write()
        return observation, float(reward), terminated, truncated, info

    def _inside(self, action: Action) -> Action:
        """Return the action that the environment carries out; one of another shape as it is."""
        space: Any = self._inner.action_space
        array: Action = np.asarray(action, space.dtype)
        return array.clip(space.low, space.high) if array.shape == space.shape else array

    def close(self) -> None:
        """Write the number of attempts and close the environment."""
        if self._attempts:
            self._write()
        super().close()

    def demonstrations(self) -> Demonstrations:
        """Return the episodes of the file and those of this recorder."""
        recorder = Recorder(self._about)
        earlier = self._earlier()
        for episode in [*(earlier or ()), *self._unsaved]:
            recorder.add(episode)
        recorder.attempts = self._attempts + (0 if earlier is None else earlier.attempts)
        return recorder.finish(planner=self._planner, seed=None)

    def _write(self) -> None:
        with _locked(self._path):
            merged = self.demonstrations()
            merged.save(self._path)
        self._count, self._attempts, self._unsaved = len(merged), 0, []

    def _earlier(self) -> Demonstrations | None:
        """Return the content of the file, or None if there is no file.

        :raises ValueError: it is of another environment or of other parameters
        """
        if not self._path.exists():
            return None
        found = load(self._path)
        ours, theirs = _flat(self._about), _flat(found.about)
        same_id = theirs["env_id"] == ours["env_id"]
        other = [name for name in ours if theirs.get(name) != ours[name]] if same_id else ["env_id"]
        if other:
            must, got = (", ".join(f"{n}={made.get(n)!r}" for n in other) for made in (ours, theirs))
            raise ValueError(
                f"path must be a file of demonstrations with {must}, got {self._path} with {got}"
            )
        return found


def _recorded_env(env: gymnasium.Env[Any, Any]) -> ManipulationEnv:
    """Return the environment inside all wrappers.

    :raises ValueError: it is of another package, or a wrapper changes actions or observations
    """
    core = env.unwrapped
    if not isinstance(core, ManipulationEnv) or core.spec is None:
        raise ValueError(f"env must be an environment of this package or of a registered task, got {env}")
    while isinstance(env, gymnasium.Wrapper):
        kind = type(env)
        overrides = kind.step is not gymnasium.Wrapper.step or kind.reset is not gymnasium.Wrapper.reset
        passive = isinstance(env, (*PASSIVE, RecordDemonstrations))
        if overrides and not passive and f"{kind.__module__}.{kind.__qualname__}" != MONITOR:
            raise ValueError(
                "env must have no wrapper that changes actions or observations before they are recorded, "
                f"got {kind.__name__}. Put the recorder inside: {kind.__name__}(RecordDemonstrations(...))."
            )
        env = env.env
    return core


def _flat(about: dict[str, Any]) -> dict[str, Any]:
    """Return the environment's id and parameters by name, as JSON values."""
    values: dict[str, Any] = {"env_id": about["env_id"], **about["configuration"]}
    return json.loads(json.dumps(values))  # type: ignore[no-any-return]


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Keep other recorders of a file waiting."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.with_name(f".{path.name}.lock").open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
