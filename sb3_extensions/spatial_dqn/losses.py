"""Imitation losses of the spatial Q algorithms, one term for each level (paper, appendix; authors' code)."""

from collections.abc import Callable

import torch as th
from torch.nn import functional as F

PIXEL_TEMPERATURE = 100.0
"""Factor of the values of all pixels as logits, because this level has many more choices."""

ImitationLoss = Callable[[th.Tensor, th.Tensor, th.Tensor, int, float], th.Tensor]
"""Function with the parameters of :func:`strict_margin` that returns a scalar."""


def strict_margin(
    values: th.Tensor, choices: th.Tensor, is_expert: th.Tensor, level: int, margin: float
) -> th.Tensor:
    """
    Return the loss of SDQfD (https://arxiv.org/abs/2010.02798).

    The loss of an expert step is the mean excess of all choices with values above the expert's value minus
    the margin. It is averaged over the whole batch, with 0 for online steps.

    :param values: (batch, choices)
    :param choices: choices of the actions, (batch,)
    :param is_expert: mask of expert steps, bool (batch,)
    :param level: index of the level, 0 for all pixels
    :param margin: required difference of the expert's choice and all others
    :return: a scalar
    """
    above = values + margin - values.gather(1, choices[:, None])
    violates = (above > 0).scatter(1, choices[:, None], False) & is_expert[:, None]
    violations = violates.sum(dim=1).clamp(min=1)
    return (th.where(violates, above, 0.0).sum(dim=1) / violations).mean()


def large_margin(
    values: th.Tensor, choices: th.Tensor, is_expert: th.Tensor, level: int, margin: float
) -> th.Tensor:
    """
    Return the loss of DQfD (https://arxiv.org/abs/1704.03732), see :func:`strict_margin` for the parameters.

    It is the mean over the expert steps of the difference of the best choice, with the margin added to all
    but the expert's, and the expert's choice.
    """
    chosen = values.gather(1, choices[:, None])
    raised = (values + margin).scatter(1, choices[:, None], chosen)
    return _expert_mean(raised.amax(dim=1) - chosen[:, 0], is_expert)


def cross_entropy(
    values: th.Tensor, choices: th.Tensor, is_expert: th.Tensor, level: int, margin: float = 0.0
) -> th.Tensor:
    """
    Return the loss of ADET, see :func:`strict_margin` for the parameters; the margin has no effect.

    It is the cross entropy of the expert's choices with values as logits, averaged over the expert steps.
    """
    temperature = PIXEL_TEMPERATURE if level == 0 else 1.0
    return _expert_mean(F.cross_entropy(temperature * values, choices, reduction="none"), is_expert)


def _expert_mean(losses: th.Tensor, is_expert: th.Tensor) -> th.Tensor:
    return th.where(is_expert, losses, 0.0).sum() / is_expert.sum().clamp(min=1)
