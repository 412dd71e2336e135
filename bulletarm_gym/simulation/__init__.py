"""The only package that uses PyBullet: bodies, motion, state and cameras of a physics world."""

from bulletarm_gym.simulation.camera import Camera
from bulletarm_gym.simulation.client import has_display
from bulletarm_gym.simulation.shapes import BodySpec, Box, Convex, Hinge, Piece, Slide
from bulletarm_gym.simulation.state import Body, Contact, WorldState
from bulletarm_gym.simulation.world import World

__all__ = [
    "Body",
    "BodySpec",
    "Box",
    "Camera",
    "Contact",
    "Convex",
    "Hinge",
    "Piece",
    "Slide",
    "World",
    "WorldState",
    "has_display",
]
