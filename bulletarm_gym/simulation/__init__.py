"""The only room that talks to PyBullet: connection, bodies, motion, snapshot, camera."""

from bulletarm_gym.simulation.camera import Camera
from bulletarm_gym.simulation.client import Client, has_display
from bulletarm_gym.simulation.physics import Physics
from bulletarm_gym.simulation.properties import Properties
from bulletarm_gym.simulation.shapes import BodySpec, Box, Colour, Convex, Hinge, Piece, Slide
from bulletarm_gym.simulation.state import Body, WorldState
from bulletarm_gym.simulation.world import World

__all__ = [
    "Body",
    "BodySpec",
    "Box",
    "Camera",
    "Client",
    "Colour",
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
