"""Equivariant encoder of a square image to a vector: the paper's closed-loop encoder."""

from collections.abc import Sequence
from typing import Any

import torch as th

from sb3_extensions.encoders.cnn import Encoder, scale_channels
from sb3_extensions.equivariant.groups import FieldType, Group
from sb3_extensions.equivariant.layers import EquivariantConv2d, GroupMaxPool

OUTPUTS = ("regular", "invariant")


class EquivariantEncoder(Encoder):
    """Encoder to regular fields: a rotation of the image permutes the numbers of each field.

    :param in_channels: channels of the image, all scalar (trivial fields)
    :param size: side of the image, pixels
    :param group: symmetry group
    :param channels: regular fields after each stage; by default the paper's, for the size
    :param output: ``"regular"``, or ``"invariant"`` to reduce each field to its maximum
    :param kwargs: further parameters of :class:`~sb3_extensions.encoders.cnn.Encoder`
    :raises ValueError: if ``output`` is unknown, or see :class:`~sb3_extensions.encoders.cnn.Encoder`
    """

    # Close-loop equivariant baseline of the paper, 128 x 128 pixels.
    HALVING, LAST = (8, 16, 32, 64), (128, 64, 64)

    def __init__(
        self,
        in_channels: int,
        size: int,
        group: Group,
        channels: Sequence[int] | None = None,
        output: str = "regular",
        **kwargs: Any,
    ) -> None:
        if output not in OUTPUTS:
            raise ValueError(f"output must be one of {OUTPUTS}, got {output!r}")
        channels = channels or scale_channels(size, self.HALVING, self.LAST)
        image = FieldType.of((group.trivial, in_channels))
        types = [image, *(FieldType.of((group.regular, count)) for count in channels)]
        super().__init__(EquivariantConv2d, types, size, **kwargs)
        self.pool = GroupMaxPool(types[-1]) if output == "invariant" else None
        self.out_type = types[-1] if self.pool is None else self.pool.out_type
        self.features_dim = self.out_type.size

    def forward(self, image: th.Tensor) -> th.Tensor:
        """:return: float32 features, (batch, features)"""
        features = super().forward(image)
        return features if self.pool is None else self.pool(features)
