"""Actors and critics of the policies: the paper's CNN and its equivariant network."""

from functools import partial
from typing import Any

from gymnasium import spaces
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, create_mlp
from stable_baselines3.sac.policies import Actor
from torch import nn

from sb3_extensions.common.action_sequence import ActionSequence
from sb3_extensions.encoders.initialisation import SMALL_GAIN, initialise_output
from sb3_extensions.equivariant.groups import FieldType
from sb3_extensions.sacfd.heads import (
    EquivariantLogStd,
    EquivariantMean,
    InputNormalisation,
    InvariantValue,
    equivariant_mlp,
    features_type,
)

NetArch = list[int] | dict[str, list[int]]


def xavier_mlp(*args: Any, normalise: bool) -> list[nn.Module]:
    """Return the layers of ``create_mlp(*args)`` with Xavier uniform weights (the authors' code)."""
    norm: Any = partial(nn.LayerNorm, elementwise_affine=False)
    layers = create_mlp(*args, post_linear_modules=[norm] if normalise else None)  # type: ignore[misc]
    for layer in layers:
        if isinstance(layer, nn.Linear):
            initialise_output(layer, 1.0)
    return layers


def initialise_actor(actor: Actor, normalise: bool) -> Actor:
    """Initialise the layers behind the encoder, with or without normalisation of the hidden ones."""
    layers = xavier_mlp(actor.features_dim, -1, actor.net_arch, actor.activation_fn, normalise=normalise)
    actor.latent_pi = nn.Sequential(*layers)
    for output in (actor.mu, actor.log_std):
        if isinstance(output, nn.Linear):
            initialise_output(output, SMALL_GAIN if normalise else 1.0)
    return actor


class MultiHeadCritic(ContinuousCritic):
    """
    Critic whose heads share one encoder.

    :param n_critics: Number of heads
    :param n_outputs: number of outputs of a head, 1 for a Q-value, more for quantiles
    :param normalise: whether to normalise features and hidden layers, scale actions, and start near 0
    :param kwargs: further parameters of Stable-Baselines3's ``ContinuousCritic``
    """

    def __init__(
        self,
        *,
        n_critics: int = 2,
        n_outputs: int = 1,
        normalise: bool = False,
        net_arch: list[int],
        features_dim: int,
        activation_fn: type[nn.Module] = nn.ReLU,
        **kwargs: Any,
    ) -> None:
        # Without the heads of ContinuousCritic
        super().__init__(net_arch=net_arch, features_dim=features_dim, n_critics=0, **kwargs)
        self.net_arch, self.features_dim, self.activation_fn = net_arch, features_dim, activation_fn
        self.n_critics, self.n_outputs, self.normalise = n_critics, n_outputs, normalise
        for idx in range(n_critics):
            q_net = self._make_head()
            self.add_module(f"qf{idx}", q_net)
            self.q_networks.append(q_net)

    def _make_head(self) -> nn.Module:
        action_dim = get_action_dim(self.action_space)
        arguments = (self.features_dim + action_dim, self.n_outputs, self.net_arch, self.activation_fn)
        layers = xavier_mlp(*arguments, normalise=self.normalise)
        if self.normalise:
            initialise_output(layers[-1], SMALL_GAIN)
            layers.insert(0, InputNormalisation(self.features_dim, action_dim))
        return nn.Sequential(*layers)


class EquivariantActor(Actor):
    """
    Equivariant actor: its (x, y) rotates with the images, its other outputs are invariant.

    The Gaussian before squashing is equivariant under the whole group. Squashing acts on x and y separately,
    so it commutes only with rotations by 90 degrees and with reflections.

    See Stable-Baselines3's ``Actor`` for the parameters that are not documented here.

    :param net_arch: regular fields of each hidden layer behind the encoder
    :param features_extractor: network with regular features that trivial ones may follow
    :param action_sequence: see :class:`~sb3_extensions.common.action_sequence.ActionSequence`
    :param normalise: whether to normalise hidden layers and start with means near 0 and deviations near 1
    :param use_sde: must be False
    :param kwargs: arguments of state-dependent exploration, without effect
    :raises ValueError: if features or ``action_sequence`` do not fit, or with ``use_sde``
    """

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Box,
        net_arch: list[int],
        features_extractor: BaseFeaturesExtractor,
        features_dim: int,
        action_sequence: str,
        normalise: bool = False,
        activation_fn: type[nn.Module] = nn.ReLU,
        use_sde: bool = False,
        normalize_images: bool = True,
        **kwargs: Any,
    ) -> None:
        if use_sde:
            raise ValueError("use_sde=True: the noise of state-dependent exploration is not equivariant")
        # Actor's own constructor would build heads that are not equivariant
        super(Actor, self).__init__(
            observation_space,
            action_space,
            features_extractor=features_extractor,
            normalize_images=normalize_images,
            squash_output=True,
        )
        self.use_sde = False
        action_dim = get_action_dim(action_space)
        action = ActionSequence(action_sequence, action_dim)
        gain = SMALL_GAIN if normalise else 1.0
        hidden_type = in_type = features_type(features_extractor)
        if net_arch:
            hidden_type = FieldType.of((in_type.group.regular, net_arch[-1]))
        self.latent_pi = equivariant_mlp(in_type, net_arch, activation_fn, normalise)
        self.action_dist = SquashedDiagGaussianDistribution(action_dim)  # type: ignore[assignment]
        self.mu = EquivariantMean(hidden_type, action, gain)
        self.log_std = EquivariantLogStd(hidden_type, action, gain)  # type: ignore[assignment]


class EquivariantCritic(MultiHeadCritic):
    """
    Critic that is invariant to a rotation of the images together with (x, y) of the action.

    :param action_sequence: see :class:`~sb3_extensions.common.action_sequence.ActionSequence`
    :param kwargs: parameters of :class:`MultiHeadCritic`. ``net_arch`` and the features are regular fields.
        An empty ``net_arch`` is replaced by one layer with the number of fields of the features
    :raises ValueError: if features or ``action_sequence`` do not fit
    """

    def __init__(self, action_sequence: str, **kwargs: Any) -> None:
        self.action_sequence = action_sequence
        super().__init__(**kwargs)

    def _make_head(self) -> nn.Module:
        in_type = features_type(self.features_extractor)
        action = ActionSequence(self.action_sequence, get_action_dim(self.action_space))
        net_arch = self.net_arch or [in_type.fields[0][1]]
        return InvariantValue(in_type, action, net_arch, self.n_outputs, self.activation_fn, self.normalise)
