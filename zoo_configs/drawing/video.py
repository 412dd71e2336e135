"""Frames and videos of episodes: the rendered scene, the observed images and a caption."""

import io
import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import imageio.v3 as iio
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from matplotlib import colormaps
from PIL import Image, ImageDraw, ImageFont

from zoo_configs.files import whole_file

Frame = npt.NDArray[np.uint8]
Brightness = npt.NDArray[np.floating]

FRAMES_PER_SECOND = 5.0
PANEL_SIZE = 320  # pixels a side
CAPTION_HEIGHT = 32  # pixels; with the panels a multiple of 16, which video codecs need
FONT_SIZE = 15
BACKGROUND = (24, 26, 30)
FOREGROUND = (235, 235, 235)
SUCCESS_COLOUR = (110, 200, 120)
HEIGHT_IMAGES = ("heightmap", "in_hand")
HIGHEST = 0.2  # m; the brightest colour of a heightmap
GIF_COLOURS = 160
MARK = (255, 90, 60)
RING = 7  # pixels
NEAREST = Image.Resampling.NEAREST


class ValueMap(NamedTuple):
    """
    Values that a policy computes for the pixels of a heightmap.

    :param values: Value of each pixel, shape (size, size)
    :param pixel: Row and column of the selected pixel
    :param yaw: Yaw (rad) of the gripper there; None for actions without a yaw
    """

    values: npt.NDArray[np.float32]
    pixel: tuple[int, int]
    yaw: float | None


def compose_frame(
    scene: Frame,
    images: Iterable[Brightness],
    caption: str,
    success: bool = False,
    value_map: ValueMap | None = None,
) -> Frame:
    """
    Compose a frame, shape (height, width, 3), of a rendered image, observed images and a caption.

    :param scene: Rendered image, shape (height, width, 3)
    :param images: Images with values in [0, 1], each of which becomes a panel
    :param success: Whether the caption has the colour of success
    :param value_map: Values to draw in another panel
    """
    panels = [_resize(Image.fromarray(scene), Image.Resampling.LANCZOS)]
    panels += [_resize(Image.fromarray(colour(image)), NEAREST) for image in images]
    if value_map is not None:
        panels.append(draw_value_map(value_map))
    frame = Image.new("RGB", (PANEL_SIZE * len(panels), PANEL_SIZE + CAPTION_HEIGHT), BACKGROUND)
    for column, panel in enumerate(panels):
        frame.paste(panel, (column * PANEL_SIZE, 0))
    draw = ImageDraw.Draw(frame)
    fill = SUCCESS_COLOUR if success else FOREGROUND
    position = (10, PANEL_SIZE + CAPTION_HEIGHT // 2)
    draw.text(position, caption, fill=fill, font=ImageFont.load_default(FONT_SIZE), anchor="lm")
    return np.asarray(frame)


def draw_value_map(value_map: ValueMap) -> Image.Image:
    """Draw the values of all pixels and mark the selected one, with a line along which the fingers close."""
    values, (row, column), yaw = value_map
    low, high = float(values.min()), float(values.max())
    panel = _resize(Image.fromarray(colour((values - low) / max(high - low, 1e-6))), NEAREST)
    draw = ImageDraw.Draw(panel)
    scale = PANEL_SIZE / len(values)
    x, y = (column + 0.5) * scale, (row + 0.5) * scale
    draw.ellipse((x - RING, y - RING, x + RING, y + RING), outline=MARK, width=2)
    if yaw is not None:
        down, right = 2 * RING * math.cos(yaw), 2 * RING * math.sin(yaw)
        draw.line((x - right, y - down, x + right, y + down), fill=MARK, width=2)
    return panel


def observed_images(observation: Any, env: gym.Env[Any, Any]) -> Iterator[Brightness]:
    """
    Yield the single-channel images of an observation, (height, width) each, with values in [0, 1].

    Heightmaps of this package become heights above the surface, from 0 to 0.2 m, whatever the control. Other
    images are scaled over the bounds of their spaces.
    """
    control = getattr(env.unwrapped, "control", None)
    plane = None if control is None else control.frame().plane
    space = env.observation_space
    for key, part in space.items() if isinstance(space, spaces.Dict) else [(None, space)]:
        if not isinstance(part, spaces.Box) or len(part.shape) != 3 or part.shape[0] != 1:
            continue
        image = np.asarray(observation if key is None else observation[key], np.float64)[0]
        if key in HEIGHT_IMAGES:
            yield np.clip((image if plane is None else plane - image) / HIGHEST, 0.0, 1.0)
        else:
            low, high = float(part.low.min()), float(part.high.max())
            yield (image - low) / (high - low)


def write_video(frames: Sequence[Frame], path: Path) -> None:
    """Write frames of one shape atomically as ``.gif`` or ``.mp4``."""
    if path.suffix == ".gif":
        content = _gif(frames)
    else:  # in memory, because imageio reports a full disk only when it is garbage-collected
        encoded = iio.imwrite("<bytes>", np.stack(frames), extension=path.suffix, fps=FRAMES_PER_SECOND)
        content = bytes(encoded)
    with whole_file(path) as partial:
        partial.write_bytes(content)


def _gif(frames: Sequence[Frame]) -> bytes:
    """Encode with one palette and no dithering, so that static pixels need no space."""
    duration = round(1000 / FRAMES_PER_SECOND)  # ms
    palette = Image.fromarray(np.concatenate([frames[0], frames[-1]])).quantize(GIF_COLOURS)
    images = [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    first, *others = images
    file = io.BytesIO()
    first.save(file, "GIF", save_all=True, append_images=others, duration=duration, loop=0, optimize=True)
    return file.getvalue()


def _resize(image: Image.Image, resampling: Image.Resampling) -> Image.Image:
    return image.convert("RGB").resize((PANEL_SIZE, PANEL_SIZE), resampling)


def colour(image: Brightness) -> Frame:
    """Return an image, shape (height, width, 3), of values in [0, 1], dark to bright."""
    return np.asarray(colormaps["viridis"](image)[..., :3] * 255, np.uint8)
