"""Equivariant output layers of actors and critics, for features of regular fields."""

import math
from collections.abc import Sequence
from itertools import pairwise

import torch as th
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn
from torch.nn import functional as F

from sb3_extensions.common.action_sequence import ActionSequence
from sb3_extensions.encoders.initialisation import SMALL_GAIN, initialise_output
from sb3_extensions.equivariant.groups import FieldType, Group
from sb3_extensions.equivariant.layers import EquivariantLinear, GroupMaxPool

FIELD_ORDER = "xyvurpz"
"""Order of the action dimensions in their field type: vectors, sign fields, invariant ones. The rotations u
and v about x and y transform as the vector (v, -u), the horizontal direction in which the gripper tilts."""
NEGATED = "u"


def action_type(action: ActionSequence, group: Group) -> FieldType:
    """Return the field type of an action, in the order of :data:`FIELD_ORDER`."""
    vectors, signs = ("x" in action) + ("u" in action), int("r" in action)
    rest = action.action_dim - 2 * vectors - signs
    return FieldType.of((group.irrep(1), vectors), (group.sign, signs), (group.trivial, rest))


def _signs(action: ActionSequence) -> th.Tensor:
    """Return the sign of each action dimension in the field type."""
    return th.tensor([-1.0 if name in NEGATED else 1.0 for name in action.names])


class EquivariantMean(nn.Module):
    """
    Equivariant linear layer for the mean of an action before squashing.

    :param in_type: field type of the features, regular fields that trivial ones may follow
    :param action: names of the action dimensions
    :param gain: factor of the initial weights
    """

    index: th.Tensor
    signs: th.Tensor

    def __init__(self, in_type: FieldType, action: ActionSequence, gain: float = 1.0) -> None:
        super().__init__()
        self.linear = EquivariantLinear(in_type, action_type(action, in_type.group), gain=gain)
        self.register_buffer("index", th.tensor(action.indices(FIELD_ORDER)).argsort(), persistent=False)
        self.register_buffer("signs", _signs(action), persistent=False)

    def forward(self, features: th.Tensor) -> th.Tensor:
        """:return: means, shape (batch, action dimensions)"""
        fields: th.Tensor = self.linear(features)
        return fields[:, self.index] * self.signs


class EquivariantLogStd(nn.Module):
    """
    Invariant linear layer for the logarithms of an action's standard deviations.

    x and y share one standard deviation, because a rotated Gaussian with two different ones is not diagonal.
    For the same reason the rotations about x and y share one. See :class:`EquivariantMean` for the
    parameters.
    """

    index: th.Tensor

    def __init__(self, in_type: FieldType, action: ActionSequence, gain: float = 1.0) -> None:
        super().__init__()
        names = [next((pair for pair in ("xy", "uv") if name in pair), name) for name in action.names]
        distinct = sorted(set(names))
        out_type = FieldType.of((in_type.group.trivial, len(distinct)))
        self.linear = EquivariantLinear(in_type, out_type, gain=gain)
        index = th.tensor([distinct.index(name) for name in names])
        self.register_buffer("index", index, persistent=False)

    def forward(self, features: th.Tensor) -> th.Tensor:
        """:return: logarithms, shape (batch, action dimensions)"""
        log_std: th.Tensor = self.linear(features)
        return log_std[:, self.index]


class InvariantValue(nn.Module):
    """
    Head of a critic that is invariant to a rotation of features and action together.

    It consists of equivariant hidden layers, the maximum over each field, and a linear layer. See
    :class:`EquivariantMean` for the other parameters.

    :param net_arch: regular fields of each hidden layer, at least one layer
    :param outputs: number of outputs, 1 for a Q-value, more for quantiles
    :param activation_fn: pointwise activation function
    :param normalise: whether to normalise features and hidden layers, scale the action to the norm of the
        features, and start with values near 0
    """

    index: th.Tensor
    signs: th.Tensor

    def __init__(
        self,
        in_type: FieldType,
        action: ActionSequence,
        net_arch: Sequence[int],
        outputs: int = 1,
        activation_fn: type[nn.Module] = nn.ReLU,
        normalise: bool = False,
    ) -> None:
        super().__init__()
        joint_type = in_type + action_type(action, in_type.group)
        self.hidden = equivariant_mlp(joint_type, net_arch, activation_fn, normalise)
        self.pool = GroupMaxPool(FieldType.of((in_type.group.regular, net_arch[-1])))
        self.value = nn.Linear(net_arch[-1], outputs)
        self.normalisation: nn.Module = nn.Identity()
        initialise_output(self.value, SMALL_GAIN if normalise else 1.0)
        if normalise:
            self.normalisation = InputNormalisation(in_type.size, action.action_dim)
        index = [*range(in_type.size), *(in_type.size + i for i in action.indices(FIELD_ORDER))]
        self.register_buffer("index", th.tensor(index), persistent=False)
        signs = th.cat([th.ones(in_type.size), _signs(action)])
        self.register_buffer("signs", signs, persistent=False)

    def forward(self, features_and_action: th.Tensor) -> th.Tensor:
        """:return: values, shape (batch, outputs)"""
        joint = (self.normalisation(features_and_action) * self.signs)[:, self.index]
        values: th.Tensor = self.value(self.pool(self.hidden(joint)))
        return values


class InputNormalisation(nn.Module):
    """
    Normalise the features of each observation to mean 0 and variance 1, and scale the actions to their norm.

    Without the scale, an untrained critic is insensitive to the action input.
    """

    def __init__(self, features_dim: int, action_dim: int) -> None:
        super().__init__()
        self.sizes = [features_dim, action_dim]
        self.gain = math.sqrt(features_dim / action_dim)

    def forward(self, features_and_action: th.Tensor) -> th.Tensor:
        """:return: normalised input, the same shape"""
        features, actions = features_and_action.split(self.sizes, dim=1)
        return th.cat([F.layer_norm(features, features.shape[1:]), actions * self.gain], dim=1)


def equivariant_mlp(
    in_type: FieldType, net_arch: Sequence[int], activation_fn: type[nn.Module], normalise: bool = False
) -> nn.Sequential:
    """
    Create an equivariant multi-layer perceptron with ``net_arch`` regular fields, [] for the identity.

    With ``normalise`` the outputs of all layers are normalised without learned parameters.
    """
    types = [in_type] + [FieldType.of((in_type.group.regular, count)) for count in net_arch]
    layers: list[nn.Module] = []
    for layer_in, layer_out in pairwise(types):
        norm = [nn.LayerNorm(layer_out.size, elementwise_affine=False)] if normalise else []
        layers += [EquivariantLinear(layer_in, layer_out), *norm, activation_fn()]
    return nn.Sequential(*layers)


def features_type(features_extractor: BaseFeaturesExtractor) -> FieldType:
    """
    Return the field type of the features of an extractor, its attribute ``out_type``.

    :raises ValueError: if the features are not regular fields that trivial ones may follow
    """
    out_type = getattr(features_extractor, "out_type", None)
    kinds = [rep.kind for rep, _ in out_type.fields] if isinstance(out_type, FieldType) else []
    if kinds not in (["regular"], ["regular", "trivial"]):
        raise ValueError(
            "features_extractor_class must have regular features in an equivariant policy, such as "
            "EquivariantExtractor with output='regular', got "
            f"{type(features_extractor).__name__} with {out_type}"
        )
    assert isinstance(out_type, FieldType)
    return out_type
