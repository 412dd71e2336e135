"""Policies of SACfD: the paper's CNN, its equivariant network, and a multi-layer perceptron."""

from __future__ import annotations

from typing import Any, ClassVar

from gymnasium import spaces
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.sac.policies import Actor

from sb3_extensions.encoders.extractors import CnnExtractor, EquivariantExtractor
from sb3_extensions.encoders.mlp_extractor import MlpExtractor
from sb3_extensions.sacfd.actor_critic import (
    EquivariantActor,
    EquivariantCritic,
    MultiHeadCritic,
    NetArch,
    initialise_actor,
)
from sb3_extensions.sacfd.base_policy import SACfDPolicy
from sb3_extensions.sacfd.heads import features_type

# Hidden layers of the paper's close-loop CNN baseline: none in the actor, 128 units in each head of the
# critic.
CNN_NET_ARCH: dict[str, list[int]] = {"pi": [], "qf": [128]}
STATE_NET_ARCH: dict[str, list[int]] = {"pi": [], "qf": [256]}


class MultiInputPolicy(SACfDPolicy):
    """
    CNN policy of the paper, with an encoder for the actor and one for all heads of the critic.

    :param observation_space: Dict of images and numbers, see
        :class:`~sb3_extensions.encoders.observation.StackedImage`
    :param action_space: Action space
    :param lr_schedule: Learning rate schedule (could be constant)
    :param net_arch: Hidden layers behind the encoders, the paper's if ``None``
    :param features_extractor_class: Features extractor to use
    :param kwargs: further parameters of :class:`~sb3_extensions.sacfd.base_policy.SACfDPolicy`
    """

    critic_class: ClassVar[type[MultiHeadCritic]] = MultiHeadCritic

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Box,
        lr_schedule: Schedule,
        net_arch: NetArch | None = None,
        features_extractor_class: type[BaseFeaturesExtractor] = CnnExtractor,
        **kwargs: Any,
    ) -> None:
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            net_arch=CNN_NET_ARCH if net_arch is None else net_arch,
            features_extractor_class=features_extractor_class,
            **kwargs,
        )

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Actor:
        """Create the actor."""
        actor = super().make_actor(features_extractor)
        return initialise_actor(actor) if self.normalise else actor

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> ContinuousCritic:
        """Create the critic."""
        kwargs = self._update_features_extractor(self.critic_kwargs, features_extractor)
        return self.critic_class(normalise=self.normalise, **kwargs).to(self.device)


class StatePolicy(MultiInputPolicy):
    """
    Policy without images, for vectors such as object poses.

    :param observation_space: see :class:`~sb3_extensions.encoders.mlp_extractor.MlpExtractor`
    :param action_space: Action space
    :param lr_schedule: Learning rate schedule (could be constant)
    :param net_arch: Hidden layers behind the encoders, by default none in the actor and 256 units in each
        head of the critic
    :param features_extractor_class: Features extractor to use
    :param kwargs: further parameters of :class:`MultiInputPolicy`
    """

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Box,
        lr_schedule: Schedule,
        net_arch: NetArch | None = None,
        features_extractor_class: type[BaseFeaturesExtractor] = MlpExtractor,
        **kwargs: Any,
    ) -> None:
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            net_arch=STATE_NET_ARCH if net_arch is None else net_arch,
            features_extractor_class=features_extractor_class,
            **kwargs,
        )


class EquivariantPolicy(SACfDPolicy):
    """
    Equivariant policy of the paper, with an encoder for the actor and one for all heads of the critic.

    :param observation_space: Dict of images and numbers, see
        :class:`~sb3_extensions.encoders.observation.StackedImage`
    :param action_space: Action space
    :param lr_schedule: Learning rate schedule (could be constant)
    :param net_arch: Regular fields of the hidden layers behind the encoders. By default the actor has none,
        and each head of the critic has one layer with the encoder's number of fields
    :param features_extractor_class: Features extractor with regular features that trivial ones may follow
    :param action_sequence: One character for each number of the action: ``p`` (gripper), ``x``, ``y``, ``z``,
        ``r`` (rotation about z), in any order
    :param kwargs: further parameters of :class:`~sb3_extensions.sacfd.base_policy.SACfDPolicy`
    :raises ValueError: if features or ``action_sequence`` do not fit, or with ``use_sde``
    """

    critic_class: ClassVar[type[EquivariantCritic]] = EquivariantCritic

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Box,
        lr_schedule: Schedule,
        net_arch: NetArch | None = None,
        features_extractor_class: type[BaseFeaturesExtractor] = EquivariantExtractor,
        action_sequence: str = "pxyzr",
        **kwargs: Any,
    ) -> None:
        self.action_sequence = action_sequence
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            net_arch={"pi": [], "qf": []} if net_arch is None else net_arch,
            features_extractor_class=features_extractor_class,
            **kwargs,
        )

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Actor:
        """Create the actor, equivariant under the group."""
        kwargs = self._update_features_extractor(self.actor_kwargs, features_extractor)
        return EquivariantActor(action_sequence=self.action_sequence, normalise=self.normalise, **kwargs).to(
            self.device
        )

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> ContinuousCritic:
        """Create the critic, invariant under the group."""
        kwargs = self._update_features_extractor(self.critic_kwargs, features_extractor)
        kwargs["net_arch"] = kwargs["net_arch"] or [features_type(kwargs["features_extractor"]).fields[0][1]]
        return self.critic_class(action_sequence=self.action_sequence, normalise=self.normalise, **kwargs).to(
            self.device
        )

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(action_sequence=self.action_sequence)
        return data
