"""Actors and critics of the policies: the paper's CNN and its equivariant network."""

from functools import partial
from typing import Any

import torch as th
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import create_mlp
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


class XavierActor(Actor):
    """
    Actor with Xavier uniform weights behind the encoder (the authors' code).

    :param normalise: whether to normalise hidden layers and start with means near 0 and deviations near 1
    :param kwargs: parameters of Stable-Baselines3's ``Actor``
    """

    def __init__(self, *, normalise: bool = False, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.normalise = normalise
        layers = xavier_mlp(self.features_dim, -1, self.net_arch, self.activation_fn, normalise=normalise)
        self.latent_pi = nn.Sequential(*layers)
        for output in (self.mu, self.log_std):
            if isinstance(output, nn.Linear):
                initialise_output(output, SMALL_GAIN if normalise else 1.0)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), "normalise": self.normalise}


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

    :param action_sequence: see :class:`~sb3_extensions.common.action_sequence.ActionSequence`
    :param normalise: whether to normalise hidden layers and start with means near 0 and deviations near 1
    :param kwargs: parameters of Stable-Baselines3's ``Actor``. ``net_arch`` and the features are regular
        fields, which trivial ones may follow in the features
    :raises ValueError: if features or ``action_sequence`` do not fit, or with ``use_sde``
    """

    def __init__(self, *, action_sequence: str, normalise: bool = False, **kwargs: Any) -> None:
        if kwargs.get("use_sde"):
            raise ValueError("use_sde=True: the noise of state-dependent exploration is not equivariant")
        with th.random.fork_rng(devices=[]):  # initial weights do not depend on the layers replaced below
            super().__init__(**kwargs)
        self.action_sequence, self.normalise = action_sequence, normalise
        action = ActionSequence(action_sequence, get_action_dim(self.action_space))
        gain = SMALL_GAIN if normalise else 1.0
        hidden_type = in_type = features_type(self.features_extractor)
        if self.net_arch:
            hidden_type = FieldType.of((in_type.group.regular, self.net_arch[-1]))
        self.latent_pi = equivariant_mlp(in_type, self.net_arch, self.activation_fn, normalise)
        self.mu = EquivariantMean(hidden_type, action, gain)
        self.log_std = EquivariantLogStd(hidden_type, action, gain)  # type: ignore[assignment]

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        return {**data, "action_sequence": self.action_sequence, "normalise": self.normalise}


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
