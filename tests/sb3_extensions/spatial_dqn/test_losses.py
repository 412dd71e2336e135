"""Imitation terms against slow references, and their gradients."""

import math
from functools import partial

import numpy as np
import pytest
import torch as th

from sb3_extensions.spatial_dqn.losses import cross_entropy, large_margin, strict_margin

MARGIN = 0.125  # exact in binary, as are the multiples of it that make ties
BATCH, CHOICES = 12, 7


def slow_strict_margin(row: np.ndarray, chosen: int, level: int) -> float:
    above = [q - row[chosen] + MARGIN for a, q in enumerate(row) if a != chosen and q > row[chosen] - MARGIN]
    return float(np.mean(above)) if above else 0.0


def slow_large_margin(row: np.ndarray, chosen: int, level: int) -> float:
    return float(max(q + MARGIN * (a != chosen) for a, q in enumerate(row)) - row[chosen])


def slow_cross_entropy(row: np.ndarray, chosen: int, level: int) -> float:
    logits = (100.0 if level == 0 else 1.0) * row
    return float(logits.max() + math.log(np.exp(logits - logits.max()).sum()) - logits[chosen])


each_loss = pytest.mark.parametrize(
    ("loss", "slow", "mean_of_all"),
    [
        (partial(strict_margin, margin=MARGIN), slow_strict_margin, True),
        (partial(large_margin, margin=MARGIN), slow_large_margin, False),
        (cross_entropy, slow_cross_entropy, False),
    ],
    ids=["sdqfd", "dqfd", "adet"],
)


def make_batch(kind: str) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
    """Values (float64), choices, and whether they are the expert's."""
    generator = th.Generator().manual_seed(0)
    values = th.randn(BATCH, CHOICES, generator=generator, dtype=th.float64) * 0.2
    choices = th.randint(CHOICES, (BATCH,), generator=generator)
    if kind == "ties":
        values = (values / MARGIN).round() * MARGIN
    elif kind == "best already":
        values.scatter_(1, choices[:, None], 5.0)
    return values, choices, (th.arange(BATCH) % 3 != 0) & (kind != "no expert")


@each_loss
@pytest.mark.parametrize("kind", ["random", "ties", "best already", "no expert"])
@pytest.mark.parametrize("level", [0, 1, 4])
def test_losses_equal_slow_references(loss, slow, mean_of_all, kind, level):
    values, choices, is_expert = make_batch(kind)
    rows = zip(values.numpy(), choices.tolist(), is_expert.tolist(), strict=True)
    terms = [slow(row, chosen, level) for row, chosen, expert in rows if expert]
    expected = sum(terms) / (BATCH if mean_of_all else max(len(terms), 1))
    found = loss(values, choices, is_expert, level)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)
    assert (expected > 0.01) == (kind == "random") or kind in ("ties", "best already")
    single = loss(values.float(), choices, is_expert, level)
    assert single.dtype == th.float32
    np.testing.assert_allclose(single, expected, rtol=1e-5, atol=1e-6)


@each_loss
@pytest.mark.parametrize("kind", ["random", "best already", "no expert"])
def test_gradients(loss, slow, mean_of_all, kind):
    values, choices, is_expert = make_batch(kind)
    values.requires_grad_()
    assert th.autograd.gradcheck(lambda q: loss(q, choices, is_expert, 1), values)
    extreme = th.tensor([[1e4, -1e4, 0.0]], requires_grad=True)
    result = loss(extreme, th.tensor([1]), th.tensor([True]), 0)
    [gradient] = th.autograd.grad(result, extreme)
    assert result.isfinite() and gradient.isfinite().all()


def test_strict_margin_counts_violations_only():
    """One choice at the margin's edge, one within, one above: two violations, of 0.25 and 0.0625."""
    values = th.tensor([[0.5, 0.375, 0.4375, 0.625], [0.0, 9.0, 9.0, 9.0]])
    found = strict_margin(values, th.tensor([0, 0]), th.tensor([True, False]), 0, 0.125)
    assert found.item() == (0.0625 + 0.25) / 2 / 2
