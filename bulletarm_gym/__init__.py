"""Manipulation tasks of the BulletArm paper as Gymnasium environments.

Importing the package registers their ids. It does not load the physics engine or a compiler.
"""

from bulletarm_gym.registry import (
    ENV_IDS,
    PAPER_IDS,
    register_all,
    register_control,
    register_object,
    register_robot,
    register_sensor,
    register_surface,
    register_task,
)

__version__ = "0.1.0"
__all__ = [
    "ENV_IDS",
    "PAPER_IDS",
    "__version__",
    "register_control",
    "register_object",
    "register_robot",
    "register_sensor",
    "register_surface",
    "register_task",
]

register_all()
