"""Manipulation tasks of the BulletArm paper as Gymnasium environments.

Importing the package registers their ids. It does not load the physics engine or a compiler.
"""

from bulletarm_gym.registry import (
    ENV_IDS as ENV_IDS,
    PAPER_IDS as PAPER_IDS,
    register_all,
    register_control as register_control,
    register_object as register_object,
    register_robot as register_robot,
    register_sensor as register_sensor,
    register_surface as register_surface,
    register_task as register_task,
)

__version__ = "0.1.0"

register_all()
