"""Base class of tasks, and the arrangement of a scene at the start of an episode."""

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from bulletarm_gym.config import OPEN_LOOP, EnvConfig, TaskDefaults
from bulletarm_gym.control import Control, GraspParams
from bulletarm_gym.experts import Waypoint
from bulletarm_gym.geometry import PlacementError
from bulletarm_gym.objects.blocks import CUBE_SIZE
from bulletarm_gym.observations import Overlay
from bulletarm_gym.scene import ObjectSlot, Scene, SceneObject
from bulletarm_gym.scene.predicates import loose_objects
from bulletarm_gym.scene.state import declare_state_types
from bulletarm_gym.surfaces.surface import SITE, Point

ARRANGEMENTS = 30
"""Maximum number of arrangements that a reset tries."""


class Task(ABC):
    """A task: its bodies, their arrangement, its success, and the plan of an expert.

    A task keeps only :attr:`memory` between calls. Everything else depends on the scene, so that states can
    be saved and restored.

    :param config: the environment's parameters
    """

    defaults: ClassVar[TaskDefaults]
    controls: ClassVar[tuple[str, ...]]
    """Kinds of controls that can solve the task."""
    single_step: ClassVar[bool] = False
    """Whether every action ends the episode."""
    memory_types: ClassVar[tuple[type, ...]] = ()
    """Dataclasses and named tuples in :attr:`memory`, for files of states; plain values need none."""
    grasps: ClassVar[bool] = True
    """Whether the loose objects must fit between the open fingers."""
    site: Point = SITE
    """Width and length (m) of the base of a structure, for which ramps and bumps have level ground."""

    def __init__(self, config: EnvConfig) -> None:
        self.config = config
        self.memory: Any = None
        """Memory of the task within an episode: plain values and :attr:`memory_types`."""

    def __init_subclass__(cls, **options: Any) -> None:
        """Declare the types of the memory.

        :raises ValueError: ``memory_types`` has a type that cannot be stored, or whose name is in use
        """
        super().__init_subclass__(**options)
        declare_state_types(cls.memory_types)

    @property
    def description(self) -> str:
        """One sentence that describes the task: the first of the docstring, or the class name in words."""
        paragraph = (type(self).__doc__ or "").strip().split("\n\n")[0]
        words = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", " ", type(self).__name__).capitalize()
        return " ".join(paragraph.split()) or f"{words}."

    @property
    def grasp_params(self) -> GraspParams:
        """Grasp parameters; by default the fingertips close at half the height of a largest cube."""
        return GraspParams(pick_offset=CUBE_SIZE * max(self.config.scales) / 2.0)

    @property
    def height(self) -> float:
        """Height (m) to which objects must be lifted; by default that of a largest cube."""
        return CUBE_SIZE * max(self.config.scales)

    @property
    def plans_moves(self) -> bool:
        """Whether the plan has only picks and places, to which closed-loop control adds the path."""
        return OPEN_LOOP in self.controls

    @abstractmethod
    def bodies(self, config: EnvConfig) -> list[ObjectSlot]:
        """Return the slots of all objects of the task."""

    @abstractmethod
    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        """Place the objects of a new episode in an empty scene.

        :raises PlacementError: the objects do not fit; the environment tries again with other ground
        """

    def arrange_goal(self, scene: Scene, rng: np.random.Generator) -> None:
        """Place all loose objects as the finished structure at the surface's goal site in an empty scene.

        Deconstruction starts from it (paper, Expert Demonstrations).

        :raises ValueError: the task builds no structure
        """
        raise ValueError(f"{type(self).__name__} builds no structure: it has no arrange_goal()")

    @property
    def has_goal_structure(self) -> bool:
        """Whether the task defines :meth:`arrange_goal`."""
        return type(self).arrange_goal is not Task.arrange_goal

    @property
    def keeps_scene(self) -> bool:
        """Whether the task defines :meth:`continue_scene`."""
        return type(self).continue_scene is not Task.continue_scene

    @abstractmethod
    def evaluate(self, scene: Scene) -> dict[str, bool]:
        """Return named facts about the scene; ``"success"`` is the goal.

        ``info`` has the other facts, and ``is_success``: the goal is reached in a valid scene.
        """

    @abstractmethod
    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        """Yield the remaining waypoints, the next one first.

        Every state has a next waypoint, also after a failure; for open-loop control one with a ``finish``.
        """

    def continue_scene(self, scene: Scene, rng: np.random.Generator) -> bool:
        """Start an episode with the objects that the last one left; return False for a new arrangement."""
        return False

    def overlays(self, scene: Scene) -> tuple[Overlay, ...]:
        """Return marks without a body that the heightmap shows, such as goals."""
        return ()

    def after_action(self, scene: Scene, rng: np.random.Generator) -> None:  # noqa: B027 (most have none)
        """Change the scene after an action."""

    def is_valid(self, scene: Scene) -> bool:
        """Return True if every loose object that is not grasped is inside the workspace."""
        held = scene.robot.held
        return all(self._is_inside(obj) for obj in loose_objects(scene) if obj.body is not held)

    def reward(self, scene: Scene, outcome: Mapping[str, bool]) -> float:
        """Return 1 on success, else 0 (paper, Environment).

        :param outcome: the step's ``info``
        """
        return float(outcome["is_success"])

    def _is_inside(self, obj: SceneObject) -> bool:
        """Return True if an object's centre or bounding box is in the workspace, not below the floor."""
        (x0, x1), (y0, y1), (_, top) = self.config.workspace
        if self.config.workspace_check == "bounding_box":
            low, high = obj.bounds.tolist()
        else:
            low = high = obj.pose.position
        inside = x0 <= low[0] and high[0] <= x1 and y0 <= low[1] and high[1] <= y1
        return inside and obj.pose.z >= 0.0 and high[2] <= top


def arrange_scene(
    scene: Scene,
    control: Control[Any],
    arrange: Callable[[Scene, np.random.Generator], None],
    rng: np.random.Generator,
    changed: Sequence[str],
) -> None:
    """Sample surfaces and arrangements until the objects fit.

    :param arrange: arrangement of the task in an empty scene
    :param changed: names of the parameters of the scene that differ from their defaults
    :raises PlacementError: the objects do not fit; the text names these parameters
    """
    for attempt in range(1, ARRANGEMENTS + 1):
        scene.clear(rng)
        control.start()
        try:
            return arrange(scene, rng)
        except PlacementError as error:
            if attempt == ARRANGEMENTS:
                values = ", ".join(repr(getattr(scene.config, name)) for name in changed)
                must = f"{', '.join(changed)} must leave room for all objects, got {values}: "
                raise PlacementError(f"{must if changed else ''}{error}") from error
