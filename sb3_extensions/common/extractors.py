"""Features extractors for Dict observations of images and numbers; they serve any Stable-Baselines3 algorithm."""

from __future__ import annotations

from collections.abc import Sequence

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim, is_image_space
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_extensions.common.encoders import CnnEncoder, EquivariantEncoder
from sb3_extensions.common.equivariant import GroupMaxPool
from sb3_extensions.common.groups import Group
from sb3_extensions.common.quantisation import Quantiser

OUTPUTS = ("regular", "invariant")


class StackedImage(nn.Module):
    """One image of a Dict observation: the images' channels on [0, 1], and a constant channel for each
    further number.

    Float images (such as heights in metres) are scaled by the bounds of their space, rounded to the levels
    that the replay buffer stores; ``uint8`` images arrive already scaled by Stable-Baselines3 (its
    ``normalize_images`` must stay on). Images without finite bounds and all other numbers are taken as they
    are.

    :param observation_space: with at least one image, (channels, size, size), all of one size
    :param quantise: ``"uint8"`` or ``"uint16"``: what the replay buffer stores float images as; ``None`` if
        it stores floats
    :raises ValueError: if the space is no Dict, or has no image or images of other shapes, or its bounds
        cannot be quantised
    """

    def __init__(self, observation_space: gym.Space, quantise: str | None) -> None:
        super().__init__()
        if not isinstance(observation_space, spaces.Dict):
            raise ValueError(f"observation_space must be a Dict of images and numbers, got {observation_space}")
        self.image_keys = [key for key, space in observation_space.items() if len(space.shape or ()) == 3]
        self.vector_keys = [key for key in observation_space if key not in self.image_keys]
        shapes = {key: observation_space[key].shape for key in self.image_keys}
        sides = {side for shape in shapes.values() for side in shape[1:]}  # type: ignore[index]
        if len(sides) != 1:
            raise ValueError(f"observation_space needs images (channels, size, size) of one size, got {shapes}")
        self.size = int(sides.pop())
        self.channels = sum(shape[0] for shape in shapes.values())  # type: ignore[index]
        self.channels += sum(get_flattened_obs_dim(observation_space[key]) for key in self.vector_keys)
        self.scales = {key: _Scale(key, observation_space[key], quantise) for key in self.image_keys}

    def forward(self, observations: dict[str, th.Tensor]) -> th.Tensor:
        """:return: (batch, channels, size, size)"""
        images = [self.scales[key](observations[key]) for key in self.image_keys]
        numbers = [observations[key].flatten(1)[..., None, None] for key in self.vector_keys]
        return th.cat(images + [n.expand(-1, -1, self.size, self.size) for n in numbers], dim=1)


class _Scale:
    """Maps an image to [0, 1].

    :param key: of the observation, for the error
    :param space: of the image
    :param quantise: see :class:`StackedImage`
    """

    def __init__(self, key: str, space: gym.Space, quantise: str | None) -> None:
        assert isinstance(space, spaces.Box)
        self.quantiser: Quantiser | None = None
        self.low, self.span = 0.0, 1.0
        if is_image_space(space):
            return
        if quantise is not None:
            try:
                self.quantiser = Quantiser(space, quantise)
            except ValueError as error:
                raise ValueError(f"quantise={quantise!r} does not fit observation {key!r}: {error}") from error
        elif np.isfinite(space.low).all() and np.isfinite(space.high).all():
            self.low = float(space.low.min())
            self.span = float(space.high.max()) - self.low

    def __call__(self, image: th.Tensor) -> th.Tensor:
        if self.quantiser is not None:
            return self.quantiser.normalise(image)
        return (image - self.low) / self.span


class CnnExtractor(BaseFeaturesExtractor):
    """Plain convolutional encoder of a Dict observation of images and numbers.

    :param observation_space: see :class:`StackedImage`
    :param channels: output channels of each stage, see :class:`~sb3_extensions.common.encoders.CnnEncoder`
    :param quantise: see :class:`StackedImage`
    :param channels_last: see :class:`~sb3_extensions.common.encoders.Encoder`
    :param autocast: ``None`` or ``"bf16"``, see :class:`~sb3_extensions.common.encoders.Encoder`
    """

    def __init__(
        self,
        observation_space: gym.Space,
        channels: Sequence[int] | None = None,
        quantise: str | None = "uint8",
        channels_last: bool = True,
        autocast: str | None = None,
    ) -> None:
        stack = StackedImage(observation_space, quantise)
        encoder = CnnEncoder(stack.channels, stack.size, channels, channels_last, autocast)
        super().__init__(observation_space, encoder.features_dim)
        self.stack, self.encoder = stack, encoder

    def forward(self, observations: dict[str, th.Tensor]) -> th.Tensor:
        """:return: (batch, features_dim)"""
        features: th.Tensor = self.encoder(self.stack(observations))
        return features


class EquivariantExtractor(BaseFeaturesExtractor):
    """Equivariant encoder of a Dict observation: scalar images that turn with the scene, and numbers that do
    not.

    With ``output="regular"`` the features are regular fields, permuted when the images turn: for equivariant
    heads; behind an ordinary head (PPO's, TQC's) symmetry is lost there. With ``output="invariant"`` each
    field is reduced to its largest number: any head is then invariant, right for values, too poor for the
    direction of a motion.

    :param observation_space: see :class:`StackedImage`
    :param group: ``"cyclic"`` (rotations) or ``"dihedral"`` (reflections too)
    :param n: number of rotations
    :param channels: regular fields after each stage, see
        :class:`~sb3_extensions.common.encoders.EquivariantEncoder`
    :param output: ``"regular"`` or ``"invariant"``
    :param quantise: see :class:`StackedImage`
    :param channels_last: see :class:`~sb3_extensions.common.encoders.Encoder`
    :param autocast: ``None`` or ``"bf16"``, see :class:`~sb3_extensions.common.encoders.Encoder`
    :raises ValueError: if ``group``, ``n`` or ``output`` is none of these, or the encoder does not fit the
        images
    """

    def __init__(
        self,
        observation_space: gym.Space,
        group: str = "cyclic",
        n: int = 8,
        channels: Sequence[int] | None = None,
        output: str = "regular",
        quantise: str | None = "uint8",
        channels_last: bool = True,
        autocast: str | None = None,
    ) -> None:
        if output not in OUTPUTS:
            raise ValueError(f"output must be one of {OUTPUTS}, got {output!r}")
        stack = StackedImage(observation_space, quantise)
        encoder = EquivariantEncoder(stack.channels, stack.size, Group(group, n), channels, channels_last, autocast)
        pool = GroupMaxPool(encoder.out_type) if output == "invariant" else None
        out_type = encoder.out_type if pool is None else pool.out_type
        super().__init__(observation_space, out_type.size)
        self.stack, self.encoder, self.pool, self.out_type = stack, encoder, pool, out_type

    def forward(self, observations: dict[str, th.Tensor]) -> th.Tensor:
        """:return: (batch, features_dim)"""
        features: th.Tensor = self.encoder(self.stack(observations))
        return features if self.pool is None else self.pool(features)
