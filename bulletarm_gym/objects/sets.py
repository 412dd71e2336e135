"""Which objects a task draws from: the 86 made by code, or a user's files."""

from bulletarm_gym.objects.files import load_folder
from bulletarm_gym.objects.graspables import graspables
from bulletarm_gym.simulation.shapes import BodySpec


def object_set(folder: str | None) -> tuple[BodySpec, ...]:
    """Return the objects of a set, always in the same order.

    :param folder: None for the 86, or where OBJ or URDF files are
    :raises ValueError: the folder has no such file that can be loaded
    """
    return graspables() if folder is None else load_folder(folder)
