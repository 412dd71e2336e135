"""Terms of the actor's loss."""

import torch as th

from sb3_extensions.replay.samples import ExpertReplayBufferSamples


def imitation_loss(
    actions: th.Tensor,
    replay_data: ExpertReplayBufferSamples,
    success_weights: th.Tensor,
    limit: float,
) -> th.Tensor:
    """
    Mean squared error of actions to the expert's actions, and to successful actions of the agent.

    :param actions: sampled actions of the actor in the policy's units, (batch, action dimensions)
    :param replay_data: sampled steps
    :param success_weights: weights of the steps without an expert action, (batch, 1)
    :param limit: imitated actions are clipped to [-limit, limit]
    :return: sum of the weighted errors over the sum of the weights, or over 1 if that is smaller, a scalar
    """
    known = replay_data.expert_actions.isfinite().all(dim=1, keepdim=True)
    imitated = th.where(known, replay_data.expert_actions, replay_data.actions).clamp(-limit, limit)
    weights = th.where(known, 1.0, success_weights)
    errors = (actions - imitated).pow(2).mean(dim=1, keepdim=True)
    return (errors * weights).sum() / weights.sum().clamp(min=1)


def self_imitation_weights(
    advantages: th.Tensor, succeeded: th.Tensor, temperature: float | None
) -> th.Tensor:
    """
    Weights with which the agent imitates its own successful steps, at most 1, the weight of an expert step.

    Source: self-imitation learning, https://arxiv.org/abs/1806.05635; weights: critic-regularised regression,
    https://arxiv.org/abs/2006.15134

    :param advantages: values of the actions minus values of the actor's actions, (batch, 1)
    :param succeeded: whether the episode succeeded, (batch, 1)
    :param temperature: of the exponential, None for weights 0
    :return: (batch, 1)
    """
    if temperature is None:
        return th.zeros_like(advantages)
    return (advantages / temperature).clamp(max=0.0).exp() * succeeded
