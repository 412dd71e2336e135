"""What tasks may ask of the ground without knowing its shape."""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import ClassVar, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from bulletarm_gym.geometry import FloatArray, Footprint, PlacementError, Pose, Vector
from bulletarm_gym.simulation import Body, BodySpec, World

Point: TypeAlias = tuple[float, float]

SITE: Point = (0.03, 0.03)
"""Footprint (m) of what is built where a task says nothing: one of the paper's open-loop cubes."""
COVERED_SHARE = 0.5
"""Share of the margin to the workspace's border that an item itself covers: tasks keep 1.2 sides of a cube,
whose half diagonal is 0.71 sides. On a tray's floor it needs little more than half of that: corners may reach
over the strip that rises to the walls."""
UP: Vector = (0.0, 0.0, 1.0)
"""Normal of level ground."""
ATTEMPTS = 200
"""Places tried before the ground counts as too small."""


class Surface(ABC):
    """The ground of a workspace.

    Its bodies are loaded once and posed anew each episode; whatever was drawn is read back from their poses
    in the world, so that the world's state is the surface's too.

    :param workspace: [[x low, x high], [y low, y high], [z low, z high]] (m)
    :param site: width and length (m) of the base of what the task builds
    """

    keeps_poses: ClassVar[bool] = True
    """Whether what is laid somewhere stays as it is laid, and need not come to rest first."""
    sloping: ClassVar[bool] = False
    """Whether things may lie on it at an angle: then open-loop actions turn the gripper about all axes by
    default, and tasks that need level ground refuse it."""
    slide: ClassVar[float] = 0.005
    """How far (m) what is laid may move while it comes to rest: so far it keeps away from the border."""

    def __init__(self, workspace: list[list[float]], site: Point = SITE) -> None:
        self.workspace = workspace
        self.site = site
        self.bodies: list[Body] = []
        """What the ground is made of, that of other episodes too."""

    @abstractmethod
    def load(self, world: World) -> None:
        """Load the surface's bodies, once."""

    def arrange(self, rng: np.random.Generator) -> None:
        """Draw the ground of an episode, where it is not always the same; tasks are arranged after it."""
        return

    @property
    def level(self) -> float:
        """Height (m) of the level ground that structures stand on."""
        return 0.0

    @property
    def centre(self) -> Point:
        """Middle (m) of the workspace."""
        (x0, x1), (y0, y1), _ = self.workspace
        return ((x0 + x1) / 2.0, (y0 + y1) / 2.0)

    @abstractmethod
    def heights(self, points: ArrayLike) -> FloatArray:
        """Return the height (m) of the ground, (n,), at points of the world, (n, 2)."""

    def height(self, xy: Point) -> float:
        """Return the height (m) of the ground at a point of the world."""
        return float(self.heights([xy])[0])

    @abstractmethod
    def normal(self, xy: Point) -> Vector:
        """Return the unit normal of the ground at a point of the world."""

    def pose(self, xy: Point, yaw: float) -> Pose:
        """Return the frame of something that lies on the ground at a point, turned by ``yaw`` (rad)."""
        upright = Pose.planar(*xy, self.height(xy), yaw)
        normal = self.normal(xy)
        return (
            upright if tuple(normal) == UP else Pose(upright.position, _tilted(normal, upright).orientation)
        )

    def lay(self, body: BodySpec, xy: Point, yaw: float) -> Pose:
        """Return the pose of a body that is put on the ground at a point, turned by ``yaw`` (rad)."""
        return self.pose(xy, yaw).compose(Pose((0.0, 0.0, -float(body.mesh.bounds[0, 2]))))

    def fits(self, footprint: Footprint, margin: float = 0.0) -> bool:
        """Whether something with this footprint can lie there, a margin (m) away from the border."""
        return footprint.is_inside(self.workspace, margin)

    def fits_site(self, footprint: Footprint) -> bool:
        """Whether a footprint is on the level ground that structures stand on, all of it."""
        return self.fits(footprint)

    def goal_site(self, size: Point, rng: np.random.Generator, spread: float = math.pi) -> Pose:
        """Draw a place on the level ground for something to be built.

        :param size: width and length (m) of its base, along x and y of the frame returned
        :param spread: greatest yaw (rad) either way, where the ground leaves a choice
        :return: frame of the site, level, its origin on the ground in the middle of the base
        :raises PlacementError: there is no such place
        """
        for pose in self._sites(size, rng, spread):
            if self.fits_site(Footprint.rectangle(size, pose)):
                return pose
        raise PlacementError(f"workspace: no level ground of {size[0]:.3f} x {size[1]:.3f} m")

    def _sites(self, size: Point, rng: np.random.Generator, spread: float) -> Iterator[Pose]:
        """Draw level frames of which some may be sites."""
        for _ in range(ATTEMPTS):
            point = self.sample_position(rng, min(size) / 2.0)
            yield Pose.planar(*point, self.level, float(rng.uniform(-spread, spread)))

    def sample_position(self, rng: np.random.Generator, margin: float) -> Point:
        """Draw a point of the workspace at least ``margin`` (m) from its border.

        :raises PlacementError: the workspace is narrower than twice the margin
        """
        (x0, x1), (y0, y1) = self.workspace[:2]
        if x1 - x0 < 2.0 * margin:
            raise PlacementError(
                f"workspace: {self.workspace[:2]} has no point {margin:.3f} m from its border"
            )
        return float(rng.uniform(x0 + margin, x1 - margin)), float(rng.uniform(y0 + margin, y1 - margin))


def _tilted(normal: Vector, upright: Pose) -> Pose:
    """Return a frame turned about a horizontal axis until its z axis is along a normal."""
    x, y, z = normal
    w = math.sqrt((1.0 + z) / 2.0)
    return Pose((0.0, 0.0, 0.0), (-y / (2.0 * w), x / (2.0 * w), 0.0, w)).compose(upright)
