"""Episodes once more, step by step, for what was not recorded: pictures, poses."""

from collections.abc import Iterator

import numpy as np

from bulletarm_gym.demonstrations.episodes import HEIGHT, HEIGHTS, Demonstrations, Episode, versions
from bulletarm_gym.env import ManipulationEnv, Observation

ROUNDING = HEIGHT / 2.0 + 1e-6
"""How far (m) what is stored of a height is from it: half a count, and what float32 adds."""


class ReplayError(RuntimeError):
    """An episode does not go as it was recorded."""


def replay(demonstrations: Demonstrations, number: int, env: ManipulationEnv) -> Iterator[int]:
    """Repeat an episode in an environment; yield, with it at each of the n + 1 moments, the moment's number.

    What is observed is compared with what was recorded.

    :param number: of the episode
    :param env: of the same parameters
    :raises ReplayError: something else is observed, as it may be with other versions or on another machine
    """
    episode = demonstrations[number]
    env.set_state(episode.state)
    observation = env.observe()
    for moment in range(len(episode) + 1):
        if moment:
            observation = env.step(episode.actions[moment - 1])[0]
        if (key := _difference(episode, moment, observation)) is not None:
            raise ReplayError(
                f"episode {number}, step {moment}: {key} is not what was recorded{_reason(demonstrations)}"
            )
        yield moment


def _difference(episode: Episode, moment: int, observation: Observation) -> str | None:
    """Return the first key whose values differ from those recorded."""
    for key, recorded in episode.observations.items():
        tolerance = ROUNDING if key in HEIGHTS else 0.0
        if not np.allclose(observation[key], recorded[moment], rtol=0.0, atol=tolerance, equal_nan=True):
            return key
    return None


def _reason(demonstrations: Demonstrations) -> str:
    """Return what differs from when it was recorded."""
    ours = versions()
    changed = [
        f"{name} {theirs}, here {ours.get(name)}"
        for name, theirs in demonstrations.about["versions"].items()
        if theirs != ours.get(name)
    ]
    return f" (recorded with {'; '.join(changed)})" if changed else ""
