"""Samplers of the replay buffer: which steps an update uses, with which importance weights."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from sb3_extensions.common.components import check_fraction, make_component
from sb3_extensions.replay.step_table import Rows, StepTable

Weights = npt.NDArray[np.float32]
FloatArray = npt.NDArray[np.float64]

MIN_PRIORITY = 1e-6
"""Added to every priority, so that every step can be sampled (BulletArm, appendix "Benchmark Details")."""


class UniformSampler:
    """
    Sample all steps with equal probability.

    The weights of a sampler make a weighted mean an unbiased estimate for the distribution that its docstring
    names.
    """

    progress_remaining = 1.0
    """Remaining fraction of the training, from 1 to 0. The algorithm updates it."""

    def setup(self, table: StepTable) -> None:
        """
        Prepare for an empty table.

        :param table: table to sample from
        """
        self.table = table
        self._valid_rows: Rows | None = None

    def update(self, added: Rows, removed: Rows) -> None:
        """
        Take note of changed rows.

        :param added: rows with new steps
        :param removed: rows whose steps are no longer valid
        """
        self._valid_rows = None

    @property
    def valid_rows(self) -> Rows:
        """Rows that can be sampled, pinned ones first."""
        if self._valid_rows is None:
            self._valid_rows = np.flatnonzero(self.table.columns["valid"])
        return self._valid_rows

    @property
    def n_expert(self) -> int:
        """Number of expert steps among :attr:`valid_rows`."""
        return int(np.searchsorted(self.valid_rows, self.table.n_pinned))

    def sample(self, batch_size: int, rng: np.random.Generator) -> tuple[Rows, Weights]:
        """
        Sample rows.

        :param batch_size: number of rows
        :param rng: random generator
        :return: rows and importance weights, both of shape (batch_size,)
        """
        rows = self.valid_rows[rng.integers(len(self.valid_rows), size=batch_size)]
        return rows, np.ones(batch_size, dtype=np.float32)

    def update_priorities(self, rows: Rows, td_errors: FloatArray) -> None:
        """
        Update priorities; a sampler without priorities ignores them.

        :param rows: sampled rows, shape (batch_size,)
        :param td_errors: absolute temporal-difference errors, shape (batch_size,)
        """


class ShareSampler(UniformSampler):
    """
    Sample fixed shares of expert steps and of successful online steps.

    The weights correct the oversampling of successes: within the online part of a batch a weighted mean
    estimates the mean over all online steps. The share of the expert is not corrected.

    :param expert_fraction: share of expert steps in a batch (BulletArm, appendix "Benchmark Details": 0.5 in
        open loop)
    :param success_fraction: maximum share of online steps that led to a success without a later exploratory
        action. A successful step is sampled at most as often as an expert step
    :param balanced_from: number of expert steps and of online steps from which batches are divided. Before,
        all steps are sampled with equal probability
    :raises ValueError: if an argument is out of its range
    """

    def __init__(
        self, expert_fraction: float = 0.5, success_fraction: float = 0.0, balanced_from: int = 1
    ) -> None:
        check_fraction(expert_fraction=expert_fraction, success_fraction=success_fraction)
        if expert_fraction + success_fraction > 1:
            raise ValueError(
                "expert_fraction + success_fraction must be at most 1, got "
                f"{expert_fraction} + {success_fraction}"
            )
        if balanced_from < 1:
            raise ValueError(f"balanced_from must be at least 1, got {balanced_from}")
        self.expert_fraction = expert_fraction
        self.success_fraction = success_fraction
        self.balanced_from = balanced_from

    def setup(self, table: StepTable) -> None:
        """Prepare for an empty table."""
        super().setup(table)
        self._successes: Rows | None = None

    def update(self, added: Rows, removed: Rows) -> None:
        """Take note of changed rows."""
        super().update(added, removed)
        self._successes = None

    @property
    def successes(self) -> Rows:
        """Online rows of steps that led to a success."""
        if self._successes is None:
            online = self.valid_rows[self.n_expert :]
            self._successes = online[self.table.columns["succeeded"][online]]
        return self._successes

    def sample(self, batch_size: int, rng: np.random.Generator) -> tuple[Rows, Weights]:
        """Sample rows and their importance weights."""
        valid, n_expert = self.valid_rows, self.n_expert
        n_online = len(valid) - n_expert
        if min(n_expert, n_online) < self.balanced_from:
            return super().sample(batch_size, rng)
        from_expert = round(batch_size * self.expert_fraction)
        from_successes = self._count_successes(batch_size, from_expert, rng)
        uniform = batch_size - from_expert - from_successes
        rows = [
            valid[rng.integers(n_expert, size=from_expert)],
            valid[n_expert + rng.integers(n_online, size=uniform)],
            self.successes[rng.integers(max(1, len(self.successes)), size=from_successes)],
        ]
        online = np.concatenate(rows[1:])
        weights = self._online_weights(online, uniform, from_successes, n_online)
        return np.concatenate(rows), np.concatenate([np.ones(from_expert, np.float32), weights])

    def _count_successes(self, batch_size: int, from_expert: int, rng: np.random.Generator) -> int:
        """Return how many rows to sample from the successes, on average as often as expert rows at most."""
        most = round(batch_size * self.success_fraction)
        if not most:
            return 0
        as_often_as_expert = from_expert * len(self.successes) / self.n_expert
        return min(most, int(as_often_as_expert + rng.random()))

    def _online_weights(self, online: Rows, uniform: int, from_successes: int, n_online: int) -> Weights:
        """Return the expected number of draws under uniform sampling over that under this sampling."""
        target = (uniform + from_successes) / n_online
        draws = np.full(len(online), uniform / n_online)
        if from_successes:
            draws += self.table.columns["succeeded"][online] * (from_successes / len(self.successes))
        return (target / draws).astype(np.float32)


class SumTree:
    """
    Complete binary tree of sums over non-negative numbers, initially zero.

    :param capacity: number of leaves
    """

    def __init__(self, capacity: int) -> None:
        self.depth = max(capacity - 1, 0).bit_length()
        self.nodes = np.zeros(
            2 << self.depth
        )  # the root is node 1; the children of node i are 2 i and 2 i + 1

    @property
    def total(self) -> float:
        """Sum of all leaves."""
        return float(self.nodes[1])

    @property
    def max(self) -> float:
        """Maximum of all leaves."""
        return float(self.nodes[1 << self.depth :].max())

    def __getitem__(self, leaves: Rows) -> FloatArray:
        return self.nodes[leaves + (1 << self.depth)]

    def __setitem__(self, leaves: Rows, values: npt.ArrayLike) -> None:
        nodes = leaves + (1 << self.depth)
        self.nodes[nodes] = values
        for _ in range(self.depth):
            nodes = nodes >> 1
            self.nodes[nodes] = self.nodes[2 * nodes] + self.nodes[2 * nodes + 1]

    def find(self, masses: FloatArray) -> Rows:
        """
        Find the leaves at which the running sum exceeds the masses.

        :param masses: numbers from 0 to :attr:`total`, shape (n,)
        :return: leaves with positive values, unless all are zero; shape (n,)
        """
        masses, nodes = masses.copy(), np.ones(len(masses), dtype=np.int64)
        for _ in range(self.depth):
            left = self.nodes[2 * nodes]
            # Rounding can move a mass beyond the last positive leaf.
            goes_right = (masses >= left) & (self.nodes[2 * nodes + 1] > 0)
            masses -= np.where(goes_right, left, 0)
            nodes = 2 * nodes + goes_right
        return nodes - (1 << self.depth)


class PrioritizedSampler(UniformSampler):
    """
    Sample steps in proportion to ``priority ** exponent``.

    The priority is the absolute temporal-difference error of the last update plus a bonus for expert steps. A
    new step gets the maximum of the present priorities. A batch has one step from each of ``batch_size``
    equal parts of the sum of priorities.

    The weights ``(size * probability) ** -beta``, divided by their maximum in the batch, correct the bias
    towards the uniform distribution fully when ``beta`` is 1. ``beta`` grows from ``beta_start`` to 1 during
    the training.

    Source: https://arxiv.org/abs/1511.05952; defaults: https://arxiv.org/abs/2205.14292, appendix "Benchmark
    Details".

    :param exponent: 0 samples uniformly, 1 in proportion to the priorities
    :param beta_start: initial exponent of the importance weights
    :param expert_bonus: added to the priorities of expert steps
    :raises ValueError: if an argument is out of its range
    """

    def __init__(self, exponent: float = 0.6, beta_start: float = 0.4, expert_bonus: float = 1.0) -> None:
        check_fraction(exponent=exponent, beta_start=beta_start)
        if expert_bonus < 0:
            raise ValueError(f"expert_bonus must be at least 0, got {expert_bonus}")
        self.exponent = exponent
        self.beta_start = beta_start
        self.expert_bonus = expert_bonus

    def setup(self, table: StepTable) -> None:
        """Prepare for an empty table."""
        super().setup(table)
        self.tree = SumTree(table.capacity)  # of priority ** exponent, 0 for invalid rows
        self.size = 0

    def update(self, added: Rows, removed: Rows) -> None:
        """Give new steps the maximum priority."""
        self.size += len(added) - len(removed)
        self.tree[removed] = 0.0
        # The maximum of the present rows: large errors of an untrained critic do not last.
        self.tree[added] = self.tree.max or 1.0

    def sample(self, batch_size: int, rng: np.random.Generator) -> tuple[Rows, Weights]:
        """Sample rows and their importance weights."""
        masses = (np.arange(batch_size) + rng.random(batch_size)) * (self.tree.total / batch_size)
        rows = self.tree.find(masses)
        beta = 1 - (1 - self.beta_start) * self.progress_remaining
        weights = (self.tree[rows] / self.tree.total * self.size) ** -beta
        return rows, (weights / weights.max()).astype(np.float32)

    def update_priorities(self, rows: Rows, td_errors: FloatArray) -> None:
        """Set the priorities of sampled rows."""
        priorities = td_errors + self.expert_bonus * (rows < self.table.n_pinned) + MIN_PRIORITY
        valid = self.tree[rows] > 0
        self.tree[rows[valid]] = priorities[valid] ** self.exponent


SAMPLERS: dict[str, type[UniformSampler]] = {
    "uniform": UniformSampler,
    "shares": ShareSampler,
    "prioritized": PrioritizedSampler,
}


def make_sampler(spec: Any) -> UniformSampler:
    """
    Create a sampler from its specification.

    :param spec: a sampler, None (uniform), a name, or one name with arguments
        (``{"shares": {"expert_fraction": 0.5}}``)
    :return: the sampler
    :raises ValueError: if the specification is something else
    """
    return make_component("sampler", spec, SAMPLERS) or UniformSampler()
