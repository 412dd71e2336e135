"""Objects: bodies made of convex pieces, built-in kinds, and objects from users' files."""

from bulletarm_gym.objects.blocks import cube, flat_block, goal_area, triangle
from bulletarm_gym.objects.catalogue import create
from bulletarm_gym.objects.containers import bowl, corner, drawer
from bulletarm_gym.objects.files import load_object

__all__ = [
    "bowl",
    "corner",
    "create",
    "cube",
    "drawer",
    "flat_block",
    "goal_area",
    "load_object",
    "triangle",
]
