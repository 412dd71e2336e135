"""Episodes of an expert."""

from __future__ import annotations

import dataclasses
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt


class EpisodeData(Protocol):
    """
    An episode of n steps with the attributes of ``minari.EpisodeData``.

    If the expert intended other actions than the executed ones, the episode has ``expert_actions`` of the
    same shape.
    """

    @property
    def observations(self) -> dict[str, npt.NDArray[Any]]:
        """For each key of the Dict space an array of n + 1 observations."""

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
    Episode of n steps.

    :param observations: for each key an array of n + 1 observations
    :param actions: executed actions in the environment's units, shape (n, action dimensions)
    :param expert_actions: actions that the expert intended, same shape
    :param rewards: shape (n,)
    :param terminations: shape (n,)
    :param truncations: shape (n,)
    :param seed: seed of the reset, None if the episode continued with the scene of the one before
    """

    observations: dict[str, npt.NDArray[Any]]
    actions: npt.NDArray[Any]
    expert_actions: npt.NDArray[Any]
    rewards: npt.NDArray[np.float32]
    terminations: npt.NDArray[np.bool_]
    truncations: npt.NDArray[np.bool_]
    seed: int | None
