"""Policies that act by a running average of their actor's weights."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.common.utils import get_parameters_by_name, polyak_update
from stable_baselines3.sac.policies import Actor, SACPolicy

# How the names of parameters begin.
ACTOR, AVERAGE = "actor.", "actor_average."


class AveragedActorPolicy(SACPolicy):
    """
    Policy whose deterministic actions may be those of a running average of the actor's weights.

    While the learning rate is high an actor's weights wander about what they should be, and so do its
    actions: by too little to matter where they are sampled, by enough to stand still where they are not.
    Their average stays. Sampled actions are the actor's own.

    :param args: arguments of :class:`stable_baselines3.sac.policies.SACPolicy`
    :param average_actor: Whether there is an average; an algorithm keeps it, see :meth:`update_average`
    :param kwargs: keyword arguments of :class:`stable_baselines3.sac.policies.SACPolicy`
    """

    actor_average: Actor | None

    def __init__(self, *args: Any, average_actor: bool = False, **kwargs: Any) -> None:
        self.average_actor = average_actor
        super().__init__(*args, **kwargs)

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        self.actor_average = None
        if self.average_actor:
            self.actor_average = self.make_actor().requires_grad_(False)
            self.actor_average.set_training_mode(False)
            self.reset_average()

    def reset_average(self) -> None:
        """Begin anew with the actor's present weights."""
        if self.actor_average is not None:
            self.actor_average.load_state_dict(self.actor.state_dict())

    def update_average(self, tau: float, n_updates: int) -> None:
        """
        Let the average follow the actor.

        The first weights count as much as the next, until there are ``1 / tau`` of them.

        :param tau: the soft update coefficient ("Polyak update", between 0 and 1)
        :param n_updates: number of updates of the average before this one
        """
        assert self.actor_average is not None
        actor, average = self.actor, self.actor_average
        polyak_update(actor.parameters(), average.parameters(), max(tau, 1 / (n_updates + 1)))
        # Copy running stats, see GH issue #996
        stats, average_stats = (get_parameters_by_name(module, ["running_"]) for module in (actor, average))
        polyak_update(stats, average_stats, 1.0)

    def load_state_dict(self, state_dict: Mapping[str, Any], *args: Any, **kwargs: Any) -> Any:
        """
        Load what a policy with or without an average had: one that was not there begins with the actor's
        weights, one that is not wanted is left out.

        :param state_dict: parameters and buffers by their names
        :param args: further arguments of :meth:`torch.nn.Module.load_state_dict`
        :param kwargs: its keyword arguments
        :return: names that are missing or not expected
        """
        average = {name: value for name, value in state_dict.items() if name.startswith(AVERAGE)}
        state = {name: value for name, value in state_dict.items() if name not in average}
        if self.actor_average is not None:
            own = {name: value for name, value in state.items() if name.startswith(ACTOR)}
            state |= average or {AVERAGE + name.removeprefix(ACTOR): value for name, value in own.items()}
        return super().load_state_dict(state, *args, **kwargs)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        if deterministic and self.actor_average is not None:
            averaged: th.Tensor = self.actor_average(observation, deterministic)
            return averaged
        return super()._predict(observation, deterministic)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(average_actor=self.average_actor, share_features_extractor=self.share_features_extractor)
        return data


def with_average(
    policy_class: type[BasePolicy], policy_kwargs: dict[str, Any], actor_tau: float | None
) -> dict[str, Any]:
    """
    Arguments of a policy that keeps an average if an algorithm updates it.

    :param policy_class: whose arguments
    :param policy_kwargs: as they were given
    :param actor_tau: coefficient of the algorithm's updates, None for none
    :return: a copy
    :raises ValueError: if the policy cannot keep an average
    """
    if not issubclass(policy_class, AveragedActorPolicy):
        if actor_tau is not None:
            raise ValueError(f"actor_tau needs an AveragedActorPolicy, got {policy_class.__name__}")
        return policy_kwargs
    return {**policy_kwargs, "average_actor": actor_tau is not None}
