"""A moment of an environment."""

from dataclasses import dataclass
from typing import Any

from bulletarm_gym.robots import RobotState
from bulletarm_gym.simulation import WorldState


@dataclass(frozen=True)
class EnvState:
    """Everything an environment needs to go on from a moment; picklable.

    :param sensors: memory of the sensors, by name
    :param memory: memory of the task
    :param control: memory of the control
    :param generator: state of the generator that later episodes are seeded from
    :param made_of: what decides whether an environment can take it: task, arm, sizes; None in old files
    """

    world: WorldState
    robot: RobotState
    cast: tuple[int, ...]
    sensors: Any
    memory: Any
    control: Any
    steps: int
    episode_seed: int
    generator: dict[str, Any]
    made_of: dict[str, Any] | None = None
