"""Samplers of the replay buffer: they return rows and importance weights."""

import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from sb3_extensions.common.components import (
    check_fraction,
    check_integer,
    check_not_negative,
    make_components,
)
from sb3_extensions.replay.step_table import Rows, StepTable

Weights = npt.NDArray[np.float32]
FloatArray = npt.NDArray[np.float64]

MIN_PRIORITY = 1e-6
"""Added to every priority, so that every step can be sampled (BulletArm, the authors' code)."""


class UniformSampler:
    """Sample all steps with equal probability."""

    progress_remaining = 1.0
    """Remaining fraction of the training, from 1 to 0. The algorithm updates it."""

    def setup(self, table: StepTable) -> None:
        """Prepare for sampling from a table, which is empty."""
        self.table = table

    def update(self, added: Rows, removed: Rows) -> None:
        """Adapt to rows with new steps and to rows whose steps became invalid."""

    @property
    def valid_rows(self) -> Rows:
        """Rows that can be sampled, pinned ones first."""
        return np.flatnonzero(self.table.columns["valid"])

    def sample(self, batch_size: int, rng: np.random.Generator) -> tuple[Rows, Weights]:
        """Return sampled rows and importance weights, both of shape (batch_size,)."""
        valid = self.valid_rows
        return valid[rng.integers(len(valid), size=batch_size)], np.ones(batch_size, dtype=np.float32)

    def update_priorities(self, rows: Rows, td_errors: FloatArray) -> None:
        """Update priorities of rows by absolute temporal-difference errors, if the sampler has priorities."""


@dataclass(eq=False)
class ShareSampler(UniformSampler):
    """
    Sample a fixed share of expert steps.

    :param expert_fraction: share of expert steps in a batch (BulletArm, appendix "Benchmark Details": 0.5 in
        open loop)
    :param balanced_from: minimum number of expert steps and of online steps for this share. With fewer steps,
        all steps are sampled with equal probability
    :raises ValueError: if an argument is out of its range
    """

    expert_fraction: float = 0.5
    balanced_from: int = 1

    def __post_init__(self) -> None:
        check_fraction(expert_fraction=self.expert_fraction)
        check_integer(1, balanced_from=self.balanced_from)

    def sample(self, batch_size: int, rng: np.random.Generator) -> tuple[Rows, Weights]:
        """Return sampled rows and importance weights, which are 1."""
        valid = self.valid_rows
        expert, online = np.split(valid, [np.searchsorted(valid, self.table.n_pinned)])
        if min(len(expert), len(online)) < self.balanced_from:
            return super().sample(batch_size, rng)
        from_expert = round(batch_size * self.expert_fraction)
        parts = ((expert, from_expert), (online, batch_size - from_expert))
        rows = np.concatenate([part[rng.integers(len(part), size=n)] for part, n in parts])
        return rows, np.ones(batch_size, dtype=np.float32)


@dataclass(eq=False)
class PrioritizedSampler(UniformSampler):
    """
    Sample steps in proportion to ``priority ** exponent``.

    The priority is the absolute temporal-difference error of the last update plus a bonus for expert steps. A
    new step gets the maximum of the present priorities. The weights are ``(size * probability) ** -beta``,
    divided by their maximum in the batch. ``beta`` grows from ``beta_start`` to 1 during the training.

    Source: https://arxiv.org/abs/1511.05952; defaults: https://arxiv.org/abs/2205.14292, appendix "Benchmark
    Details".

    :param exponent: 0 samples uniformly, 1 in proportion to the priorities
    :param beta_start: initial exponent of the importance weights
    :param expert_bonus: added to the priorities of expert steps
    :raises ValueError: if an argument is out of its range
    """

    exponent: float = 0.6
    beta_start: float = 0.4
    expert_bonus: float = 1.0

    def __post_init__(self) -> None:
        check_fraction(exponent=self.exponent, beta_start=self.beta_start)
        check_not_negative(expert_bonus=self.expert_bonus)

    def setup(self, table: StepTable) -> None:
        """Prepare for sampling from a table, which is empty."""
        super().setup(table)
        self.masses = np.zeros(table.capacity)  # priority ** exponent, 0 for invalid rows

    def update(self, added: Rows, removed: Rows) -> None:
        """Give new steps the maximum of the present priorities."""
        self.masses[removed] = 0.0
        self.masses[added] = self.masses.max() or 1.0

    def sample(self, batch_size: int, rng: np.random.Generator) -> tuple[Rows, Weights]:
        """Return sampled rows and importance weights."""
        valid = self.valid_rows
        masses = self.masses[valid]
        ends = masses.cumsum()
        points = (np.arange(batch_size) + rng.random(batch_size)) * (ends[-1] / batch_size)
        # Rounding can move the last point to the end.
        chosen = np.searchsorted(ends, points, side="right").clip(max=len(valid) - 1)
        beta = 1 - (1 - self.beta_start) * self.progress_remaining
        weights = (masses[chosen] / ends[-1] * len(valid)) ** -beta
        return valid[chosen], (weights / weights.max()).astype(np.float32)

    def update_priorities(self, rows: Rows, td_errors: FloatArray) -> None:
        """Set the priorities of sampled rows."""
        priorities = td_errors + self.expert_bonus * (rows < self.table.n_pinned) + MIN_PRIORITY
        self.masses[rows] = priorities**self.exponent


def make_sampler(spec: Any) -> UniformSampler:
    """
    Create a sampler from its specification, see :class:`~sb3_extensions.replay.buffer.ExpertReplayBuffer`.

    An object is copied, because a sampler refers to the table of one buffer.

    :raises ValueError: if the specification is something else
    """
    if isinstance(spec, UniformSampler):
        return copy.copy(spec)
    classes = {"uniform": UniformSampler, "shares": ShareSampler, "prioritized": PrioritizedSampler}
    samplers = make_components("sampler", spec, classes)
    if len(samplers) > 1:
        raise ValueError(f"sampler must be one sampler, got {spec!r}")
    return samplers[0] if samplers else UniformSampler()
