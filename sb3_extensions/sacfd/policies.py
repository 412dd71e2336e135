"""Policies of SACfD: the paper's CNN, its equivariant network, and a multi-layer perceptron."""

from functools import partial
from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.sac.policies import Actor, SACPolicy
from torch.optim.swa_utils import AveragedModel

from sb3_extensions.encoders.extractors import CnnExtractor, EquivariantExtractor, ImageExtractor
from sb3_extensions.encoders.mlp_extractor import MlpExtractor
from sb3_extensions.sacfd.actor_critic import (
    EquivariantActor,
    EquivariantCritic,
    MultiHeadCritic,
    NetArch,
    XavierActor,
)


class SACfDPolicy(SACPolicy):
    """
    SAC policy with additions, all off by default.

    The encoders of images pool as the paper's do, unless ``features_extractor_kwargs`` has ``strided``. With
    ``share_features_extractor`` the sum of both losses trains one features extractor, in contrast to SAC. See
    Stable-Baselines3's ``SACPolicy`` for the other parameters.

    :param net_arch: hidden layers behind the encoders, None for the default of the subclass
    :param normalise: normalise the critic's features and all hidden layers, which bounds values and means of
        unknown inputs (https://arxiv.org/abs/2302.02948), scale the actions in the critic's input to the
        features, and start actor and critic with outputs near 0
    :param actor_tau: soft update coefficient of an average of the actor's weights that deterministic actions
        use (own addition), greater than 0 and at most 1. The first ``1 / actor_tau`` weights have equal
        shares. None for no average
    :raises ValueError: if ``actor_tau`` is out of its range
    """

    default_extractor: ClassVar[type[BaseFeaturesExtractor]]
    default_net_arch: ClassVar[NetArch]
    actor_class: ClassVar[type[Actor]] = XavierActor
    critic_class: ClassVar[type[MultiHeadCritic]] = MultiHeadCritic
    actor_average: AveragedModel | None

    def __init__(
        self,
        *args: Any,
        net_arch: NetArch | None = None,
        normalise: bool = False,
        actor_tau: float | None = None,
        **kwargs: Any,
    ) -> None:
        if actor_tau is not None and not 0 < actor_tau <= 1:
            raise ValueError(f"actor_tau must be None or greater than 0 and at most 1, got {actor_tau}")
        kwargs.setdefault("features_extractor_class", self.default_extractor)
        if issubclass(kwargs["features_extractor_class"], ImageExtractor):
            extractor_kwargs = kwargs.get("features_extractor_kwargs") or {}
            kwargs["features_extractor_kwargs"] = {"strided": 0, **extractor_kwargs}
        self.normalise = normalise
        self.actor_tau = actor_tau
        kwargs["net_arch"] = self.default_net_arch if net_arch is None else net_arch
        super().__init__(*args, **kwargs)

    def _build(self, lr_schedule: Schedule) -> None:
        self.actor_kwargs["normalise"] = self.critic_kwargs["normalise"] = self.normalise
        super()._build(lr_schedule)
        self.build_average()

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Actor:
        """Create the actor."""
        kwargs = self._update_features_extractor(self.actor_kwargs, features_extractor)
        return self.actor_class(**kwargs).to(self.device)

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> ContinuousCritic:
        """Create the critic."""
        kwargs = self._update_features_extractor(self.critic_kwargs, features_extractor)
        return self.critic_class(**kwargs).to(self.device)

    def build_average(self) -> None:
        """Create the average from the actor's present weights."""
        self.actor_average = None
        if self.actor_tau is not None:
            average = AveragedModel(self.actor, multi_avg_fn=partial(_average, self.actor_tau))
            self.actor_average = average.requires_grad_(False).eval()

    def update_average(self) -> None:
        """Update the average by the actor's weights."""
        if self.actor_average is not None:
            self.actor_average.update_parameters(self.actor)

    def set_training_mode(self, mode: bool) -> None:
        """Set the training mode if it changes; walking through all modules takes milliseconds."""
        if mode != self.training:
            super().set_training_mode(mode)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        if deterministic and self.actor_average is not None:
            averaged: th.Tensor = self.actor_average(observation, deterministic)
            return averaged
        return super()._predict(observation, deterministic)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(
            normalise=self.normalise,
            actor_tau=self.actor_tau,
            share_features_extractor=self.share_features_extractor,
        )
        return data


def _average(tau: float, averaged: Any, current: Any, n_averaged: Any) -> None:
    """Update averaged weights; the first ``1 / tau`` weights have equal shares."""
    th._foreach_lerp_(averaged, current, max(tau, 1 / (int(n_averaged) + 1)))


class MultiInputPolicy(SACfDPolicy):
    """
    CNN policy of the paper, with an encoder for the actor and one for all heads of the critic.

    By default the actor has no hidden layer, and each head of the critic has one of 128 units. See
    :class:`SACfDPolicy` for the parameters and
    :class:`~sb3_extensions.encoders.observation.StackedImage` for the observations.
    """

    default_extractor: ClassVar[type[BaseFeaturesExtractor]] = CnnExtractor
    default_net_arch: ClassVar[NetArch] = {"pi": [], "qf": [128]}


class StatePolicy(MultiInputPolicy):
    """
    Policy without images, for vectors such as object poses.

    By default the actor has no hidden layer behind its encoder, and each head of the critic has one of 256
    units. See :class:`SACfDPolicy` for the parameters and
    :class:`~sb3_extensions.encoders.mlp_extractor.MlpExtractor` for the observations.
    """

    default_extractor: ClassVar[type[BaseFeaturesExtractor]] = MlpExtractor
    default_net_arch: ClassVar[NetArch] = {"pi": [], "qf": [256]}


class EquivariantPolicy(SACfDPolicy):
    """
    Equivariant policy of the paper, with an encoder for the actor and one for all heads of the critic.

    The features extractor must have regular features that trivial ones may follow. ``net_arch`` has the
    regular fields of the hidden layers. By default the actor has none, and each head of the critic has one
    layer with the encoder's number of fields.

    :param args: arguments of :class:`SACfDPolicy`
    :param action_sequence: see :class:`~sb3_extensions.common.action_sequence.ActionSequence`
    :param kwargs: keyword arguments of :class:`SACfDPolicy`
    :raises ValueError: if features or ``action_sequence`` do not fit, or with ``use_sde``
    """

    default_extractor: ClassVar[type[BaseFeaturesExtractor]] = EquivariantExtractor
    default_net_arch: ClassVar[NetArch] = {"pi": [], "qf": []}
    actor_class: ClassVar[type[Actor]] = EquivariantActor
    critic_class: ClassVar[type[MultiHeadCritic]] = EquivariantCritic

    def __init__(self, *args: Any, action_sequence: str = "pxyzr", **kwargs: Any) -> None:
        self.action_sequence = action_sequence
        super().__init__(*args, **kwargs)

    def _build(self, lr_schedule: Schedule) -> None:
        self.actor_kwargs["action_sequence"] = self.critic_kwargs["action_sequence"] = self.action_sequence
        super()._build(lr_schedule)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(action_sequence=self.action_sequence)
        return data
