"""Starting states for the members of vector environments.

``gymnasium.make_vec(id, num_envs=n, vectorization_mode="async")`` runs environments in processes.
``reset(options={"state": state})`` begins all members at the same state.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv

from bulletarm_gym.scene.state import EnvState


def reset_to_states(envs: VectorEnv[Any, Any, Any], states: Sequence[EnvState]) -> tuple[Any, dict[str, Any]]:
    """Begin the episodes of a vector environment, each member at its own state.

    :param envs: vector environment of Gymnasium
    :param states: one state for each member
    :return: observations and infos, as ``envs.reset()`` returns them
    :raises ValueError: the number of states differs from that of the members, or ``envs`` has
        ``shared_memory=False``
    """
    if not getattr(envs.unwrapped, "shared_memory", True):
        # Its workers reset ended members again at the next step: findings/gymnasium_async_resets_twice.sh
        raise ValueError("envs must have shared_memory=True, got shared_memory=False")
    if len(states) != envs.num_envs:
        raise ValueError(f"states must be {envs.num_envs} states, one per member, got {len(states)}")
    observations, infos = envs.reset(options={"state": states[0]})
    for number, state in enumerate(states[1:], 1):
        mask = np.arange(envs.num_envs) == number
        observations, later = envs.reset(options={"state": state, "reset_mask": mask})
        infos = _merged(infos, later, mask)
    return observations, infos


def _merged(value: Any, later: Any, mask: Any) -> Any:
    """Return infos, or an entry of infos, with the later values of the members in a mask."""
    if isinstance(value, dict):
        return {name: _merged(entry, later[name], mask) for name, entry in value.items()}
    return np.where(mask, later, value)
