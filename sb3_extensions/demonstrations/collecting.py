"""Episodes of an expert: their shape, and their collection from an environment with ``expert_action()``."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Iterator
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv
from tqdm import tqdm

# The paper's experts succeed in 9 of 10 episodes or more; one that fails three times in four is broken.
ATTEMPTS_PER_EPISODE = 4

AnyEnv = gym.Env[Any, Any]
Actions = npt.NDArray[Any]
Hand = Callable[[Actions, np.random.Generator], Actions]
"""From the action that the expert wants to the one that is carried out, with a source of randomness."""


class EpisodeData(Protocol):
    """
    An episode of n steps, its parts named as Minari names them: a ``minari.EpisodeData`` is one.

    Where the actions that the expert wanted are not those that were carried out, it also has
    ``expert_actions``, of the same shape.
    """

    @property
    def observations(self) -> dict[str, npt.NDArray[Any]]:
        """For each key of the Dict space an array of n + 1 observations."""
        ...

    @property
    def actions(self) -> npt.NDArray[Any]:
        """Actions in the units of the environment, shape (n, action dimensions)."""
        ...

    @property
    def rewards(self) -> npt.NDArray[Any]:
        """Rewards, shape (n,)."""
        ...

    @property
    def terminations(self) -> npt.NDArray[np.bool_]:
        """Whether the episode terminated, shape (n,)."""
        ...


@dataclasses.dataclass(frozen=True)
class Episode:
    """
    An episode of n steps.

    :param observations: for each key an array of n + 1 observations
    :param actions: those that were carried out, shape (n, action dimensions), in the units of the environment
    :param expert_actions: those that the expert wanted, of the same shape
    :param rewards: shape (n,)
    :param terminations: shape (n,)
    :param truncations: shape (n,)
    :param seed: seed the environment was reset with; None where it went on with the scene that it had
    """

    observations: dict[str, npt.NDArray[Any]]
    actions: Actions
    expert_actions: Actions
    rewards: npt.NDArray[np.float32]
    terminations: npt.NDArray[np.bool_]
    truncations: npt.NDArray[np.bool_]
    seed: int | None


def make_expert_env(vec_env: VecEnv) -> AnyEnv:
    """
    Make an environment like those of a vector environment, without their monitors and windows.

    :param vec_env: vector environment whose members come from Gymnasium's registry
    :return: a new environment
    :raises ValueError: if they do not, or if their observations differ from the vector environment's
    """
    spec = vec_env.get_attr("spec", indices=0)[0]
    if spec is None:
        raise ValueError(
            "the training environment has no spec to make an environment for the expert from: "
            "make it with gymnasium.make(id), or hand over episodes by expert_data="
        )
    monitor = f"{Monitor.__module__}:{Monitor.__name__}"
    wrappers = tuple(wrapper for wrapper in spec.additional_wrappers if wrapper.entry_point != monitor)
    kwargs = {name: value for name, value in spec.kwargs.items() if name != "render_mode"}
    env = gym.make(dataclasses.replace(spec, kwargs=kwargs, additional_wrappers=wrappers))
    if env.observation_space != vec_env.observation_space or env.action_space != vec_env.action_space:
        raise ValueError(
            f"the environment made from {spec.id} has observations {env.observation_space} and actions "
            f"{env.action_space}, the training environment has {vec_env.observation_space} and "
            f"{vec_env.action_space}: "
            "wrap it by Gymnasium's wrappers only, or hand over episodes by expert_data="
        )
    return env


def collect_episodes(
    env: AnyEnv,
    episodes: int,
    seed: int | None = None,
    max_attempts: int | None = None,
    progress_bar: bool | None = None,
    hand: Hand | None = None,
) -> Iterator[Episode]:
    """
    Let the expert of an environment act; yields successful episodes only, one at a time.

    An episode is successful if ``info["is_success"]`` is true at its end. Each attempt has a seed of its own;
    but where the environment says that it ``keeps_scene``, so that training meets what earlier episodes left,
    those after a success go on with the scene as well. After a failure the scene is a new one: what the
    expert cannot do it would meet again and again.

    :param env: environment with Dict observations and a method ``expert_action()`` that returns an action
    :param episodes: number of successful episodes
    :param seed: seed from which the seeds of the attempts are drawn
    :param max_attempts: number of episodes to try at most; by default four for each successful one
    :param progress_bar: whether to show progress; by default on a terminal
    :param hand: what carries the expert's actions out otherwise than it wants, such as
        :class:`~sb3_extensions.demonstrations.noise.UnsteadyHand`
    :return: the episodes
    :raises ValueError: if the environment is not such a one, or ``episodes`` is negative
    :raises RuntimeError: while iterating, if the attempts are used up
    """
    if episodes < 0:
        raise ValueError(f"episodes must not be negative, got {episodes}")
    if not isinstance(env.observation_space, spaces.Dict):
        raise ValueError(f"the environment must have Dict observations, got {env.observation_space}")
    if not env.has_wrapper_attr("expert_action"):
        raise ValueError(
            f"{env} has no expert_action(): train without demonstrations by expert_episodes=0, "
            "or hand over episodes by expert_data="
        )
    attempts = ATTEMPTS_PER_EPISODE * episodes if max_attempts is None else max_attempts
    silent = None if progress_bar is None else not progress_bar  # None: silent but on a terminal
    return _successful_episodes(env, hand, episodes, attempts, np.random.default_rng(seed), silent)


def _successful_episodes(
    env: AnyEnv,
    hand: Hand | None,
    episodes: int,
    attempts: int,
    rng: np.random.Generator,
    silent: bool | None,
) -> Iterator[Episode]:
    successes, goes_on = 0, False
    hand_rng = rng.spawn(1)[0]
    keeps_scene = env.has_wrapper_attr("keeps_scene") and env.get_wrapper_attr("keeps_scene")
    with tqdm(total=episodes, desc="expert episodes", disable=silent) as progress:
        for _ in range(attempts):
            if successes == episodes:
                return
            seed = None if goes_on else int(rng.integers(2**31))
            episode, success = _run_episode(env, hand, hand_rng, seed)
            goes_on = keeps_scene and success
            if success:
                successes += 1
                progress.update()
                yield episode
    if successes < episodes:
        raise RuntimeError(
            f"the expert of {env} succeeded in {successes} of {attempts} episodes, {episodes} needed"
        )


def _run_episode(
    env: AnyEnv, hand: Hand | None, rng: np.random.Generator, seed: int | None
) -> tuple[Episode, bool]:
    expert = env.get_wrapper_attr("expert_action")
    observation, info = env.reset(seed=seed)
    # Copies: some environments write every observation into the same array.
    observations, steps = [copy.deepcopy(observation)], []
    ended = False
    while not ended:
        wanted = np.array(expert())
        action = wanted if hand is None else hand(wanted, rng)
        observation, reward, terminated, truncated, info = env.step(action)
        observations.append(copy.deepcopy(observation))
        steps.append((action, wanted, reward, terminated, truncated))
        ended = terminated or truncated
    if "is_success" not in info:
        raise ValueError(f"{env} does not say whether an episode succeeded: its info has no 'is_success'")
    actions, expert_actions, rewards, terminations, truncations = map(np.array, zip(*steps, strict=True))
    episode = Episode(
        observations={key: np.stack([entry[key] for entry in observations]) for key in observation},
        actions=actions,
        expert_actions=expert_actions,
        rewards=rewards.astype(np.float32),
        terminations=terminations,
        truncations=truncations,
        seed=seed,
    )
    return episode, bool(info["is_success"])
