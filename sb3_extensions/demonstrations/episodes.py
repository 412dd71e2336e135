"""Episodes of an expert."""

import dataclasses
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt


class EpisodeData(Protocol):
    """
    An episode of n steps with the attributes of ``minari.EpisodeData``.

    The attribute ``expert_actions`` is optional: actions that the expert intended, if others were executed.
    """

    @property
    def observations(self) -> Any:
        """Array of n + 1 observations; for a Dict space a dict with an array for each key."""

    @property
    def actions(self) -> npt.NDArray[Any]:
        """Executed actions in the environment's units, shape (n, action dimensions)."""

    @property
    def rewards(self) -> npt.NDArray[Any]:
        """Rewards, shape (n,)."""

    @property
    def terminations(self) -> npt.NDArray[np.bool_]:
        """Whether the episode terminated, shape (n,)."""


@dataclasses.dataclass(frozen=True)
class Episode:
    """
    Collected episode of n steps, see :class:`EpisodeData` for the other parameters.

    :param expert_actions: actions that the expert intended, shape (n, action dimensions)
    :param truncations: whether the episode was truncated, shape (n,)
    :param seed: seed of the reset, None if the episode continued with the scene of the one before
    """

    observations: dict[str, npt.NDArray[Any]]
    actions: npt.NDArray[Any]
    expert_actions: npt.NDArray[Any]
    rewards: npt.NDArray[np.float32]
    terminations: npt.NDArray[np.bool_]
    truncations: npt.NDArray[np.bool_]
    seed: int | None
