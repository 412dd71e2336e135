"""What parameters ask for together, and cannot have: looked at when an environment is made."""

from bulletarm_gym.config import CLOSE_LOOP, EnvConfig, ParameterError
from bulletarm_gym.objects.blocks import CUBE_SIZE
from bulletarm_gym.tasks import Task


def check_heights(config: EnvConfig, task: Task) -> None:
    """Check that the workspace lets the gripper come down to things, and up with them.

    :raises ParameterError: it does not
    """
    low, high = config.workspace[2]
    if high <= task.height:
        takes = f"one with z high above {task.height:.4g} with this task: up to there things must be lifted"
        raise ParameterError.of("workspace", config.workspace, takes)
    smallest = CUBE_SIZE * min(config.scales)
    if config.control == CLOSE_LOOP and low >= smallest:
        takes = f"one with z low below {smallest:.4g}: the gripper must come down to what lies on the ground"
        raise ParameterError.of("workspace", config.workspace, takes)
