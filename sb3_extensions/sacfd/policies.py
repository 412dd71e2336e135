"""Policies of SACfD: the paper's CNN, its equivariant network, and a multi-layer perceptron."""

from typing import Any, ClassVar

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


class MultiInputPolicy(SACfDPolicy):
    """
    CNN policy of the paper, with an encoder for the actor and one for all heads of the critic.

    By default the actor has no hidden layer, and each head of the critic has one of 128 units. See
    :class:`~sb3_extensions.sacfd.base_policy.SACfDPolicy` for the parameters and
    :class:`~sb3_extensions.encoders.observation.StackedImage` for the observations.
    """

    default_extractor: ClassVar[type[BaseFeaturesExtractor]] = CnnExtractor
    default_net_arch: ClassVar[NetArch] = {"pi": [], "qf": [128]}

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Actor:
        """Create the actor."""
        actor = super().make_actor(features_extractor)
        return initialise_actor(actor) if self.normalise else actor


class StatePolicy(MultiInputPolicy):
    """
    Policy without images, for vectors such as object poses.

    By default the actor has no hidden layer behind its encoder, and each head of the critic has one of 256
    units. See :class:`~sb3_extensions.sacfd.base_policy.SACfDPolicy` for the parameters and
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

    :param args: arguments of :class:`~sb3_extensions.sacfd.base_policy.SACfDPolicy`
    :param action_sequence: One character for each number of the action: ``p`` (gripper), ``x``, ``y``, ``z``,
        ``r`` (rotation about z), in any order
    :param kwargs: keyword arguments of :class:`~sb3_extensions.sacfd.base_policy.SACfDPolicy`
    :raises ValueError: if features or ``action_sequence`` do not fit, or with ``use_sde``
    """

    default_extractor: ClassVar[type[BaseFeaturesExtractor]] = EquivariantExtractor
    default_net_arch: ClassVar[NetArch] = {"pi": [], "qf": []}
    critic_class: ClassVar[type[MultiHeadCritic]] = EquivariantCritic

    def __init__(self, *args: Any, action_sequence: str = "pxyzr", **kwargs: Any) -> None:
        self.action_sequence = action_sequence
        super().__init__(*args, **kwargs)

    def _build(self, lr_schedule: Schedule) -> None:
        self.critic_kwargs["action_sequence"] = self.action_sequence
        super()._build(lr_schedule)

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Actor:
        """Create the actor, equivariant under the group."""
        kwargs = self._update_features_extractor(self.actor_kwargs, features_extractor)
        actor = EquivariantActor(action_sequence=self.action_sequence, normalise=self.normalise, **kwargs)
        return actor.to(self.device)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(action_sequence=self.action_sequence)
        return data
