"""What an actor imitates: the expert, and what it did itself and won; and where it heeds its critic."""

from __future__ import annotations

import torch as th

from sb3_extensions.replay.samples import FrameReplayBufferSamples


def imitated_actions(
    replay_data: FrameReplayBufferSamples, advantages: th.Tensor, temperature: float | None, limit: float
) -> tuple[th.Tensor, th.Tensor]:
    """
    Actions to imitate, and how much.

    :param replay_data: sampled transitions
    :param advantages: values of their actions less those of the actor's, (batch, 1)
    :param temperature: of the weights of the agent's own transitions, None imitates the expert alone
    :param limit: the actions are clipped to [-limit, limit]
    :return: actions (batch, action dimensions) and their weights (batch, 1), 0 where there is none to imitate
    """
    known = replay_data.expert_actions.isfinite().all(dim=1, keepdim=True)
    actions = th.where(known, replay_data.expert_actions, replay_data.actions).clamp(-limit, limit)
    if temperature is None:
        return actions, known.float()
    succeeded = replay_data.returns > 0.0  # not so while the episode goes on, NaN
    # None counts more than one of the expert's: what a critic thinks better is so by chance as often as not
    weights = (advantages / temperature).clamp(max=0.0).exp() * succeeded
    return actions, th.where(known, th.ones_like(weights), weights)


def value_weights(is_expert: th.Tensor, q_weight: float, expert_q_weight: float | None) -> th.Tensor | float:
    """
    Weights of the critic's values in an actor's loss.

    :param is_expert: whether transitions are the expert's, (batch, 1)
    :param q_weight: in the agent's own transitions
    :param expert_q_weight: in the expert's, None as in the agent's own
    :return: (batch, 1) where they differ
    """
    if expert_q_weight is None:
        return q_weight
    return th.where(is_expert.reshape(-1, 1), expert_q_weight, q_weight)
