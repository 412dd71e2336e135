"""Tutorial 5: an object of your own, in a module that processes can import."""

import bulletarm_gym
from bulletarm_gym.geometry import Pose
from bulletarm_gym.objects import BodySpec, Box, Piece


def hammer(name: str, scale: float) -> BodySpec:
    """Return a hammer with a handle of 12 cm."""
    handle = Piece(Box((0.02 * scale, 0.12 * scale, 0.02 * scale)))
    head = Piece(Box((0.06 * scale, 0.025 * scale, 0.025 * scale)), Pose((0.0, 0.07 * scale, 0.0)))
    return BodySpec(name, (handle, head), mass=0.2, friction=0.8, colour=(0.5, 0.4, 0.3, 1.0))


bulletarm_gym.register_object("hammer", hammer)
