"""Replay of episodes, for values that were not recorded."""

from collections.abc import Iterator

import numpy as np

from bulletarm_gym.demonstrations.episodes import HEIGHT, HEIGHTS, Demonstrations, versions
from bulletarm_gym.env import ManipulationEnv

TOLERANCE = HEIGHT / 2.0 + 1e-6
"""Maximum error (m) of a stored height: half a count, and rounding to float32."""


class ReplayError(RuntimeError):
    """A replayed episode differs from the recorded one."""


def replay(demonstrations: Demonstrations, number: int, env: ManipulationEnv) -> Iterator[int]:
    """Repeat an episode, and yield the number of each of its n + 1 states when the environment is in it.

    :param number: number of the episode
    :param env: environment with the same parameters
    :raises ReplayError: an observation differs from the recorded one, for example with other versions
    """
    episode = demonstrations[number]
    env.set_state(episode.state)
    observation = env.observe()
    for moment in range(len(episode) + 1):
        if moment:
            observation = env.step(episode.actions[moment - 1])[0]
        for key, recorded in episode.observations.items():
            tolerance = TOLERANCE if key in HEIGHTS else 0.0
            if not np.allclose(observation[key], recorded[moment], rtol=0.0, atol=tolerance, equal_nan=True):
                changed = _changed_versions(demonstrations)
                raise ReplayError(
                    f"episode {number}, step {moment}: {key} differs from the recorded one{changed}"
                )
        yield moment


def _changed_versions(demonstrations: Demonstrations) -> str:
    ours = versions()
    changed = [
        f"{name} {theirs}, here {ours.get(name)}"
        for name, theirs in demonstrations.about["versions"].items()
        if theirs != ours.get(name)
    ]
    return f" (recorded with {'; '.join(changed)})" if changed else ""
