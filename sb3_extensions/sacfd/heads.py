"""Equivariant heads on regular features: parts of actors and critics for actions that move in the plane."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import torch as th
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn
from torch.nn import functional as F

from sb3_extensions.common.action_sequence import ActionSequence
from sb3_extensions.encoders.initialisation import scale_down
from sb3_extensions.equivariant.groups import FieldType, Group
from sb3_extensions.equivariant.layers import EquivariantLinear, GroupMaxPool

# The order in which the numbers of an action stand in their field type: vectors, signs, invariant ones. The
# turns u and v about x and y become a vector as (v, -u), the direction in which what points up leans.
FIELD_ORDER = "xyvurpz"
NEGATED = "u"


def action_type(action: ActionSequence, group: Group) -> FieldType:
    """
    How the numbers of an action turn with the scene: x and y together are a vector, and so are the turns v
    and -u about y and x; r, a rotation about z, changes its sign under reflections; p and z are invariant.

    :param action: which numbers it has
    :param group: the symmetry
    :return: type of the numbers taken in the order of :data:`FIELD_ORDER`
    """
    vectors, signs = ("x" in action) + ("u" in action), int("r" in action)
    rest = action.action_dim - 2 * vectors - signs
    return FieldType.of((group.irrep(1), vectors), (group.sign, signs), (group.trivial, rest))


def _signs(action: ActionSequence) -> th.Tensor:
    """What the numbers of an action are multiplied by to stand in their field type."""
    return th.tensor([-1.0 if name in NEGATED else 1.0 for name in action.names])


class EquivariantMean(nn.Module):
    """Mean of an action, turning with the features: (batch, in channels) to (batch, action_dim), not
    squashed.

    :param in_type: regular fields, and trivial ones if need be
    :param action: which numbers turn
    :param gain: factor of the initial weights
    """

    index: th.Tensor
    signs: th.Tensor

    def __init__(self, in_type: FieldType, action: ActionSequence, gain: float = 1.0) -> None:
        super().__init__()
        self.linear = EquivariantLinear(in_type, action_type(action, in_type.group), gain=gain)
        self.register_buffer("index", th.tensor(action.places(FIELD_ORDER)).argsort(), persistent=False)
        self.register_buffer("signs", _signs(action), persistent=False)

    def forward(self, features: th.Tensor) -> th.Tensor:
        """:return: means in the order of the action"""
        fields: th.Tensor = self.linear(features)
        return fields[:, self.index] * self.signs


class EquivariantLogStd(nn.Module):
    """Logarithm of an action's standard deviations, invariant: (batch, in channels) to (batch, action_dim).

    x and y share one: a Gaussian with two would not turn into one of the same kind, and by 90 degrees they
    would swap. So do turns about x and y.

    :param in_type: regular fields, and trivial ones if need be
    :param action: which numbers share
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
        """:return: in the order of the action"""
        log_std: th.Tensor = self.linear(features)
        return log_std[:, self.index]


class InvariantValue(nn.Module):
    """Value of features and action that stays when both turn: (batch, in channels + action_dim) to (batch,
    outputs).

    Equivariant layers of the features and the action's fields, the largest number of each field, one linear
    map.

    :param in_type: of the features: regular fields, and trivial ones if need be
    :param action: which numbers turn
    :param net_arch: regular fields of each hidden layer, at least one
    :param outputs: 1 for a Q-value, more for quantiles
    :param activation_fn: pointwise nonlinearity
    :param normalise: whether to normalise hidden layers, scale the action to the features, and start near 0
    :raises ValueError: if there is no hidden layer
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
        if not net_arch:
            raise ValueError("net_arch of an equivariant critic (qf) needs at least one hidden layer, got []")
        joint_type = in_type + action_type(action, in_type.group)
        self.hidden = equivariant_mlp(joint_type, net_arch, activation_fn, normalise)
        self.pool = GroupMaxPool(FieldType.of((in_type.group.regular, net_arch[-1])))
        self.value = nn.Linear(net_arch[-1], outputs)
        self.normalisation: nn.Module = nn.Identity()
        if normalise:
            scale_down(self.value)
            self.normalisation = InputNormalisation(in_type.size, action.action_dim)
        places = [*range(in_type.size), *(in_type.size + place for place in action.places(FIELD_ORDER))]
        self.register_buffer("index", th.tensor(places), persistent=False)
        signs = th.cat([th.ones(in_type.size), _signs(action)])
        self.register_buffer("signs", signs, persistent=False)

    def forward(self, features_and_action: th.Tensor) -> th.Tensor:
        """:return: (batch, outputs)"""
        joint = (self.normalisation(features_and_action) * self.signs)[:, self.index]
        values: th.Tensor = self.value(self.pool(self.hidden(joint)))
        return values


class InputNormalisation(nn.Module):
    """
    Normalise the features of a critic's input and scale its actions to their norm.

    The features get mean 0 and variance 1 over each observation. Without the scale, 5 numbers next to 128
    features contribute one hundredth of a hidden unit's variance, and an untrained critic is insensitive to
    the action input.

    :param features_dim: number of features
    :param action_dim: number of action dimensions, in [-1, 1]
    """

    def __init__(self, features_dim: int, action_dim: int) -> None:
        super().__init__()
        self.sizes = [features_dim, action_dim]
        self.gain = math.sqrt(features_dim / action_dim)

    def forward(self, features_and_action: th.Tensor) -> th.Tensor:
        """
        Normalise a batch.

        :param features_and_action: shape (batch, features_dim + action_dim)
        :return: the same shape
        """
        features, actions = features_and_action.split(self.sizes, dim=1)
        return th.cat([F.layer_norm(features, features.shape[1:]), actions * self.gain], dim=1)


def equivariant_mlp(
    in_type: FieldType, net_arch: Sequence[int], activation_fn: type[nn.Module], normalise: bool = False
) -> nn.Sequential:
    """Layers to regular fields, each followed by the nonlinearity.

    :param in_type: input fields
    :param net_arch: regular fields of each layer; none gives the identity
    :param activation_fn: pointwise nonlinearity
    :param normalise: normalise what each layer gives, without learned scales; the group only permutes it
    """
    types = [in_type] + [FieldType.of((in_type.group.regular, count)) for count in net_arch]
    layers: list[nn.Module] = []
    for layer_in, layer_out in pairwise(types):
        norm = [nn.LayerNorm(layer_out.size, elementwise_affine=False)] if normalise else []
        layers += [EquivariantLinear(layer_in, layer_out), *norm, activation_fn()]
    return nn.Sequential(*layers)


def features_type(features_extractor: BaseFeaturesExtractor) -> FieldType:
    """Type of an extractor's features, for heads that need regular fields; trivial ones may follow them.

    :param features_extractor: with an ``out_type``, as
        :class:`~sb3_extensions.encoders.extractors.EquivariantExtractor` has
    :raises ValueError: if its features do not begin with regular fields, or have others than these two kinds
    """
    out_type = getattr(features_extractor, "out_type", None)
    kinds = [rep.kind for rep, _ in out_type.fields] if isinstance(out_type, FieldType) else []
    if kinds not in (["regular"], ["regular", "trivial"]):
        raise ValueError(
            "an equivariant policy needs features of regular fields, as EquivariantExtractor's with "
            f"output='regular'; features_extractor_class {type(features_extractor).__name__} has {out_type}"
        )
    assert isinstance(out_type, FieldType)
    return out_type
