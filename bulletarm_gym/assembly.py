"""From what an environment is made with to its parts."""

from collections.abc import Mapping
from typing import Any

from bulletarm_gym.config import EnvConfig
from bulletarm_gym.control import find_control
from bulletarm_gym.extensions import OBJECTS, find_class
from bulletarm_gym.feasibility import checked_slots
from bulletarm_gym.robots import ROBOTS, RobotModel, find_robot
from bulletarm_gym.scene import Scene
from bulletarm_gym.surfaces import find_surface, make_surface
from bulletarm_gym.tasks import Task
from bulletarm_gym.values import check_argument, mapping, optional


def find_types(task: str, control: str) -> tuple[type[Task], type[Any]]:
    """Return the classes of a task and a control, as :func:`~bulletarm_gym.control.find_control` does.

    :param task: ``"module:Class"``
    :param control: its name or path
    :raises ValueError: there is no such control, or it does not fit the task
    """
    task_type: type[Task] = find_class("task", task, {}, {}, Task)
    control_type = find_control(control)
    if control_type.kind not in task_type.controls:
        raise ValueError(f"control: got {control!r}, {task_type.__name__} takes one of {task_type.controls}")
    return task_type, control_type


def take_objects(parameters: dict[str, Any]) -> tuple[dict[str, Any], dict[str, RobotModel]]:
    """Take the user's objects that have no import path from the parameters.

    :param parameters: by name; a model of an arm leaves its name there
    :return: these objects, by the name of the parameter, and the arms by name, the user's among them
    """
    objects = {name: parameters.pop(name) for name in OBJECTS if _is_object(parameters.get(name))}
    robots = dict(ROBOTS)
    if "robot" in objects:
        model = find_robot(objects["robot"])
        robots[model.name], parameters["robot"] = model, model.name
    return objects, robots


def make_config(
    task: type[Task],
    control: type[Any],
    robots: tuple[str, ...],
    surface: str,
    defaults: Mapping[str, Any] | None,
    given: Mapping[str, Any],
) -> EnvConfig:
    """Return the parameters of an environment.

    :param task: its defaults are taken where nothing is given
    :param control: how it is acted in
    :param robots: names of arms
    :param surface: the ground
    :param defaults: in place of the task's
    :param given: values by name
    :raises ValueError: a parameter has a value it cannot take, or is unknown (a ``TypeError``, too)
    """
    check_argument("defaults", defaults, optional(mapping))
    sloping = find_surface(surface).sloping
    kind, sequences = control.kind, control.sequences
    return EnvConfig.of(kind, task.defaults, robots, given, surface, sloping, sequences, defaults)


def make_scene(config: EnvConfig, robots: Mapping[str, RobotModel], surface: str, task: Task) -> Scene:
    """Load the workspace of a task.

    :param config: the environment's parameters
    :param robots: arms by name
    :param surface: the ground, but for a tray in close loop
    :param task: what there is besides
    """
    ground = make_surface("tray" if config.close_loop_tray else surface, config.workspace, task.site)
    robot = robots.get(config.robot) or find_robot(config.robot)
    return Scene(config, robot, ground, checked_slots(task.bodies(config), task))


def _is_object(value: Any) -> bool:
    return callable(value) or isinstance(value, RobotModel)
