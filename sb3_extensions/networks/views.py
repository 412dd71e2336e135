"""What spatial Q networks see: a heightmap, what was where the gripper closed, and whether it holds
something.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import TensorDict
from torch import nn

from sb3_extensions.replay.quantisation import Quantiser

IMAGE_DIMS = 3
HOLDS = 0.5
"""Above it ``holding`` counts as true."""


class View(NamedTuple):
    """
    A batch of observations as the networks take them.

    :param image: the heightmap, standardised, (batch, 1, size, size)
    :param heights: the same, m, (batch, size, size)
    :param in_hand: the in-hand image, standardised, (batch, channels, side, side); None where there is none
    :param places: whether the gripper holds something, and so will place it, bool (batch,)
    """

    image: th.Tensor
    heights: th.Tensor
    in_hand: th.Tensor | None
    places: th.Tensor

    def of(self, samples: th.Tensor) -> View:
        """
        Some of the observations.

        :param samples: their numbers, or a mask, (batch,)
        """
        in_hand = None if self.in_hand is None else self.in_hand[samples]
        return View(self.image[samples], self.heights[samples], in_hand, self.places[samples])


class SceneView(nn.Module):
    """
    From a Dict observation to a :class:`View`.

    :param observation_space: with a heightmap (1, size, size), m, and perhaps an in-hand image and a number
        that says whether the gripper holds something; without it all actions are picks
    :param quantise: ``"uint8"`` or ``"uint16"``: what the replay buffer stores float images as; ``None`` if
        it stores floats
    :param standardise: (mean, standard deviation), m: images become (image - mean) / standard deviation
    :param image_key: of the heightmap
    :param in_hand_key: of the in-hand image
    :param holding_key: of whether the gripper holds something
    :raises ValueError: if there is no such heightmap, an image is not square, or the deviation is not
        positive
    """

    def __init__(
        self,
        observation_space: gym.Space[Any],
        quantise: str | None = "uint8",
        standardise: Sequence[float] = (0.0, 1.0),
        image_key: str = "heightmap",
        in_hand_key: str = "in_hand",
        holding_key: str = "holding",
    ) -> None:
        super().__init__()
        parts = observation_space.spaces if isinstance(observation_space, spaces.Dict) else {}
        image = parts.get(image_key)
        if not isinstance(image, spaces.Box) or len(image.shape) != IMAGE_DIMS or image.shape[0] != 1:
            raise ValueError(
                f"observation_space must be a Dict with a heightmap (1, size, size) under {image_key!r}, "
                f"got {observation_space}"
            )
        in_hand = parts.get(in_hand_key)
        images = {image_key: image} | ({in_hand_key: in_hand} if isinstance(in_hand, spaces.Box) else {})
        for key, space in images.items():
            if len(space.shape) != IMAGE_DIMS or space.shape[1] != space.shape[2]:
                raise ValueError(f"images must be square, (channels, side, side), {key!r} is {space.shape}")
        mean, deviation = standardise
        if deviation <= 0:
            raise ValueError(f"standardise must have a positive standard deviation, got {tuple(standardise)}")
        self.size = int(image.shape[1])
        self.in_hand_shape: tuple[int, int, int] | None = None
        if isinstance(in_hand, spaces.Box):
            channels, side, _ = in_hand.shape
            self.in_hand_shape = (channels, side, side)
        self.quantise, self.mean, self.deviation = quantise, mean, deviation
        self.quantisers = {key: Quantiser(space, quantise) for key, space in images.items() if quantise}
        self.image_key, self.in_hand_key = image_key, in_hand_key
        self.holding_key = holding_key if holding_key in parts else None

    has_float_images = True

    @property
    def image_keys(self) -> set[str]:
        """Keys of the images."""
        return {self.image_key} if self.in_hand_shape is None else {self.image_key, self.in_hand_key}

    def forward(self, observations: TensorDict) -> View:
        """
        :param observations: a batch
        :return: the view
        """
        heights = self._rounded(observations, self.image_key)
        in_hand = None
        if self.in_hand_shape is not None:
            in_hand = self.standardised(self._rounded(observations, self.in_hand_key))
        places = th.zeros(len(heights), dtype=th.bool, device=heights.device)
        if self.holding_key is not None:
            places = observations[self.holding_key].flatten(1)[:, 0] > HOLDS
        return View(self.standardised(heights), heights[:, 0], in_hand, places)

    def standardised(self, images: th.Tensor) -> th.Tensor:
        """
        Images in the units of the networks.

        :param images: m, any shape
        """
        return (images - self.mean) / self.deviation

    def _rounded(self, observations: TensorDict, key: str) -> th.Tensor:
        """As the replay buffer gives them back: an agent sees what it is trained on."""
        image = observations[key].float()
        return self.quantisers[key].round_trip(image) if key in self.quantisers else image
