"""The table of environments: what each id is made of. Strings only, so that registering loads no engine."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import gymnasium

from bulletarm_gym import time_limit
from bulletarm_gym.config import CLOSE_LOOP, LEVEL, OPEN_LOOP, SLOPING
from bulletarm_gym.extensions import CONTROL_PATHS, SURFACE_PATHS, by_path, import_path
from bulletarm_gym.inheritance import announce, announced

NAMESPACE = "BulletArm"
ENTRY_POINT = "bulletarm_gym.env:ManipulationEnv"
TASK = "task"
"""What users' tasks are announced as to other processes."""

PAIR = {"num_objects": 2, "object_scale_range": 1.0, "max_steps": 50}
"""The paper's close-loop Block Stacking and House Building: two blocks of 5 cm instead of four of 3 cm."""


@dataclass(frozen=True)
class Entry:
    """What an environment is made of.

    :param name: in the id
    :param task: ``"module:Class"``
    :param defaults: of parameters, in place of the task's: JSON values
    """

    name: str
    task: str
    control: str
    surface: str = "flat"
    defaults: Mapping[str, Any] = field(default_factory=dict)

    @property
    def env_id(self) -> str:
        """The id to make the environment by."""
        return f"{NAMESPACE}/{self.name}-v0"

    @property
    def kwargs(self) -> dict[str, Any]:
        """What the environment is constructed with."""
        defaults = {"defaults": dict(self.defaults)} if self.defaults else {}
        return {"task": self.task, "control": self.control, "surface": self.surface, **defaults}


def _prefix(control: str, surface: str) -> str:
    """Return what an id begins with, such as ``"OpenLoopRamp"``; the flat floor is not named."""
    words = f"{control}_{'' if surface == 'flat' else surface}".split("_")
    return "".join(word[:1].upper() + word[1:] for word in words)


STRUCTURES = {
    "BlockStacking": "stacking:BlockStacking",
    **{f"HouseBuilding{number}": f"house:HouseBuilding{number}" for number in (1, 2, 3, 4)},
    **{f"ImproviseHouseBuilding{n}": f"house:ImproviseHouseBuilding{n}" for n in (2, 3)},
}
"""The seven tasks that build a structure of blocks."""
PACKAGING = {
    "BinPacking": "packing:BinPacking",
    "BottleArrangement": "packing:BottleArrangement",
    "BoxPalletizing": "palletizing:BoxPalletizing",
    "CovidTest": "covid:CovidTest",
}


def _entries(tasks: Mapping[str, str], control: str, surface: str = "flat") -> tuple[Entry, ...]:
    """Return the entries of tasks, by name the module and class, under a control on a surface."""
    prefix = _prefix(control, surface)
    return tuple(
        Entry(prefix + name, f"bulletarm_gym.tasks.{path}", control, surface) for name, path in tasks.items()
    )


PAPER = (
    *_entries({**STRUCTURES, **PACKAGING, "ObjectGrasping": "clutter:OpenLoopObjectGrasping"}, "open_loop"),
    *_entries(STRUCTURES, "open_loop", "ramp"),
    *_entries(
        {"HouseBuilding4": "house:HouseBuilding4", "BoxPalletizing": "palletizing:BoxPalletizing"},
        "open_loop",
        "bump",
    ),
    *_entries(
        {
            "BlockReaching": "picking:BlockReaching",
            "BlockPicking": "picking:BlockPicking",
            "BlockPushing": "pushing:BlockPushing",
            "BlockPulling": "pushing:BlockPulling",
        },
        "close_loop",
    ),
    *_entries({"BlockInBowl": "picking:BlockInBowl"}, "close_loop"),
    Entry(
        "CloseLoopBlockStacking", "bulletarm_gym.tasks.stacking:BlockStacking", "close_loop", defaults=PAIR
    ),
    Entry("CloseLoopHouseBuilding", "bulletarm_gym.tasks.house:HouseBuilding1", "close_loop", defaults=PAIR),
    *_entries(
        {
            "CornerPicking": "picking:CornerPicking",
            "DrawerOpening": "drawer:DrawerOpening",
            "ObjectGrasping": "clutter:ObjectGrasping",
        },
        "close_loop",
    ),
)
"""The environments of the paper."""
COMPOSED = (
    *_entries({name: path for name, path in STRUCTURES.items() if name != "BlockStacking"}, "close_loop"),
    *_entries(PACKAGING, "close_loop"),
    *_entries({"BlockPicking": "picking:BlockPicking"}, "close_loop", "ramp"),
    *_entries(
        {"BlockPicking": "picking:BlockPicking", "BlockInBowl": "picking:BlockInBowl"}, "close_loop", "bump"
    ),
)
"""More of their tasks under close-loop control: those whose expert succeeds in 95 % of episodes or more."""
OWN = (
    Entry("OpenLoopBlockSorting", "bulletarm_gym.tasks.sorting:BlockSorting", "open_loop"),
    Entry("CloseLoopBlockSorting", "bulletarm_gym.tasks.sorting:BlockSorting", "close_loop"),
)
"""Tasks of our own."""
ENTRIES = (*PAPER, *COMPOSED, *OWN)

PAPER_IDS: tuple[str, ...] = tuple(entry.env_id for entry in PAPER)
ENV_IDS: tuple[str, ...] = tuple(entry.env_id for entry in ENTRIES)


def register_all() -> None:
    """Register every entry with Gymnasium, once, and those of the process that started this one."""
    for entry in (*ENTRIES, *(Entry(**recipe) for recipe in announced(TASK).values())):
        if entry.env_id not in gymnasium.registry:
            register(entry.env_id, entry.kwargs)


def register_task(name: str, task: Any, control: str = "close_loop", surface: str = "flat") -> str:
    """Make a task of yours available by an id of its own.

    :param name: in the id, like ``"BlockShaking"``
    :param task: a subclass of :class:`~bulletarm_gym.tasks.Task` that can be imported from a module, or its
        path ``"module:Class"``
    :param control: how it is acted in: ``"close_loop"``, ``"open_loop"``, or one that was registered
    :param surface: where: ``"flat"``, ``"tray"``, ``"ramp"``, ``"bump"``, or one that was registered
    :return: the id, like ``"BulletArm/CloseLoopBlockShaking-v0"``
    :raises ValueError: the name is no identifier or taken, control or surface is unknown, or the class has no
        import path
    """
    if not (isinstance(name, str) and name.isidentifier()):
        raise ValueError(f"name: got {name!r}, takes an identifier such as 'BlockShaking'")
    _check_known("control", control, (CLOSE_LOOP, OPEN_LOOP, *CONTROL_PATHS))
    _check_known("surface", surface, (*LEVEL, *SLOPING, *SURFACE_PATHS))
    recipe = by_path({"control": control, "surface": surface})
    entry = Entry(_prefix(control, surface) + name, import_path(task, f"task {name!r}"), **recipe)
    known_spec = gymnasium.registry.get(entry.env_id)
    if known_spec is None:
        register(entry.env_id, entry.kwargs)
    elif known_spec.kwargs != entry.kwargs:
        raise ValueError(f"name: {entry.env_id} is taken by {known_spec.kwargs.get('task')}")
    announce(TASK, entry.env_id, {"name": entry.name, "task": entry.task, **recipe})
    return entry.env_id


def _check_known(what: str, name: str, known: Sequence[str]) -> None:
    if name not in known:
        raise ValueError(f"{what}: got {name!r}, takes one of {', '.join(map(repr, known))}")


def register(env_id: str, recipe: Mapping[str, Any]) -> None:
    """Register an id with Gymnasium.

    :param recipe: task, control, surface and defaults, as the constructor has them
    """
    gymnasium.register(
        env_id,
        entry_point=ENTRY_POINT,
        kwargs=dict(recipe),
        additional_wrappers=(time_limit.wrapper_spec(),),
    )
