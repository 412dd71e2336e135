"""Equivariant encoder of a square image to a vector: the paper's closed-loop one."""

from __future__ import annotations

from collections.abc import Sequence

from sb3_extensions.encoders.cnn import Encoder, encoded_size, plan_stages, scale_channels
from sb3_extensions.equivariant.groups import FieldType, Group
from sb3_extensions.equivariant.layers import EquivariantConv2d


class EquivariantEncoder(Encoder):
    """Encoder to regular fields at the image's centre: turning the image permutes the numbers of each field.

    :param in_channels: channels of the image, all scalar (trivial fields)
    :param size: side of the image, pixels; resized if it is not 6 or 8 times a power of two
    :param group: the symmetry
    :param channels: regular fields after each stage; those of the paper, for the size, if ``None``
    :param strided: see :func:`plan_stages`
    :param channels_last: see :class:`Encoder`
    :param autocast: see :class:`Encoder`
    :raises ValueError: if size, channels and strided do not fit together
    """

    # Close-loop equivariant baseline of the paper, 128 x 128 pixels.
    HALVING, LAST = (8, 16, 32, 64), (128, 64, 64)

    def __init__(
        self,
        in_channels: int,
        size: int,
        group: Group,
        channels: Sequence[int] | None = None,
        strided: int = 0,
        channels_last: bool = True,
        autocast: str | None = None,
    ) -> None:
        channels = channels or scale_channels(size, self.HALVING, self.LAST)
        stages = plan_stages(size, len(channels), strided)
        out_types = [FieldType.of((group.regular, count)) for count in channels]
        in_types = [FieldType.of((group.trivial, in_channels)), *out_types]
        convolutions = [
            EquivariantConv2d(in_type, out_type, stage.kernel_size, stage.stride, stage.padding)
            for in_type, out_type, stage in zip(in_types, out_types, stages, strict=False)
        ]
        super().__init__(convolutions, stages, encoded_size(size), channels_last, autocast)
        self.out_type = out_types[-1]
        self.features_dim = self.out_type.size
