"""What is acted on: shapes and object sets made by code."""

from bulletarm_gym.objects.blocks import cube, flat_block, goal_area, triangle
from bulletarm_gym.objects.bowl import bowl
from bulletarm_gym.objects.catalogue import create
from bulletarm_gym.objects.corner import corner
from bulletarm_gym.objects.drawer import drawer
from bulletarm_gym.simulation.shapes import BodySpec, Box, Colour, Convex, Hinge, Piece, Slide

__all__ = [
    "BodySpec",
    "Box",
    "Colour",
    "Convex",
    "Hinge",
    "Piece",
    "Slide",
    "bowl",
    "corner",
    "create",
    "cube",
    "drawer",
    "flat_block",
    "goal_area",
    "triangle",
]
