"""The table of environments: what each id is made of. Strings only, so that registering loads no engine."""

from dataclasses import dataclass

import gymnasium

NAMESPACE = "BulletArm"
ENTRY_POINT = "bulletarm_gym.env:ManipulationEnv"
VECTOR_ENTRY_POINT = "bulletarm_gym.vector:ParallelEnv"


@dataclass(frozen=True)
class Entry:
    """What an environment is made of.

    :param name: in the id
    :param task: ``"module:Class"``
    """

    name: str
    task: str
    control: str
    surface: str = "flat"

    @property
    def env_id(self) -> str:
        """The id to make the environment by."""
        return f"{NAMESPACE}/{self.name}-v0"


ENTRIES = (
    Entry("CloseLoopBlockReaching", "bulletarm_gym.tasks.reaching:BlockReaching", "close_loop"),
    Entry("CloseLoopBlockPicking", "bulletarm_gym.tasks.picking:BlockPicking", "close_loop"),
    Entry("CloseLoopBlockPushing", "bulletarm_gym.tasks.pushing:BlockPushing", "close_loop"),
    Entry("CloseLoopBlockPulling", "bulletarm_gym.tasks.pulling:BlockPulling", "close_loop"),
)

ENV_IDS: tuple[str, ...] = tuple(entry.env_id for entry in ENTRIES)


def register_all() -> None:
    """Register every entry with Gymnasium, once."""
    for entry in ENTRIES:
        if entry.env_id not in gymnasium.registry:
            gymnasium.register(
                entry.env_id,
                entry_point=ENTRY_POINT,
                vector_entry_point=VECTOR_ENTRY_POINT,
                kwargs={"task": entry.task, "control": entry.control, "surface": entry.surface},
            )
