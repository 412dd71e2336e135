"""How spatial Q algorithms imitate: one term of the loss for each level (the paper's appendix; authors'
code).
"""

from __future__ import annotations

from collections.abc import Callable

import torch as th
from torch.nn import functional as F

# Multiplies the values of the level of all pixels where they are logits: many more choices than elsewhere.
PIXEL_TEMPERATURE = 100.0

ImitationLoss = Callable[[th.Tensor, th.Tensor, th.Tensor, int], th.Tensor]
"""From values (batch, choices), the actions' choices (batch,), whether they are the expert's, bool (batch,),
and the number of the level to a scalar."""


class StrictMargin:
    """
    SDQfD: the mean, over all choices with a value above the expert's less a margin, of how far above they are
    (https://arxiv.org/abs/2010.02798); the mean over the whole batch, 0 where the action is not the expert's.

    :param margin: by which the expert's choice is to be better than all others
    """

    def __init__(self, margin: float) -> None:
        self.margin = margin

    def __call__(self, values: th.Tensor, choices: th.Tensor, is_expert: th.Tensor, level: int) -> th.Tensor:
        """:return: a scalar"""
        above = values + self.margin - values.gather(1, choices[:, None])
        violates = (above > 0).scatter(1, choices[:, None], False) & is_expert[:, None]
        violations = violates.sum(dim=1).clamp(min=1)
        return (th.where(violates, above, 0.0).sum(dim=1) / violations).mean()


class LargeMargin:
    """
    DQfD: how far the best choice is above the expert's, others raised by a margin
    (https://arxiv.org/abs/1704.03732); the mean over the expert's transitions.

    :param margin: see :class:`StrictMargin`
    """

    def __init__(self, margin: float) -> None:
        self.margin = margin

    def __call__(self, values: th.Tensor, choices: th.Tensor, is_expert: th.Tensor, level: int) -> th.Tensor:
        """:return: a scalar"""
        chosen = values.gather(1, choices[:, None])
        raised = (values + self.margin).scatter(1, choices[:, None], chosen)
        return mean_of_expert(raised.amax(dim=1) - chosen[:, 0], is_expert)


def cross_entropy(values: th.Tensor, choices: th.Tensor, is_expert: th.Tensor, level: int) -> th.Tensor:
    """
    ADET: cross entropy of the expert's choice, values taken as logits (Lakshminarayanan, Ozair and Bengio,
    "Reinforcement Learning with Few Expert Demonstrations", 2016); the mean over the expert's transitions.

    :param values: (batch, choices)
    :param choices: of the actions, (batch,)
    :param is_expert: whether they are the expert's, bool (batch,)
    :param level: 0 for that of all pixels
    :return: a scalar
    """
    temperature = PIXEL_TEMPERATURE if level == 0 else 1.0
    return mean_of_expert(F.cross_entropy(temperature * values, choices, reduction="none"), is_expert)


def mean_of_expert(losses: th.Tensor, is_expert: th.Tensor) -> th.Tensor:
    """
    Mean over the expert's transitions, 0 if there are none.

    :param losses: (batch,)
    :param is_expert: bool (batch,)
    :return: a scalar
    """
    return th.where(is_expert, losses, 0.0).sum() / is_expert.sum().clamp(min=1)
