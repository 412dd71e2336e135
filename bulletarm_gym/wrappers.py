"""Wrappers that make an environment fit what other libraries take."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray
from PIL import Image

from bulletarm_gym.values import check_argument, integer, optional

Picture = NDArray[np.uint8]

WHITE = 255
"""Greatest value of a channel."""
IMAGE_AXES = 3
"""Of an observed image: channels, rows, columns."""


class ImageObservation(
    gymnasium.ObservationWrapper[Picture, Any, dict[str, NDArray[Any]]], RecordConstructorArgs
):
    """Everything observed as one image of bytes: what libraries for Atari games take.

    Each channel of each image becomes a channel, in the order of the observation space; then each number,
    such as ``holding``, one that has the number in every pixel. A channel spans the bounds of its space:
    ``low`` becomes 0, ``high`` 255, what is between them the nearest of 254 others. Of a heightmap, 0 to
    0.4 m, a count is 1.6 mm, so the greatest error 0.8 mm. Images of another size are brought to ``size`` by
    linear interpolation, over all the pixels that one replaces where they get smaller.

    :param env: environment with a ``Dict`` of images (channels, rows, columns) and vectors of numbers, all of
        them with finite bounds
    :param size: side of the image in pixels; default: of the largest image
    :param channels_last: (size, size, channels), as RLlib takes images, instead of (channels, size, size)
    :raises ValueError: ``env`` observes something that is no part of an image, such as
        ``observation="state"``; ``size`` is not positive
    """

    def __init__(
        self,
        env: gymnasium.Env[dict[str, NDArray[Any]], Any],
        size: int | None = None,
        channels_last: bool = False,
    ) -> None:
        RecordConstructorArgs.__init__(self, size=size, channels_last=channels_last)
        gymnasium.ObservationWrapper.__init__(self, env)
        self._parts = _parts(env.observation_space)
        sides = [side for box in self._parts.values() for side in box.shape[1:]]
        check_argument("size", size, optional(integer(1)))
        self.size = max(sides) if size is None else size
        count = len(self.channels)
        self._axis = -1 if channels_last else 0
        self._shape = (self.size, self.size, count) if channels_last else (count, self.size, self.size)
        self.observation_space = spaces.Box(0, WHITE, self._shape, np.uint8)

    @property
    def channels(self) -> tuple[str, ...]:
        """What each channel shows: ``"heightmap"``, or ``"in_hand_0"`` where there are several of one."""
        counts = [(name, box.shape[0]) for name, box in self._parts.items()]
        return tuple(
            name if count == 1 else f"{name}_{number}" for name, count in counts for number in range(count)
        )

    def observation(self, observation: dict[str, NDArray[Any]]) -> Picture:
        """Return the image, (channels, size, size) or, where asked for, (size, size, channels)."""
        image = np.empty(self._shape, np.uint8)
        values = (layer for name, box in self._parts.items() for layer in _shares(observation[name], box))
        for channel, layer in zip(np.moveaxis(image, self._axis, 0), values, strict=True):
            channel[:] = np.rint(WHITE * self._to_size(layer))
        return image

    def images(self, observations: dict[str, NDArray[Any]]) -> Picture:
        """Return the images of n observations, such as a demonstrated episode's.

        :param observations: for each key (n, ...)
        """
        rows = zip(*observations.values(), strict=True)
        return np.stack([self.observation(dict(zip(observations, row, strict=True))) for row in rows])

    def _to_size(self, layer: NDArray[np.float32]) -> NDArray[np.float32]:
        """Bring a channel to the size of the image; a number fits as it is."""
        if layer.ndim == 0 or layer.shape == (self.size, self.size):
            return layer
        resized = Image.fromarray(layer).resize((self.size, self.size), Image.Resampling.BILINEAR)
        return np.asarray(resized)


def _parts(space: spaces.Space[Any]) -> dict[str, spaces.Box]:
    """Return what the image is made of: images, then numbers.

    :raises ValueError: there is no image, or something that is no part of one
    """
    named = dict(space.items()) if isinstance(space, spaces.Dict) else {}
    boxes = {name: box for name, box in named.items() if isinstance(box, spaces.Box) and _fits(box)}
    images = {name: box for name, box in boxes.items() if len(box.shape) == IMAGE_AXES}
    if not images or boxes.keys() != named.keys():
        other = next((f"{name!r}: {part}" for name, part in named.items() if name not in boxes), str(space))
        raise ValueError(
            f"env: got one that observes {other}, takes a Dict of images (channels, rows, columns) "
            "and vectors of numbers with finite bounds"
        )
    return {**images, **boxes}


def _fits(box: spaces.Box) -> bool:
    return len(box.shape) in (1, IMAGE_AXES) and box.is_bounded()


def _shares(value: NDArray[Any], box: spaces.Box) -> NDArray[np.float32]:
    """Return where values lie between their bounds, 0 to 1."""
    low, high = box.low.astype(np.float32), box.high.astype(np.float32)
    shares: NDArray[np.float32] = (np.asarray(value, np.float32) - low) / (high - low)
    return shares
