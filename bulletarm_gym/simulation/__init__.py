"""The only package that uses PyBullet: bodies, motion, state and cameras of a physics world."""

from bulletarm_gym.simulation.camera import Camera as Camera
from bulletarm_gym.simulation.client import has_display as has_display
from bulletarm_gym.simulation.shapes import (
    BodySpec as BodySpec,
    Box as Box,
    Convex as Convex,
    Hinge as Hinge,
    Piece as Piece,
    Slide as Slide,
)
from bulletarm_gym.simulation.state import Body as Body, Contact as Contact, WorldState as WorldState
from bulletarm_gym.simulation.world import World as World
