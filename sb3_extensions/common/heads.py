"""Equivariant heads on regular features: parts of actors and critics for actions that move in the plane."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch as th
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_extensions.common.equivariant import EquivariantLinear, GroupMaxPool
from sb3_extensions.common.groups import FieldType, Group

ACTION_SYMBOLS = "pxyzr"
# Small at first, so that an untrained actor explores all actions: means near 0, standard deviations near 1.
OUTPUT_GAIN = 0.1


@dataclass(frozen=True)
class ActionFields:
    """Which numbers of an action turn with the scene, and how.

    x and y together are a vector; r, a rotation about z, changes sign under reflections; p and z are
    invariant.

    :param sequence: one character a number: each of ``p`` (gripper), ``x``, ``y``, ``z``, ``r`` at most once,
        in any order
    :param action_dim: length of an action
    :raises ValueError: if the sequence has another length, unknown or repeated characters, or only one of x
        and y
    """

    sequence: str
    action_dim: int

    def __post_init__(self) -> None:
        problem = None
        if len(self.sequence) != self.action_dim:
            problem = f"names {len(self.sequence)} numbers, but the action space has {self.action_dim}"
        elif unknown := sorted(set(self.sequence) - set(ACTION_SYMBOLS)):
            problem = f"contains {''.join(unknown)!r}; it may contain the characters of {ACTION_SYMBOLS!r}"
        elif len(set(self.sequence)) < len(self.sequence):
            problem = "repeats a character"
        elif ("x" in self.sequence) != ("y" in self.sequence):
            problem = "needs both x and y, or neither"
        if problem is not None:
            raise ValueError(f"action_sequence={self.sequence!r} {problem}")

    @property
    def order(self) -> list[int]:
        """Places in the action of the numbers, in the order of :meth:`field_type`: x, y, r, and the rest."""
        return [self.sequence.index(symbol) for symbol in "xyrpz" if symbol in self.sequence]

    @property
    def std_index(self) -> list[int]:
        """For each number of the action, which standard deviation it takes: x and y share the first."""
        shared = int("x" in self.sequence)
        others = [symbol for symbol in self.sequence if symbol not in "xy"]
        return [0 if symbol in "xy" else others.index(symbol) + shared for symbol in self.sequence]

    def field_type(self, group: Group) -> FieldType:
        """Type of the numbers taken in :attr:`order`."""
        vectors, signs = int("x" in self.sequence), int("r" in self.sequence)
        rest = self.action_dim - 2 * vectors - signs
        return FieldType.of((group.irrep(1), vectors), (group.sign, signs), (group.trivial, rest))


class EquivariantMean(nn.Module):
    """Mean of an action, turning with the features: (batch, in channels) to (batch, action_dim), not
    squashed.

    :param in_type: regular fields
    :param action: which numbers turn
    """

    index: th.Tensor

    def __init__(self, in_type: FieldType, action: ActionFields) -> None:
        super().__init__()
        self.linear = EquivariantLinear(in_type, action.field_type(in_type.group), gain=OUTPUT_GAIN)
        self.register_buffer("index", th.tensor(action.order).argsort(), persistent=False)

    def forward(self, features: th.Tensor) -> th.Tensor:
        """:return: means in the order of the action"""
        fields: th.Tensor = self.linear(features)
        return fields[:, self.index]


class EquivariantLogStd(nn.Module):
    """Logarithm of an action's standard deviations, invariant: (batch, in channels) to (batch, action_dim).

    x and y share one: a Gaussian with two would not turn into one of the same kind, and by 90 degrees they
    would swap.

    :param in_type: regular fields
    :param action: which numbers share
    """

    index: th.Tensor

    def __init__(self, in_type: FieldType, action: ActionFields) -> None:
        super().__init__()
        out_type = FieldType.of((in_type.group.trivial, max(action.std_index) + 1))
        self.linear = EquivariantLinear(in_type, out_type, gain=OUTPUT_GAIN)
        self.register_buffer("index", th.tensor(action.std_index), persistent=False)

    def forward(self, features: th.Tensor) -> th.Tensor:
        """:return: in the order of the action"""
        log_std: th.Tensor = self.linear(features)
        return log_std[:, self.index]


class InvariantValue(nn.Module):
    """Value of features and action that stays when both turn: (batch, in channels + action_dim) to (batch,
    outputs).

    Equivariant layers of the features and the action's fields, the largest number of each field, one linear
    map.

    :param in_type: regular fields of the features
    :param action: which numbers turn
    :param net_arch: regular fields of each hidden layer, at least one
    :param outputs: 1 for a Q-value, more for quantiles
    :param activation_fn: pointwise nonlinearity
    :raises ValueError: if there is no hidden layer
    """

    index: th.Tensor

    def __init__(
        self,
        in_type: FieldType,
        action: ActionFields,
        net_arch: Sequence[int],
        outputs: int = 1,
        activation_fn: type[nn.Module] = nn.ReLU,
    ) -> None:
        super().__init__()
        if not net_arch:
            raise ValueError("net_arch of an equivariant critic (qf) needs at least one hidden layer, got []")
        self.hidden = equivariant_mlp(in_type + action.field_type(in_type.group), net_arch, activation_fn)
        self.pool = GroupMaxPool(FieldType.of((in_type.group.regular, net_arch[-1])))
        self.value = nn.Linear(net_arch[-1], outputs)
        places = [*range(in_type.size), *(in_type.size + place for place in action.order)]
        self.register_buffer("index", th.tensor(places), persistent=False)

    def forward(self, features_and_action: th.Tensor) -> th.Tensor:
        """:return: (batch, outputs)"""
        values: th.Tensor = self.value(self.pool(self.hidden(features_and_action[:, self.index])))
        return values


def equivariant_mlp(
    in_type: FieldType, net_arch: Sequence[int], activation_fn: type[nn.Module]
) -> nn.Sequential:
    """Layers to regular fields, each followed by the nonlinearity.

    :param in_type: input fields
    :param net_arch: regular fields of each layer; none gives the identity
    :param activation_fn: pointwise nonlinearity
    """
    types = [in_type] + [FieldType.of((in_type.group.regular, count)) for count in net_arch]
    layers = [[EquivariantLinear(*pair), activation_fn()] for pair in pairwise(types)]
    return nn.Sequential(*(layer for pair in layers for layer in pair))


def regular_type(features_extractor: BaseFeaturesExtractor) -> FieldType:
    """Type of an extractor's features, for heads that need regular fields.

    :param features_extractor: with an ``out_type``, as
        :class:`~sb3_extensions.common.extractors.EquivariantExtractor` has
    :raises ValueError: if its features are not regular fields
    """
    out_type = getattr(features_extractor, "out_type", None)
    if not isinstance(out_type, FieldType) or any(rep.kind != "regular" for rep, _ in out_type.fields):
        raise ValueError(
            "an equivariant policy needs features of regular fields, as EquivariantExtractor's with "
            f"output='regular'; features_extractor_class {type(features_extractor).__name__} has {out_type}"
        )
    return out_type
