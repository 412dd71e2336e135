"""Networks that the policies of SACfD and TQCfD share: the paper's CNN and its equivariant network."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeVar

from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.sac.policies import Actor
from torch import nn

from sb3_extensions.common.extractors import CnnExtractor, EquivariantExtractor
from sb3_extensions.common.groups import FieldType
from sb3_extensions.common.heads import (
    ActionFields,
    EquivariantLogStd,
    EquivariantMean,
    InvariantValue,
    equivariant_mlp,
    regular_type,
)

# The classes without a parent are mixed into SAC's classes, or TQC's, which have the same methods.
if TYPE_CHECKING:
    from stable_baselines3.common.policies import ContinuousCritic as AnyCritic
    from stable_baselines3.sac.policies import SACPolicy as AnyPolicy
else:
    AnyPolicy = AnyCritic = object

NetArch = list[int] | dict[str, list[int]]
Network = TypeVar("Network", bound=nn.Module)

# Hidden layers of the paper's close-loop CNN baseline: none in the actor, 128 units in each head of the
# critic.
CNN_NET_ARCH: dict[str, list[int]] = {"pi": [], "qf": [128]}


class CnnNetworks(AnyPolicy):
    """Makes a policy the paper's CNN: one encoder for the actor, one for all heads of the critic.

    :param observation_space: Dict of images and numbers, see
        :class:`~sb3_extensions.common.extractors.StackedImage`
    :param action_space: Action space
    :param lr_schedule: Learning rate schedule (could be constant)
    :param net_arch: Hidden layers behind the encoders, the paper's if ``None``
    :param features_extractor_class: Features extractor to use
    :param kwargs: further parameters of the policy
    """

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

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Any:
        """Actor with Xavier-initialised linear layers."""
        return initialise_heads(super().make_actor(features_extractor))

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> Any:
        """Critic with Xavier-initialised linear layers."""
        return initialise_heads(super().make_critic(features_extractor))

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(share_features_extractor=self.share_features_extractor)
        return data


class EquivariantActor(Actor):
    """Actor whose mean of (x, y) turns with the images and whose other outputs stay.

    So does the Gaussian before it is squashed, for the whole group. Squashing acts on x and y alone, and
    commutes with rotations by 90 degrees and with reflections.

    :param net_arch: regular fields of each hidden layer behind the encoder
    :param features_extractor: with regular features
    :param action_sequence: one character for each number of the action, see
        :class:`~sb3_extensions.common.heads.ActionFields`
    :param kwargs: further parameters of :class:`stable_baselines3.sac.policies.Actor`
    :raises ValueError: if features or ``action_sequence`` do not fit, or with ``use_sde``
    """

    def __init__(
        self,
        *,
        net_arch: list[int],
        features_extractor: BaseFeaturesExtractor,
        action_sequence: str,
        use_sde: bool = False,
        activation_fn: type[nn.Module] = nn.ReLU,
        **kwargs: Any,
    ) -> None:
        if use_sde:
            raise ValueError("use_sde=True: the noise of state-dependent exploration is not equivariant")
        super().__init__(
            net_arch=[], features_extractor=features_extractor, activation_fn=activation_fn, **kwargs
        )
        self.net_arch, self.action_sequence = net_arch, action_sequence
        action = ActionFields(action_sequence, get_action_dim(self.action_space))
        hidden_type = in_type = regular_type(features_extractor)
        if net_arch:
            hidden_type = FieldType.of((in_type.group.regular, net_arch[-1]))
        self.latent_pi = equivariant_mlp(in_type, net_arch, activation_fn)
        self.mu = EquivariantMean(hidden_type, action)
        self.log_std = EquivariantLogStd(hidden_type, action)  # type: ignore[assignment]

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(action_sequence=self.action_sequence)
        return data


class InvariantHeads(AnyCritic):
    """Makes the values of a critic stay when images and (x, y) of the action turn together; its heads share
    one encoder.

    :param net_arch: regular fields of each hidden layer of a head
    :param features_extractor: with regular features
    :param action_sequence: one character for each number of the action, see
        :class:`~sb3_extensions.common.heads.ActionFields`
    :param kwargs: further parameters of the critic
    :raises ValueError: if features or ``action_sequence`` do not fit
    """

    def __init__(
        self,
        *,
        net_arch: list[int],
        features_extractor: BaseFeaturesExtractor,
        action_sequence: str,
        activation_fn: type[nn.Module] = nn.ReLU,
        **kwargs: Any,
    ) -> None:
        super().__init__(
            net_arch=[], features_extractor=features_extractor, activation_fn=activation_fn, **kwargs
        )
        action = ActionFields(action_sequence, get_action_dim(self.action_space))
        in_type, outputs = regular_type(features_extractor), getattr(self, "n_quantiles", 1)
        for idx in range(self.n_critics):
            q_net = InvariantValue(in_type, action, net_arch, outputs, activation_fn)
            self.q_networks[idx] = q_net
            self.add_module(f"qf{idx}", q_net)


class EquivariantNetworks(AnyPolicy):
    """Makes a policy equivariant: one encoder for the actor, one for all heads of the critic.

    :param observation_space: Dict of images and numbers, see
        :class:`~sb3_extensions.common.extractors.StackedImage`
    :param action_space: Action space
    :param lr_schedule: Learning rate schedule (could be constant)
    :param net_arch: Regular fields of the hidden layers behind the encoders; by default none in the actor and
        as many as the encoder has in each head of the critic
    :param features_extractor_class: Features extractor with regular features
    :param action_sequence: One character for each number of the action: ``p`` (gripper), ``x``, ``y``, ``z``,
        ``r`` (rotation about z), in any order
    :param kwargs: further parameters of the policy
    :raises ValueError: if features or ``action_sequence`` do not fit, or with ``use_sde``
    """

    critic_class: type[InvariantHeads]

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

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Any:
        """Actor that commutes with the group."""
        kwargs = self._update_features_extractor(self.actor_kwargs, features_extractor)
        return EquivariantActor(action_sequence=self.action_sequence, **kwargs).to(self.device)

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> Any:
        """Critic that is invariant under the group."""
        kwargs = self._update_features_extractor(self.critic_kwargs, features_extractor)
        kwargs["net_arch"] = kwargs["net_arch"] or [regular_type(kwargs["features_extractor"]).fields[0][1]]
        return self.critic_class(action_sequence=self.action_sequence, **kwargs).to(self.device)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(
            share_features_extractor=self.share_features_extractor, action_sequence=self.action_sequence
        )
        return data


def initialise_heads(network: Network) -> Network:
    """Xavier uniform weights and zero biases for the linear layers behind the features extractor.

    :param network: an actor or a critic
    :return: the same network
    """
    for name, child in network.named_children():
        for layer in child.modules():
            if name != "features_extractor" and isinstance(layer, nn.Linear):
                nn.init.xavier_uniform_(layer.weight)
                nn.init.zeros_(layer.bias)
    return network
