"""Collection of expert episodes from environments with ``expert_action()``."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv
from tqdm import tqdm

from sb3_extensions.common.observations import as_parts
from sb3_extensions.demonstrations.episodes import Episode

ATTEMPTS_PER_EPISODE = 4
"""Maximum number of attempts for each successful episode."""
KEEPS_SCENE = "keeps_scene"
SUCCESS = "is_success"

Actions = npt.NDArray[Any]
ActionTransform = Callable[[Actions, np.random.Generator], Actions]
"""Function from the intended action and a random generator to the executed action (environment's units)."""


def collect_episodes(
    env: gym.Env[Any, Any] | VecEnv,
    episodes: int,
    seed: int | None = None,
    progress_bar: bool | None = None,
    action_transform: ActionTransform | None = None,
) -> Iterator[Episode]:
    """
    Collect successful episodes of the expert of an environment, one at a time.

    An episode is successful if ``info["is_success"]`` is True at its end. Each attempt has its own seed. If
    the environment has a true attribute ``keeps_scene``, the episode after a success starts in the scene that
    the success has left.

    :param env: environment with a method ``expert_action()``, or a vector environment with one of them
    :param episodes: number of successful episodes
    :param seed: seed of the generator of the attempts' seeds and of the transformation
    :param progress_bar: whether to show progress, by default on a terminal
    :param action_transform: transformation of the expert's actions before they are executed
    :raises ValueError: if there are several environments, or the environment has no expert or no
        ``is_success``
    :raises RuntimeError: if too few attempts succeeded
    """
    vec_env = env if isinstance(env, VecEnv) else DummyVecEnv([lambda: env])
    if vec_env.num_envs > 1:
        raise ValueError(f"env must be one environment, got a vector environment of {vec_env.num_envs}")
    if not vec_env.has_attr("expert_action"):
        raise ValueError(
            f"env must have expert_action(), got {vec_env.get_attr('unwrapped')[0]}. Pass "
            "expert_episodes=0 to train without demonstrations, or expert_data"
        )
    attempts, successes, observation = ATTEMPTS_PER_EPISODE * episodes, 0, None
    rng = np.random.default_rng(seed)
    transform_rng = rng.spawn(1)[0]
    keeps_scene = vec_env.has_attr(KEEPS_SCENE) and vec_env.get_attr(KEEPS_SCENE)[0]
    with make_progress_bar(episodes, "expert episodes", progress_bar) as progress:
        for _ in range(attempts):
            if successes == episodes:
                return
            attempt_seed = None
            if observation is None:
                attempt_seed = int(rng.integers(2**31))
                vec_env.seed(attempt_seed)
                observation = vec_env.reset()
            episode, success, observation = _run_episode(
                vec_env, observation, action_transform, transform_rng, attempt_seed
            )
            if success:
                successes += 1
                progress.update()
                yield episode
            if not (keeps_scene and success):
                observation = None
    if successes < episodes:
        raise RuntimeError(
            f"the expert succeeded in {successes} of {attempts} episodes of "
            f"{vec_env.get_attr('unwrapped')[0]}, {episodes} needed"
        )


def add_noise(action: Actions, rng: np.random.Generator, space: spaces.Box, std: float) -> Actions:
    """
    Add Gaussian noise to an expert's action, clipped to the bounds of the action space.

    The intended action is imitated, not the noisy one. Source: DART, https://arxiv.org/abs/1703.09327

    :param std: standard deviation, in half the range of each number of an action
    """
    noise = rng.normal(scale=std, size=space.shape) * (space.high - space.low) / 2
    noisy: Actions = np.clip(action + noise, space.low, space.high)
    return noisy.astype(space.dtype)


def make_progress_bar(total: int, name: str, shown: bool | None, initial: int = 0) -> tqdm[Any]:
    """Create a progress bar. With ``shown=None`` it is shown on a terminal only."""
    return tqdm(total=total, initial=initial, desc=name, disable=None if shown is None else not shown)


def _run_episode(
    env: VecEnv,
    observation: Any,
    action_transform: ActionTransform | None,
    rng: np.random.Generator,
    seed: int | None,
) -> tuple[Episode, bool, Any]:
    """Return an episode, whether it succeeded, and the first observation after it."""
    observations, steps, done = [_first(observation)], [], False
    while not done:
        intended = np.array(env.env_method("expert_action")[0])
        action = intended if action_transform is None else action_transform(intended, rng)
        observation, rewards, dones, infos = env.step(np.asarray(action)[None])
        done, info = bool(dones[0]), infos[0]
        # The vector environment has already reset the environment.
        last = copy.deepcopy(as_parts(info["terminal_observation"])) if done else _first(observation)
        observations.append(last)
        truncated = info.get("TimeLimit.truncated", False)
        steps.append((action, intended, rewards[0], done and not truncated, done and truncated))
    if SUCCESS not in info:
        raise ValueError(
            f"env must have {SUCCESS!r} in the info at the end of an episode, got {sorted(info)}"
        )
    actions, expert_actions, rewards, terminations, truncations = map(np.array, zip(*steps, strict=True))
    episode = Episode(
        observations={key: np.stack([entry[key] for entry in observations]) for key in observations[0]},
        actions=actions,
        expert_actions=expert_actions,
        rewards=rewards.astype(np.float32),
        terminations=terminations,
        truncations=truncations,
        seed=seed,
    )
    return episode, bool(info[SUCCESS]), observation


def _first(observation: Any) -> dict[str, Any]:
    """Return a copy of the observation of the first environment."""
    return {key: values[0].copy() for key, values in as_parts(observation).items()}
