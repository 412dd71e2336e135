"""Recording what anyone does in an environment: a person, a policy, an expert of another kind."""

import json
import os
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from bulletarm_gym.demonstrations import plain
from bulletarm_gym.demonstrations.collecting import recordable
from bulletarm_gym.demonstrations.episodes import Demonstrations, Episode, Recorder, Step, assemble, load
from bulletarm_gym.env import Action, ManipulationEnv, Observation


class RecordDemonstrations(gymnasium.Wrapper[Observation, Action, Observation, Action]):
    """Keeps the successful episodes of whoever acts, for a file like those of :func:`collect`.

    :param env: one of our environments, not wrapped so that it observes something else
    :param path: the file; if it is there, its episodes come first and the new ones behind them
    :param planner: who acts, for those who read the file
    :raises ValueError: ``path`` holds episodes of another environment or of other parameters, or is no file
        of demonstrations; ``env`` is none of ours
    """

    def __init__(
        self, env: gymnasium.Env[Observation, Action], path: str | os.PathLike[str], planner: str = "human"
    ) -> None:
        super().__init__(env)
        if not isinstance(env.unwrapped, ManipulationEnv) or env.spec is None:
            raise ValueError(f"env: got {env}, takes an environment of this package or of a registered task")
        self._inner = env.unwrapped
        self._env_id, self._configuration = env.spec.id, recordable(env.unwrapped)
        self._path, self._planner = Path(path), planner
        self._attempts, self._episodes = self._earlier()
        self._observations: list[Observation] = []
        self._steps: list[Step] = []
        self._seed, self._initial_state = 0, ""

    def _earlier(self) -> tuple[int, list[Episode]]:
        """Return what is in the file already: attempts and episodes."""
        if not self._path.exists():
            return 0, []
        found = load(self._path)
        ours = {"env_id": self._env_id, "configuration": json.loads(json.dumps(self._configuration))}
        for name, value in ours.items():
            if found.about[name] != value:
                raise ValueError(f"path: {self._path} has {name}={found.about[name]!r}, this has {value!r}")
        return found.attempts, list(found)

    def __len__(self) -> int:
        """Return the number of episodes, those of the file included."""
        return len(self._episodes)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode; without a seed one is drawn, for the file to tell."""
        self._seed = int(np.random.SeedSequence().generate_state(1)[0]) if seed is None else seed
        observation, info = self.env.reset(seed=self._seed, options=options)
        self._initial_state = plain.dumps(self._inner.get_state())
        self._observations, self._steps = [observation], []
        self._attempts += 1
        return observation, info

    def step(self, action: Action) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Act; an episode that ends in success is kept and, with all before it, written."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._observations.append(observation)
        self._steps.append((np.asarray(action, np.float32), float(reward), terminated, truncated))
        if (terminated or truncated) and info["is_success"]:
            self._episodes.append(assemble(self._observations, self._steps, self._seed, self._initial_state))
            self.demonstrations().save(self._path)
        return observation, float(reward), terminated, truncated, info

    def demonstrations(self) -> Demonstrations:
        """Return what has been recorded so far."""
        recorder = Recorder(self._env_id, self._configuration)
        for episode in self._episodes:
            recorder.add(episode)
        for _ in range(self._attempts - len(self._episodes)):
            recorder.add(None)
        return recorder.finish(planner=self._planner, seed=None)
