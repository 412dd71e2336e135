"""Frames of ``render()``, by render mode."""

from typing import Any

import gymnasium

from bulletarm_gym.cameras import SceneCamera


def render_frame(camera: SceneCamera, mode: str | None, env_id: str) -> Any:
    """Return an image (height, width, 3) uint8, distances (height, width) float32 in metres, or None.

    Without a mode, a warning says so, as in Gymnasium's environments.
    """
    if mode == "rgb_array":
        return camera.color()
    if mode == "depth_array":
        return camera.depth()
    if mode is None:
        advice = f'Use gymnasium.make("{env_id}", render_mode="rgb_array").'
        gymnasium.logger.warn(f"render_mode must be set for render(), got None. {advice}")
    return None
