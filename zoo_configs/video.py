"""Films of episodes: what a person sees beside what the agent sees, with a caption."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from matplotlib import colormaps
from PIL import Image, ImageDraw, ImageFont

from zoo_configs.files import whole_file

Frame = npt.NDArray[np.uint8]

PANEL_SIZE = 320  # pixels a side
CAPTION_HEIGHT = 32  # pixels; with the panels a multiple of 16, as video codecs want
FONT_SIZE = 15
BACKGROUND = (24, 26, 30)
FOREGROUND = (235, 235, 235)
SUCCESS_COLOUR = (110, 200, 120)
COLOUR_MAP = "magma_r"


def compose_frame(
    picture: Frame, observation: Any, space: spaces.Space[Any], caption: str, success: bool = False
) -> Frame:
    """
    Put a rendered picture, the images of an observation and a caption side by side.

    :param picture: What ``render()`` gave, shape (height, width, 3)
    :param observation: What the agent sees; single-channel images in it become panels, near is bright
    :param space: Space of the observation; colours span its bounds
    :param caption: Text below the panels
    :param success: Whether to write the caption in the colour of success
    :return: The frame, shape (height, width, 3)
    """
    panels = [_resize(Image.fromarray(picture), Image.Resampling.LANCZOS)]
    panels += [
        _resize(_colour(image), Image.Resampling.NEAREST) for image in observed_images(observation, space)
    ]
    frame = Image.new("RGB", (PANEL_SIZE * len(panels), PANEL_SIZE + CAPTION_HEIGHT), BACKGROUND)
    for column, panel in enumerate(panels):
        frame.paste(panel, (column * PANEL_SIZE, 0))
    draw = ImageDraw.Draw(frame)
    colour = SUCCESS_COLOUR if success else FOREGROUND
    position = (10, PANEL_SIZE + CAPTION_HEIGHT // 2)
    draw.text(position, caption, fill=colour, font=ImageFont.load_default(FONT_SIZE), anchor="lm")
    return np.asarray(frame)


def observed_images(observation: Any, space: spaces.Space[Any]) -> list[npt.NDArray[np.float64]]:
    """
    Single-channel images in an observation.

    :param observation: An array, or a mapping of arrays
    :param space: Its space
    :return: The images, each of shape (height, width), scaled to [0, 1] over the bounds of their spaces
    """
    if isinstance(space, spaces.Dict):
        return [image for key, part in space.items() for image in observed_images(observation[key], part)]
    if not isinstance(space, spaces.Box) or len(space.shape) != 3 or space.shape[0] != 1:
        return []
    low, high = float(space.low.min()), float(space.high.max())
    return [(np.asarray(observation[0], np.float64) - low) / (high - low)]


def write_video(frames: Sequence[Frame], path: Path, frames_per_second: float) -> None:
    """
    Write a film, whole or not at all.

    :param frames: Frames of one shape
    :param path: The file; its suffix, ``.gif`` or ``.mp4``, is the format
    :param frames_per_second: Speed
    """
    with whole_file(path) as partial:
        if path.suffix == ".gif":
            duration = 1000 / frames_per_second  # ms
            iio.imwrite(partial, np.stack(frames), duration=duration, loop=0)
        else:
            iio.imwrite(partial, np.stack(frames), fps=frames_per_second)


def write_picture(frame: Frame, path: Path) -> None:
    """
    Write one frame as PNG, whole or not at all.

    :param frame: Shape (height, width, 3)
    :param path: The file
    """
    with whole_file(path) as partial:
        iio.imwrite(partial, frame)


def _resize(image: Image.Image, resampling: Image.Resampling) -> Image.Image:
    return image.convert("RGB").resize((PANEL_SIZE, PANEL_SIZE), resampling)


def _colour(image: npt.NDArray[np.float64]) -> Image.Image:
    return Image.fromarray((colormaps[COLOUR_MAP](image)[..., :3] * 255).astype(np.uint8))
