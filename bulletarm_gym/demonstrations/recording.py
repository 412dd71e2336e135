"""Recording of the episodes of a person, a policy or another expert."""

import fcntl
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from bulletarm_gym.demonstrations import json_state
from bulletarm_gym.demonstrations.collecting import checked_env, describe, writable_path
from bulletarm_gym.demonstrations.episodes import Demonstrations, Episode, Recorder, Step, load
from bulletarm_gym.env import Action, ManipulationEnv, Observation
from bulletarm_gym.scene.state import EnvState

PASSIVE = (
    *("OrderEnforcing", "PassiveEnvChecker", "RecordEpisodeStatistics", "RecordVideo", "HumanRendering"),
    *("RenderCollection", "Monitor", "RecordDemonstrations"),
)
"""Wrappers that override ``step()`` and change neither actions nor observations; ``Monitor`` is of SB3."""
EPISODES_PER_WRITE = 0.02
"""Number of unsaved episodes, relative to the saved ones, after which the file is written."""


class RecordDemonstrations(
    gymnasium.Wrapper[Observation, Action, Observation, Action], RecordConstructorArgs
):
    """Wrapper that writes successful episodes to a file, as :func:`collect` does.

    The file is written after each of the first 50 successes, later after every 2 % more episodes, and by
    :meth:`close`, which also adds the attempts since the last success. Several recorders, also of several
    processes, can write to one file.

    :param env: environment of this package, without inner wrappers that change actions or observations
    :param path: file to write; episodes of an existing file are kept
    :param planner: name of the acting person or policy in a new file
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
        self._about = {**describe(self._inner), "planner": planner, "seed": None, "noise": 0.0}
        self._path = writable_path(Path(path).absolute())
        self._count = len(self._saved() or ())
        self._unsaved: list[Episode] = []
        self._attempts = 0  # since the last write
        self._observations: list[Observation] = []
        self._steps: list[Step] = []
        self._seed: int | None = None
        self._initial_state = ""
        self._state: EnvState | None = None

    def __len__(self) -> int:
        """Return the number of episodes, including the episodes in the file at the last write."""
        return self._count + len(self._unsaved)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._begin(observation, None if "state" in (options or {}) else seed)
        return observation, info

    def _begin(self, observation: Observation, seed: int | None) -> None:
        self._state = self._inner.get_state()
        self._initial_state = json_state.dumps(self._state)
        self._observations, self._steps, self._seed = [observation], [], seed
        self._attempts += 1

    def step(self, action: Action) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Carry out an action, and record the episode at its successful end.

        If the state has changed since the last step, as by ``set_state()``, the episode begins there.
        """
        if self._inner.get_state() != self._state:
            if self._observations and not self._steps:
                self._attempts -= 1  # this continues the attempt that the reset began
            self._begin(self._inner.observe(), None)
        action = np.asarray(action, np.float32).clip(-1.0, 1.0)
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._state = self._inner.get_state()
        self._observations.append(observation)
        self._steps.append((action, float(reward), terminated, truncated))
        if (terminated or truncated) and info["is_success"]:
            episode = Episode.of(self._observations, self._steps, self._seed, self._initial_state)
            self._unsaved.append(episode)
            if len(self._unsaved) >= EPISODES_PER_WRITE * self._count:
                self._write()
        return observation, float(reward), terminated, truncated, info

    def close(self) -> None:
        """Write the episodes and the number of attempts, and close the environment."""
        if self._attempts:
            self._write()
        super().close()

    def _write(self) -> None:
        """Add the unsaved episodes and attempts to the file."""
        with _locked(self._path):
            saved = self._saved()
            recorder = Recorder(self._about, None if saved is None else saved.image)
            for episode in self._unsaved:
                recorder.add(episode)
            recorder.attempts += self._attempts - len(self._unsaved)
            merged = recorder.finish()
            merged.save(self._path)
        self._count, self._attempts, self._unsaved = len(merged), 0, []

    def _saved(self) -> Demonstrations | None:
        """Return the content of the file, or None if there is no file.

        :raises ValueError: it is of another environment or of other parameters
        """
        if not self._path.exists():
            return None
        found = load(self._path)
        abouts = json.loads(json.dumps([self._about, found.about]))
        ours, theirs = ({"env_id": about["env_id"], **about["configuration"]} for about in abouts)
        if other := [name for name in ours if theirs.get(name) != ours[name]]:
            must, got = (", ".join(f"{n}={made.get(n)!r}" for n in other) for made in (ours, theirs))
            raise ValueError(
                f"path must be a file of demonstrations with {must}, got {self._path} with {got}"
            )
        return found


def _recorded_env(env: gymnasium.Env[Any, Any]) -> ManipulationEnv:
    """Return the environment inside all wrappers.

    :raises ValueError: it is of another package, or a wrapper changes actions or observations
    """
    core = checked_env(env, "env")
    while isinstance(env, gymnasium.Wrapper):
        kind = type(env)
        overrides = kind.step is not gymnasium.Wrapper.step or kind.reset is not gymnasium.Wrapper.reset
        if overrides and kind.__name__ not in PASSIVE:
            raise ValueError(
                "env must have no wrapper that changes actions or observations before they are recorded, "
                f"got {kind.__name__}. Put the recorder inside: {kind.__name__}(RecordDemonstrations(...))."
            )
        env = env.env
    return core


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Make other recorders of a file wait."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.with_name(f".{path.name}.lock").open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
