"""The only package that uses PyBullet: bodies, motion, state and cameras of a physics world."""

from bulletarm_gym.simulation.camera import Camera
from bulletarm_gym.simulation.client import Client, has_display
from bulletarm_gym.simulation.shapes import BodySpec, Box, Colour, Convex, Hinge, Piece, Slide
from bulletarm_gym.simulation.state import Body, Contact, Physics, Properties, WorldState
from bulletarm_gym.simulation.world import World

__all__ = [
    "Body",
    "BodySpec",
    "Box",
    "Camera",
    "Client",
    "Colour",
    "Contact",
    "Convex",
    "Hinge",
    "Physics",
    "Piece",
    "Properties",
    "Slide",
    "World",
    "WorldState",
    "has_display",
]
