"""Prioritized replay of expert and online transitions."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import torch as th

from sb3_extensions.replay.expert import ExpertReplayBuffer
from sb3_extensions.replay.frames import Ids

# Added to every priority, so that no transition is forgotten for good.
MIN_PRIORITY = 1e-6

FloatArray = npt.NDArray[np.float64]


class SumTree:
    """
    Complete binary tree over non-negative numbers, each node the sum of the two below; all zero at first.

    :param capacity: number of leaves
    """

    def __init__(self, capacity: int) -> None:
        self.depth = max(capacity - 1, 0).bit_length()
        self.nodes = np.zeros(2 << self.depth)  # the root at 1, the children of node i at 2 i and 2 i + 1

    @property
    def total(self) -> float:
        """Sum of all leaves."""
        return float(self.nodes[1])

    @property
    def greatest(self) -> float:
        """Greatest of all leaves."""
        return float(self.nodes[1 << self.depth :].max())

    def __getitem__(self, leaves: Ids) -> FloatArray:
        return self.nodes[leaves + (1 << self.depth)]

    def __setitem__(self, leaves: Ids, values: npt.ArrayLike) -> None:
        nodes = leaves + (1 << self.depth)
        self.nodes[nodes] = values
        for _ in range(self.depth):
            nodes = nodes >> 1
            self.nodes[nodes] = self.nodes[2 * nodes] + self.nodes[2 * nodes + 1]

    def find(self, masses: FloatArray) -> Ids:
        """
        Find the leaves at which the running sum of the leaves exceeds given masses.

        :param masses: numbers from 0 to :attr:`total`, shape (n,)
        :return: leaves, none of them zero unless all are, shape (n,)
        """
        masses, nodes = masses.copy(), np.ones(len(masses), dtype=np.int64)
        for _ in range(self.depth):
            left = self.nodes[2 * nodes]
            # Rounding may carry a mass beyond the last leaf that is not zero.
            goes_right = (masses >= left) & (self.nodes[2 * nodes + 1] > 0)
            masses -= np.where(goes_right, left, 0)
            nodes = 2 * nodes + goes_right
        return nodes - (1 << self.depth)


class PrioritizedReplayBuffer(ExpertReplayBuffer):
    """
    :class:`~sb3_extensions.replay.expert.ExpertReplayBuffer` that draws transitions in proportion to
    ``priority ** exponent``; the priority is the absolute temporal-difference error of the last update, with
    a bonus for the expert's. New transitions get the greatest priority that any has now.

    The importance weights ``(size * probability) ** -beta``, divided by the greatest of the sample, are for
    the critic's loss. ``beta`` grows linearly from ``beta_start`` to 1 as :attr:`progress_remaining` falls
    from 1 to 0. Every sample takes one transition from each of ``batch_size`` equal shares of the priorities.
    SACfD and TQCfD use the weights and hand back the errors; Stable-Baselines3's own algorithms do neither.

    Prioritized replay: https://arxiv.org/abs/1511.05952. The defaults are those of the paper of BulletArm,
    https://arxiv.org/abs/2205.14292, appendix "Benchmark Details".

    :param args: arguments of :class:`~sb3_extensions.replay.expert.ExpertReplayBuffer`
    :param exponent: 0 draws uniformly, 1 in proportion to the priorities
    :param beta_start: 0 leaves the bias of the sampling at first, 1 corrects it at once
    :param expert_bonus: added to the priorities of expert transitions
    :param kwargs: keyword arguments of :class:`~sb3_extensions.replay.expert.ExpertReplayBuffer`
    :raises ValueError: if an argument is out of its range, or with ``expert_fraction``
    """

    def __init__(
        self,
        *args: Any,
        exponent: float = 0.6,
        beta_start: float = 0.4,
        expert_bonus: float = 1.0,
        **kwargs: Any,
    ) -> None:
        super().__init__(*args, **kwargs)
        for name, value in {"exponent": exponent, "beta_start": beta_start}.items():
            if not 0 <= value <= 1:
                raise ValueError(f"{name} must be between 0 and 1, got {value}")
        if expert_bonus < 0:
            raise ValueError(f"expert_bonus must not be negative, got {expert_bonus}")
        if self.expert_fraction is not None:
            raise ValueError(
                f"expert_fraction must be None, got {self.expert_fraction}: priorities set the shares"
            )
        self.exponent = exponent
        self.beta_start = beta_start
        self.expert_bonus = expert_bonus
        self._forget_priorities()

    def _forget_priorities(self) -> None:
        self.tree = SumTree(self.rows.capacity)  # of priority ** exponent; 0 where no row is kept

    def reset(self) -> None:
        """Forget all transitions and their priorities."""
        super().reset()
        self._forget_priorities()

    def update_priorities(self, slots: Ids, td_errors: th.Tensor) -> None:
        """
        Take the errors that an update has found.

        :param slots: ``indices`` of a sample, shape (batch,)
        :param td_errors: temporal-difference errors of its transitions, shape (batch, 1)
        """
        errors = td_errors.detach().abs().cpu().numpy().ravel().astype(np.float64)
        priorities = errors + self.expert_bonus * (slots < self.rows.pinned) + MIN_PRIORITY
        kept = self.tree[slots] > 0
        self.tree[slots[kept]] = priorities[kept] ** self.exponent

    def _write_rows(self, rows: Ids, **columns: Any) -> Ids:
        # That of the rows kept now, not of all times: the errors of an untrained critic are soon made good
        self.tree[self.rows.slots(rows)] = self.tree.greatest or 1.0
        return super()._write_rows(rows, **columns)

    def _drop_rows_without_frames(self) -> None:
        first = self.rows.first
        super()._drop_rows_without_frames()
        if first < self.rows.first:
            self.tree[self.rows.slots(np.arange(first, self.rows.first))] = 0.0

    def _draw(self, batch_size: int) -> tuple[Ids, npt.NDArray[np.float32]]:
        masses = (np.arange(batch_size) + self.rng.random(batch_size)) * (self.tree.total / batch_size)
        slots = self.tree.find(masses)
        beta = 1 - (1 - self.beta_start) * self.progress_remaining
        weights = (self.tree[slots] / self.tree.total * self.size()) ** -beta
        return self.rows.ids_in(slots), (weights / weights.max()).astype(np.float32)
