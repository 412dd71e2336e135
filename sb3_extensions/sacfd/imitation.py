"""What an actor imitates: the expert, and what it did itself and won."""

from __future__ import annotations

import torch as th

from sb3_extensions.replay.samples import FrameReplayBufferSamples

# Of a transition's weight in self-imitation: one that is much better counts 20 times at most.
MAX_EXPONENT = 3.0


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
    weights = (advantages / temperature).clamp(max=MAX_EXPONENT).exp() * succeeded
    return actions, th.where(known, th.ones_like(weights), weights)
