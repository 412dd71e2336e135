"""The table of environments: what each id is made of. Strings only, so that registering loads no engine."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium

from bulletarm_gym import time_limit
from bulletarm_gym.config import CLOSE_LOOP, LEVEL, OPEN_LOOP, SLOPING
from bulletarm_gym.extensions import CONTROL_PATHS, SURFACE_PATHS, by_path, import_path

NAMESPACE = "BulletArm"
ENTRY_POINT = "bulletarm_gym.env:ManipulationEnv"


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

    @property
    def kwargs(self) -> dict[str, str]:
        """What the environment is constructed with."""
        return {"task": self.task, "control": self.control, "surface": self.surface}


def _prefix(control: str, surface: str) -> str:
    """Return what an id begins with, such as ``"OpenLoopRamp"``; the flat floor is not named."""
    words = f"{control}_{'' if surface == 'flat' else surface}".split("_")
    return "".join(word[:1].upper() + word[1:] for word in words)


def _structures(surface: str) -> tuple[Entry, ...]:
    """Return the seven tasks that build a structure of blocks, on a surface."""
    classes = {
        "BlockStacking": "stacking:OpenLoopBlockStacking",
        **{f"HouseBuilding{number}": f"house:HouseBuilding{number}" for number in (1, 2, 3, 4)},
        **{f"ImproviseHouseBuilding{n}": f"improvise:ImproviseHouseBuilding{n}" for n in (2, 3)},
    }
    prefix = _prefix("open_loop", surface)
    return tuple(
        Entry(prefix + name, f"bulletarm_gym.tasks.{path}", "open_loop", surface)
        for name, path in classes.items()
    )


ENTRIES = (
    *_structures("flat"),
    Entry("OpenLoopBinPacking", "bulletarm_gym.tasks.packing:BinPacking", "open_loop"),
    Entry("OpenLoopBottleArrangement", "bulletarm_gym.tasks.arranging:BottleArrangement", "open_loop"),
    Entry("OpenLoopBoxPalletizing", "bulletarm_gym.tasks.palletizing:BoxPalletizing", "open_loop"),
    Entry("OpenLoopCovidTest", "bulletarm_gym.tasks.covid:CovidTest", "open_loop"),
    Entry("OpenLoopObjectGrasping", "bulletarm_gym.tasks.clutter:OpenLoopObjectGrasping", "open_loop"),
    *_structures("ramp"),
    Entry("OpenLoopBumpHouseBuilding4", "bulletarm_gym.tasks.house:HouseBuilding4", "open_loop", "bump"),
    Entry(
        "OpenLoopBumpBoxPalletizing", "bulletarm_gym.tasks.palletizing:BoxPalletizing", "open_loop", "bump"
    ),
    Entry("CloseLoopBlockReaching", "bulletarm_gym.tasks.reaching:BlockReaching", "close_loop"),
    Entry("CloseLoopBlockPicking", "bulletarm_gym.tasks.picking:BlockPicking", "close_loop"),
    Entry("CloseLoopBlockPushing", "bulletarm_gym.tasks.pushing:BlockPushing", "close_loop"),
    Entry("CloseLoopBlockPulling", "bulletarm_gym.tasks.pulling:BlockPulling", "close_loop"),
    Entry("CloseLoopBlockInBowl", "bulletarm_gym.tasks.bowl:BlockInBowl", "close_loop"),
    Entry("CloseLoopBlockStacking", "bulletarm_gym.tasks.stacking:BlockStacking", "close_loop"),
    Entry("CloseLoopHouseBuilding", "bulletarm_gym.tasks.house:HouseBuilding", "close_loop"),
    Entry("CloseLoopCornerPicking", "bulletarm_gym.tasks.corner:CornerPicking", "close_loop"),
    Entry("CloseLoopDrawerOpening", "bulletarm_gym.tasks.drawer:DrawerOpening", "close_loop"),
    Entry("CloseLoopObjectGrasping", "bulletarm_gym.tasks.clutter:ObjectGrasping", "close_loop"),
)

ENV_IDS: tuple[str, ...] = tuple(entry.env_id for entry in ENTRIES)


def register_all() -> None:
    """Register every entry with Gymnasium, once."""
    for entry in ENTRIES:
        if entry.env_id not in gymnasium.registry:
            _register(entry)


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
    if not name.isidentifier():
        raise ValueError(f"name: got {name!r}, takes an identifier such as 'BlockShaking'")
    _check_known("control", control, (CLOSE_LOOP, OPEN_LOOP, *CONTROL_PATHS))
    _check_known("surface", surface, (*LEVEL, *SLOPING, *SURFACE_PATHS))
    recipe = by_path({"control": control, "surface": surface})
    entry = Entry(_prefix(control, surface) + name, import_path(task, f"task {name!r}"), **recipe)
    known_spec = gymnasium.registry.get(entry.env_id)
    if known_spec is None:
        _register(entry)
    elif known_spec.kwargs != entry.kwargs:
        raise ValueError(f"name: {entry.env_id} is taken by {known_spec.kwargs.get('task')}")
    return entry.env_id


def _check_known(what: str, name: str, known: Sequence[str]) -> None:
    if name not in known:
        raise ValueError(f"{what}: got {name!r}, takes one of {', '.join(map(repr, known))}")


def _register(entry: Entry) -> None:
    gymnasium.register(
        entry.env_id,
        entry_point=ENTRY_POINT,
        kwargs=entry.kwargs,
        additional_wrappers=(time_limit.wrapper_spec(),),
    )
