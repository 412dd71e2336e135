"""What would be better than an actor's action: a look around it, by the critic's eyes."""

from __future__ import annotations

from collections.abc import Callable

import torch as th

Score = Callable[[th.Tensor, th.Tensor], th.Tensor]


def better_actions(
    score: Score, features: th.Tensor, actions: th.Tensor, proposals: int, margin: float
) -> tuple[th.Tensor, th.Tensor]:
    """
    The best of an action and of some that differ from it in one number, drawn from its whole range.

    A critic's slope says nothing of an action far away, and where an actor is sure of itself its squashed
    Gaussian has no slope either: a gripper that stays closed would stay closed for ever.

    :param score: values (n, 1) of features (n, features) and actions (n, action dimensions)
    :param features: of the critic, (batch, features)
    :param actions: the actor's, in [-1, 1], (batch, action dimensions)
    :param proposals: number of actions to compare it with
    :param margin: by how much a value must be greater
    :return: for each action the best one (batch, action dimensions), and whether it is better (batch, 1)
    """
    batch, action_dim = actions.shape
    candidates = actions[:, None].repeat(1, proposals + 1, 1)
    chosen = th.randint(action_dim, (batch, proposals, 1), device=actions.device)
    drawn = th.rand(batch, proposals, 1, device=actions.device) * 2 - 1
    candidates[:, 1:].scatter_(2, chosen, drawn)  # the first is the actor's own
    repeated = features[:, None].expand(-1, proposals + 1, -1)
    values = score(repeated.flatten(0, 1), candidates.flatten(0, 1)).view(batch, proposals + 1)
    greatest, best = values.max(dim=1)
    is_better = greatest - values[:, 0] > margin
    return candidates[th.arange(batch, device=actions.device), best], is_better[:, None]
