"""The contract between a task and the house around it."""

import re
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

import numpy as np

from bulletarm_gym.config import OPEN_LOOP, EnvConfig, TaskDefaults
from bulletarm_gym.control import GraspParams
from bulletarm_gym.experts.waypoints import Waypoint
from bulletarm_gym.geometry import Vector
from bulletarm_gym.objects.blocks import CUBE_SIZE
from bulletarm_gym.rendering.overlays import Overlay
from bulletarm_gym.scene import ObjectSlot, Scene, SceneObject
from bulletarm_gym.scene.state import declare_state_types
from bulletarm_gym.surfaces.surface import SITE, Point


class Task(ABC):
    """A task: its bodies, how they are arranged, when it is solved, and how an expert solves it.

    A task keeps nothing between calls but :attr:`memory`; what it does follows from the scene, so that states
    can be saved, restored and planned from.

    :param config: the environment's parameters
    """

    defaults: ClassVar[TaskDefaults]
    controls: ClassVar[tuple[str, ...]]
    """Names of the controls the task can be solved with."""
    one_decision: ClassVar[bool] = False
    """Whether every action ends the episode."""
    memory_types: ClassVar[tuple[type, ...]] = ()
    """Dataclasses and named tuples in :attr:`memory`, for files of states; plain values need none."""
    site: Point = SITE
    """Width and length (m) of the base of what is built: ramps and bumps leave level ground for it."""

    def __init__(self, config: EnvConfig) -> None:
        self.config = config
        self.memory: Any = None
        """What the task must remember within an episode: plain values and :attr:`memory_types`."""

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
        """Grasp parameters; by default, the fingertips close half a largest cube deep."""
        return GraspParams(pick_offset=CUBE_SIZE * max(self.config.scales) / 2.0)

    @property
    def height(self) -> float:
        """Height (m) above which the workspace must reach for the task to be solved: of a largest cube."""
        return CUBE_SIZE * max(self.config.scales)

    @property
    def plans_moves(self) -> bool:
        """Whether its plan says only where to pick and to place, and close loop has to find the way."""
        return OPEN_LOOP in self.controls

    @abstractmethod
    def bodies(self, config: EnvConfig) -> list[ObjectSlot]:
        """Return everything the task will ever need."""

    def grasped(self, scene: Scene) -> list[SceneObject]:
        """Return the items that the gripper must be able to span: by default all that are loose."""
        return [item for item in scene.objects if item.spec.mass > 0.0]

    @abstractmethod
    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        """Lay out the start of an episode in an empty scene.

        :raises PlacementError: there is no room; it is then asked again, some times, on other ground
        """

    def arrange_goal(self, scene: Scene, rng: np.random.Generator) -> None:
        """Lay out the finished structure at the surface's goal site in an empty scene.

        Deconstruction begins with it (paper, Expert Demonstrations). All that can move belongs to it.

        :raises ValueError: the task has no such structure, as most
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
        """Yield the waypoints that remain from the present scene on, first the next.

        It must give one in every state, also after a failure; for open-loop control one with a ``finish``.
        """

    def continue_scene(self, scene: Scene, rng: np.random.Generator) -> bool:
        """Begin an episode with what the last one left; False, for most, asks for a new arrangement."""
        return False

    def overlays(self, scene: Scene) -> tuple[Overlay, ...]:
        """Return what the heightmap shows besides the bodies: goals that no body stands for."""
        return ()

    def after_action(self, scene: Scene, rng: np.random.Generator) -> None:  # noqa: B027 (most have none)
        """Change the scene after an action, where the task has a life of its own."""

    def is_valid(self, scene: Scene) -> bool:
        """Whether every loose item is inside the workspace, not above its top nor below the floor."""
        held = scene.robot.held
        return all(self._is_inside(item) for item in scene if item.spec.mass > 0.0 and item.body is not held)

    def reward(self, scene: Scene, outcome: Mapping[str, bool]) -> float:
        """Return 1 on success, else 0 (paper, Environment).

        :param outcome: the step's ``info``
        """
        return float(outcome["is_success"])

    def _is_inside(self, item: SceneObject) -> bool:
        (x0, x1), (y0, y1), (_, top) = self.config.workspace
        low, high = self._extent(item)
        inside = x0 <= low[0] and high[0] <= x1 and y0 <= low[1] and high[1] <= y1
        return inside and low[2] >= FALLEN and high[2] <= top

    def _extent(self, item: SceneObject) -> tuple[Vector, Vector]:
        """Return the corners (m) that must be inside: of the bounding box, or twice the centre."""
        if self.config.workspace_check == "bounding_box":
            (left, near, _), (right, far, top) = item.bounds.tolist()
            return (left, near, item.pose.z), (right, far, top)
        return item.pose.position, item.pose.position


FALLEN = 0.0
"""An item whose centre is below this height (m) has fallen through the ground."""
