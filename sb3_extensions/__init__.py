"""Stable-Baselines3 extensions for learning robotic manipulation from images and demonstrations."""

from importlib.util import find_spec

if missing := [name for name in ("torch", "stable_baselines3", "sb3_contrib") if find_spec(name) is None]:
    raise ImportError(f"{', '.join(missing)} not installed: pip install 'bulletarm-gym[sb3]'")
