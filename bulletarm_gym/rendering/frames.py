"""Frames of ``render()``, by render mode."""

from typing import Any

import gymnasium

from bulletarm_gym.simulation import Camera, World


def render_frame(world: World, mode: str | None, env_id: str) -> Any:
    """Return an image (480, 480, 3) uint8, distances (480, 480) float32 in metres, or None.

    Without a mode, a warning says so, as in Gymnasium's environments.
    """
    if mode == "rgb_array":
        return Camera().color(world)
    if mode == "depth_array":
        return Camera().depth(world)
    if mode is None:
        advice = f'Use gymnasium.make("{env_id}", render_mode="rgb_array").'
        gymnasium.logger.warn(f"render_mode must be set for render(), got None. {advice}")
    return None
