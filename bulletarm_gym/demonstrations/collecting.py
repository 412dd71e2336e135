"""Collecting episodes of the experts (paper, Expert Demonstrations)."""

import itertools
import os
from collections.abc import Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from tqdm import tqdm

from bulletarm_gym.config import OPEN_LOOP
from bulletarm_gym.config_checks import check_argument, integer, mapping, optional
from bulletarm_gym.demonstrations import plain
from bulletarm_gym.demonstrations.episodes import Demonstrations, Episode, Recorder, assemble
from bulletarm_gym.env import Action, ManipulationEnv, Observation
from bulletarm_gym.experts.deconstruction import take_apart
from bulletarm_gym.geometry import PlacementError

WAYPOINT = "waypoint"
DECONSTRUCTION = "deconstruction"
ATTEMPTS_PER_EPISODE = 4
"""An expert that fails three times in four is broken: those of the paper succeed in nine of ten."""
TAKING_APART = 1
"""Stream of an episode's seed that is drawn from when a structure is taken apart."""


def collect(
    env_id: str,
    episodes: int,
    planner: str = WAYPOINT,
    *,
    seed: int | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    path: str | os.PathLike[str] | None = None,
    max_attempts: int | None = None,
    progress: bool | None = None,
) -> Demonstrations:
    """Collect successful episodes of an expert.

    The waypoint planner acts from the start. The deconstruction planner takes a finished structure apart; the
    actions that put it together again are then carried out, and these episodes are what is kept.

    :param env_id: of the environment
    :param episodes: how many successful ones
    :param planner: ``"waypoint"``, or ``"deconstruction"`` where a structure is built by pick and place
    :param seed: the same seed gives the same episodes; without one it is drawn, and recorded
    :param env_kwargs: parameters of the environment
    :param path: a file to write them to as well, whole or not at all
    :param max_attempts: episodes begun at most; by default four for each successful one
    :param progress: show a progress bar; by default on a terminal
    :raises ValueError: a parameter has a value it cannot take, or the planner cannot be used with this
        environment, with the reason
    :raises RuntimeError: too few attempts succeeded
    """
    check_argument("episodes", episodes, integer(1))
    check_argument("seed", seed, optional(integer(0)))
    check_argument("max_attempts", max_attempts, optional(integer(1)))
    check_argument("env_kwargs", env_kwargs, optional(mapping))
    target = None if path is None else writable(Path(path))
    seed = int(np.random.SeedSequence().generate_state(1)[0]) if seed is None else seed
    most = ATTEMPTS_PER_EPISODE * episodes if max_attempts is None else max_attempts
    with closing(_make(env_id, env_kwargs or {})) as env:
        check_planner(planner, env)
        recorder = Recorder(describe(env))
        silent = None if progress is None else not progress
        with tqdm(desc=planner, total=episodes, unit="episode", disable=silent) as bar:
            for episode in itertools.islice(_attempts(env, planner, seed), most):
                recorder.add(episode)
                bar.update(episode is not None)
                if len(recorder) == episodes:
                    break
    if len(recorder) < episodes:
        raise RuntimeError(
            f"{planner} expert of {env_id}: {len(recorder)} of {most} attempts succeeded, {episodes} needed"
        )
    demonstrations = recorder.finish(planner=planner, seed=seed)
    if target is not None:
        demonstrations.save(target)
    return demonstrations


def check_planner(planner: str, env: ManipulationEnv) -> None:
    """Check that a planner can be used with an environment.

    :raises ValueError: it cannot, with the reason
    """
    if planner not in PLANNERS:
        raise ValueError(f"planner: got {planner!r}, takes one of {tuple(PLANNERS)}")
    if planner == DECONSTRUCTION and (reason := _obstacle(env)) is not None:
        raise ValueError(f"planner: got {planner!r}, but {reason}")


def _obstacle(env: ManipulationEnv) -> str | None:
    """Return what keeps an environment's goal from being taken apart."""
    if env.config.control != OPEN_LOOP:
        return "only pick and place can be reversed, and this environment is close-loop"
    if not env.task.has_goal_structure:
        return f"{type(env.task).__name__} builds no structure: it has no arrange_goal()"
    if not env.scene.surface.keeps_poses:
        return "on this ground blocks do not stay as they are laid"
    return None


def _attempts(env: ManipulationEnv, planner: str, seed: int) -> Iterator[Episode | None]:
    """Yield the episode of each attempt, or None where it fails."""
    rng = np.random.default_rng(seed)
    while True:
        yield PLANNERS[planner](env, int(rng.integers(2**31)))


def _follow_plan(env: ManipulationEnv, seed: int) -> Episode | None:
    """Let the task's expert act."""
    observation, _ = env.reset(seed=seed)
    return _play(env, seed, observation, (env.expert_action() for _ in itertools.count()))


def _rebuild(env: ManipulationEnv, seed: int) -> Episode | None:
    """Take the finished structure apart, and put it together again."""
    _, info = env.reset(seed=seed, options={"start": "goal"})
    try:
        relocations = take_apart(env.scene, np.random.default_rng((seed, TAKING_APART)))
    except PlacementError:
        return None
    env.scene.begin()
    env.scene.settle()
    waypoints = (waypoint for relocation in reversed(relocations) for waypoint in relocation.reversed())
    moves = (env.tracker.next_move(iter([waypoint])) for waypoint in waypoints)
    actions = (env.encode_action(move) for move in moves)
    return _play(env, seed, env.observe(), actions) if info["is_success"] else None


PLANNERS = {WAYPOINT: _follow_plan, DECONSTRUCTION: _rebuild}


def _play(
    env: ManipulationEnv, seed: int, observation: Observation, actions: Iterator[Action]
) -> Episode | None:
    """Act until the episode ends, or the actions do; return it if it succeeds."""
    initial_state = plain.dumps(env.get_state())
    observations, steps, succeeds = [observation], [], False
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(action)
        observations.append(observation)
        steps.append((action, reward, terminated, truncated))
        succeeds = info["is_success"]
        if terminated or truncated:
            break
    if not succeeds:
        return None
    return assemble(observations, steps, seed, initial_state)


def describe(env: ManipulationEnv) -> dict[str, Any]:
    """Return the description of an environment in a file: its id, parts, parameters and action ranges.

    :raises ValueError: an object in the parameters has no import path
    """
    assert env.spec is not None
    for name, thing in env.objects.items():
        raise ValueError(
            f"env_kwargs: {name}={thing!r} has no import path 'module:name' to be kept in a file"
        )
    parameters = env.config.parameters()
    return {
        "env_id": env.spec.id,
        "recipe": env.recipe,
        "configuration": {name: parameters[name] for name in parameters if not name.startswith("render_")},
        "action_ranges": env.action_ranges,
    }


def _make(env_id: str, env_kwargs: Mapping[str, Any]) -> ManipulationEnv:
    env = gymnasium.make(env_id, **env_kwargs).unwrapped
    if not isinstance(env, ManipulationEnv):
        raise ValueError(f"env_id: got {env_id!r}, takes an id of this package or of a registered task")
    return env


def writable(path: Path) -> Path:
    """Return a path that a file can be written to; asked before an hour of collecting, not after.

    :raises ValueError: it is a folder
    :raises OSError: its folder cannot be made or written to
    """
    if path.is_dir():
        raise ValueError(f"path must be a file such as {path / 'demonstrations.h5'}, got the folder {path}")
    path.parent.mkdir(parents=True, exist_ok=True)
    if not os.access(path.parent, os.W_OK):
        raise PermissionError(f"path: {path.parent} cannot be written to")
    return path
