"""Imitation terms against slow references, and their gradients."""

import math
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch as th

from sb3_extensions.spatial_dqn.losses import cross_entropy, large_margin, strict_margin

MARGIN = 0.125  # exact in binary, as are the multiples of it that make ties
BATCH, CHOICES = 12, 7


def slow_strict_margin(values: Any, choices: Any, is_expert: Any, level: int) -> float:
    total = 0.0
    for row, chosen, expert in zip(values, choices, is_expert, strict=True):
        above = [
            q - row[chosen] + MARGIN for a, q in enumerate(row) if a != chosen and q > row[chosen] - MARGIN
        ]
        total += np.mean(above) if expert and above else 0.0
    return total / len(values)


def slow_large_margin(values: Any, choices: Any, is_expert: Any, level: int) -> float:
    losses = []
    for row, chosen, expert in zip(values, choices, is_expert, strict=True):
        if expert:
            losses.append(max(q + MARGIN * (a != chosen) for a, q in enumerate(row)) - row[chosen])
    return float(np.mean(losses)) if losses else 0.0


def slow_cross_entropy(values: Any, choices: Any, is_expert: Any, level: int) -> float:
    beta, losses = 100.0 if level == 0 else 1.0, []
    for row, chosen, expert in zip(values, choices, is_expert, strict=True):
        if expert:
            logits = beta * row
            losses.append(logits.max() + math.log(np.exp(logits - logits.max()).sum()) - logits[chosen])
    return float(np.mean(losses)) if losses else 0.0


LOSSES = [
    (partial(strict_margin, margin=MARGIN), slow_strict_margin),
    (partial(large_margin, margin=MARGIN), slow_large_margin),
    (cross_entropy, slow_cross_entropy),
]
each_loss = pytest.mark.parametrize(("loss", "slow"), LOSSES, ids=["sdqfd", "dqfd", "adet"])


def make_batch(kind: str) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
    """Values (float64), choices, and whether they are the expert's."""
    generator = th.Generator().manual_seed(0)
    values = th.randn(BATCH, CHOICES, generator=generator, dtype=th.float64) * 0.2
    choices = th.randint(CHOICES, (BATCH,), generator=generator)
    is_expert = th.arange(BATCH) % 3 != 0
    if kind == "ties":
        values = (values / MARGIN).round() * MARGIN
    elif kind == "best already":
        values.scatter_(1, choices[:, None], 5.0)
    elif kind == "no expert":
        is_expert = th.zeros(BATCH, dtype=th.bool)
    return values, choices, is_expert


@each_loss
@pytest.mark.parametrize("kind", ["random", "ties", "best already", "no expert"])
@pytest.mark.parametrize("level", [0, 1, 4])
def test_losses_equal_slow_references(loss: Any, slow: Any, kind: str, level: int) -> None:
    values, choices, is_expert = make_batch(kind)
    found = loss(values, choices, is_expert, level)
    assert found.shape == ()
    expected = slow(values.numpy(), choices.numpy(), is_expert.numpy(), level)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)
    if kind == "random":
        assert expected > 0.01
    elif kind == "no expert" or (kind == "best already" and loss is not cross_entropy):
        assert expected == 0.0


@each_loss
def test_losses_support_float32(loss: Any, slow: Any) -> None:
    values, choices, is_expert = make_batch("random")
    found = loss(values.float(), choices, is_expert, 1)
    assert found.dtype == th.float32
    np.testing.assert_allclose(found, slow(values.numpy(), choices, is_expert, 1), rtol=1e-5)


@each_loss
@pytest.mark.parametrize("kind", ["random", "best already", "no expert"])
def test_gradients(loss: Any, slow: Any, kind: str) -> None:
    values, choices, is_expert = make_batch(kind)
    values.requires_grad_()
    assert th.autograd.gradcheck(lambda q: loss(q, choices, is_expert, 1), values)
    [gradient] = th.autograd.grad(loss(values, choices, is_expert, 1), values)
    assert (gradient[~is_expert] == 0).all()
    of_chosen = gradient.gather(1, choices[:, None])[:, 0]
    if kind == "random":  # the expert's choice is pushed up, not only the others down
        assert (of_chosen[is_expert] <= 0).all() and (of_chosen[is_expert] < -0.01).sum() > 4
        th.testing.assert_close(gradient.sum(dim=1), th.zeros(BATCH, dtype=th.float64))


def test_strict_margin_counts_violations_only() -> None:
    """One choice at the margin's edge, one within, one above: two violations, of 0.25 and 0.0625."""
    values = th.tensor([[0.5, 0.375, 0.4375, 0.625], [0.0, 9.0, 9.0, 9.0]])
    found = strict_margin(values, th.tensor([0, 0]), th.tensor([True, False]), 0, 0.125)
    assert found.item() == (0.0625 + 0.25) / 2 / 2


def test_extreme_values_stay_finite() -> None:
    values = th.tensor([[1e4, -1e4, 0.0]], requires_grad=True)
    for loss, _ in LOSSES:
        result = loss(values, th.tensor([1]), th.tensor([True]), 0)
        [gradient] = th.autograd.grad(result, values)
        assert result.isfinite() and gradient.isfinite().all()
