"""Collection of episodes of experts (paper, Expert Demonstrations)."""

import fcntl
import itertools
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from tqdm import tqdm

from bulletarm_gym.config import OPEN_LOOP, ParameterError, with_effect
from bulletarm_gym.config_checks import check_argument, choice, fraction, integer, mapping, optional
from bulletarm_gym.demonstrations import json_state
from bulletarm_gym.demonstrations.episodes import Demonstrations, Episode, Recorder, Step, load
from bulletarm_gym.env import Action, ManipulationEnv, Observation
from bulletarm_gym.experts import Waypoint
from bulletarm_gym.experts.pick_place import deconstruct
from bulletarm_gym.geometry import PlacementError
from bulletarm_gym.scene.state import EnvState

WAYPOINT, DECONSTRUCTION = "waypoint", "deconstruction"
TAKING_APART, NOISE = 1, 2
"""Streams of random numbers of an episode's seed."""


def collect(
    env_id: str,
    episodes: int,
    planner: str = WAYPOINT,
    *,
    seed: int | None = None,
    noise: float = 0.0,
    env_kwargs: Mapping[str, Any] | None = None,
    path: str | os.PathLike[str] | None = None,
    max_attempts: int | None = None,
    progress: bool | None = None,
) -> Demonstrations:
    """Collect successful episodes of an expert.

    The waypoint planner acts from the start. The deconstruction planner takes a finished structure apart, and
    the reversed actions build it again in the environment.

    :param env_id: id of the environment
    :param episodes: number of successful episodes
    :param planner: ``"waypoint"``, or ``"deconstruction"`` if the task builds a structure by pick and place
    :param seed: determines the episodes; without one it is sampled and stored
    :param noise: standard deviation of normal noise on each number of the waypoint planner's actions, in
        units of the action space. The noisy actions are stored
    :param env_kwargs: parameters of the environment
    :param path: new file to which the episodes are also written, atomically
    :param max_attempts: maximum number of episodes to begin, by default four for each successful one
    :param progress: show a progress bar, by default on a terminal
    :raises FileExistsError: ``path`` exists
    :raises ValueError: a parameter has an invalid value, or the planner cannot be used with this environment
    :raises RuntimeError: too few attempts succeeded
    """
    check_argument("episodes", episodes, integer(1))
    check_argument("seed", seed, optional(integer(0)))
    check_argument("max_attempts", max_attempts, optional(integer(1)))
    check_argument("env_kwargs", env_kwargs, optional(mapping))
    noise = check_argument("noise", noise, fraction)
    target = None if path is None else new_path(Path(path))
    seed = int(np.random.SeedSequence().generate_state(1)[0] if seed is None else seed)
    most = max_attempts or 4 * episodes
    is_silent = None if progress is None else not progress
    with closing(gymnasium.make(env_id, **(env_kwargs or {}))) as env:
        core = checked_env(env, "env_id")
        _check_planner(planner, core, noise)
        rng = np.random.default_rng(seed)
        recorder = Recorder({**describe(core), "planner": planner, "seed": seed, "noise": noise})
        with tqdm(desc=planner, total=episodes, unit="episode", disable=is_silent) as bar:
            while len(recorder) < episodes and recorder.attempts < most:
                episode = _attempt(core, planner, int(rng.integers(2**31)), noise)
                recorder.add(episode)
                bar.update(episode is not None)
    if len(recorder) < episodes:
        raise RuntimeError(
            f"{planner} expert of {env_id}: {len(recorder)} of {most} attempts succeeded, {episodes} needed"
        )
    demonstrations = recorder.finish()
    if target is not None:
        demonstrations.save(target)
    return demonstrations


def _check_planner(planner: str, env: ManipulationEnv, noise: float) -> None:
    """Raise ValueError with the reason if a planner cannot be used with an environment."""
    check_argument("planner", planner, choice(WAYPOINT, DECONSTRUCTION))
    obstacles = {
        "only pick and place can be reversed, not closed-loop actions": env.config.control != OPEN_LOOP,
        f"{type(env.task).__name__} has no arrange_goal()": not env.task.has_goal_structure,
        "on this surface blocks do not stay where they are placed": not env.scene.surface.keeps_poses,
        "noise must be 0": noise > 0.0,
    }
    reasons = [reason for reason, applies in obstacles.items() if applies]
    if planner == DECONSTRUCTION and reasons:
        raise ParameterError.of("planner", planner, repr(WAYPOINT), reasons[0])


def _attempt(env: ManipulationEnv, planner: str, seed: int, noise: float) -> Episode | None:
    """Act until the episode or the planner's actions end; return the episode if it succeeds."""
    actions = _expert_actions(env, seed, noise) if planner == WAYPOINT else _building_actions(env, seed)
    initial_state = json_state.dumps(env.get_state())
    observations, succeeds = [env.observe()], False
    steps: list[Step] = []
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(action)
        observations.append(observation)
        steps.append((action, reward, terminated, truncated))
        succeeds = info["is_success"]
        if terminated or truncated:
            break
    return Episode.of(observations, steps, seed, initial_state) if succeeds else None


def _expert_actions(env: ManipulationEnv, seed: int, noise: float) -> Iterator[Action]:
    """Begin an episode, and return the endless actions of the task's expert."""
    env.reset(seed=seed)
    actions = (env.expert_action() for _ in itertools.count())
    rng = np.random.default_rng((seed, NOISE))
    noisy = (action + noise * rng.standard_normal(action.shape) for action in actions)
    return (action.clip(-1.0, 1.0).astype(np.float32) for action in noisy) if noise else actions


def _building_actions(env: ManipulationEnv, seed: int) -> Iterator[Action]:
    """Take the finished structure apart, and return the actions that build it again; none if this fails."""
    _, info = env.reset(seed=seed, options={"start": "goal"})
    waypoints: Sequence[Waypoint] = ()
    if info["is_success"]:
        with suppress(PlacementError):
            waypoints = deconstruct(env.scene, np.random.default_rng((seed, TAKING_APART)))
    env.scene.begin()
    env.scene.settle()
    return (env.encode_action(env.tracker.next_move(iter([waypoint]))) for waypoint in waypoints)


def describe(env: ManipulationEnv) -> dict[str, Any]:
    """Return the id, components, parameters and action ranges of an environment, as files hold them."""
    assert env.spec is not None
    for name, thing in env.objects.items():
        raise ValueError(f"env_kwargs must have import paths 'module:attribute', got {name}={thing!r}")
    parameters = env.config.parameters()
    return {
        "env_id": env.spec.id,
        "recipe": env.recipe,
        "configuration": {n: v for n, v in parameters.items() if n not in with_effect("rendering")},
        "action_ranges": env.action_ranges,
    }


def checked_env(env: gymnasium.Env[Any, Any], argument: str) -> ManipulationEnv:
    """Return the environment inside all wrappers, or raise ValueError if it is of another package."""
    core = env.unwrapped
    if not isinstance(core, ManipulationEnv) or core.spec is None:
        must = "of an environment of this package or of a registered task"
        raise ValueError(f"{argument} must be {must}, got {env}")
    return core


def new_path(path: Path) -> Path:
    """Return a path to which a new file can be written, or raise ValueError or OSError."""
    if path.is_file():
        raise FileExistsError(f"path must be a new file, got {path}, which exists")
    return writable_path(path)


def writable_path(path: Path) -> Path:
    """Return a path to which a file can be written, or raise ValueError or OSError before a collection."""
    if path.is_dir():
        raise ValueError(f"path must be a file such as {path / 'demonstrations.h5'}, got the folder {path}")
    path.parent.mkdir(parents=True, exist_ok=True)
    if not os.access(path.parent, os.W_OK):
        raise PermissionError(f"path must be in a writable folder, got {path}")
    return path


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
        with self._path.with_name(f".{self._path.name}.lock").open("a") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # other recorders of the file wait
            saved = self._saved()
            recorder = Recorder(self._about, None if saved is None else saved.image)
            for episode in self._unsaved:
                recorder.add(episode)
            recorder.attempts += self._attempts - len(self._unsaved)
            merged = recorder.finish()
            merged.save(self._path)
        self._count, self._attempts, self._unsaved = len(merged), 0, []

    def _saved(self) -> Demonstrations | None:
        """Return the content of the file, which must fit the environment, or None if there is no file."""
        if not self._path.exists():
            return None
        found = load(self._path)
        abouts = json.loads(json.dumps([self._about, found.about]))
        ours, theirs = (
            {"env_id": about["env_id"], **about["recipe"], **about["configuration"]} for about in abouts
        )
        if other := [name for name in ours if theirs.get(name) != ours[name]]:
            must, got = (", ".join(f"{n}={made.get(n)!r}" for n in other) for made in (ours, theirs))
            raise ValueError(
                f"path must be a file of demonstrations with {must}, got {self._path} with {got}"
            )
        return found


def _recorded_env(env: gymnasium.Env[Any, Any]) -> ManipulationEnv:
    """Return the environment inside all wrappers, which must not change actions or observations."""
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
