"""Interface of a surface, which tasks use without knowledge of its shape."""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import ClassVar, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from bulletarm_gym.geometry import FloatArray, Footprint, PlacementError, Pose, Vector
from bulletarm_gym.objects.containers import FLOOR_HEIGHT, RIM, tray_floor, tray_walls
from bulletarm_gym.simulation import Body, BodySpec, Box, Piece, World

Point: TypeAlias = tuple[float, float]

SITE: Point = (0.03, 0.03)
"""Default base (m) of the structure of a task: one of the paper's open-loop cubes."""
COVERED_SHARE = 0.5
"""Distance from an obstacle relative to the margin of an object to the border.

Tasks use a margin of 1.2 sides of a cube, whose half diagonal is 0.71 sides. On the floor of a tray half the
margin suffices, because corners may extend over the strip that rises to the walls.
"""
UP: Vector = (0.0, 0.0, 1.0)
"""Normal of level ground."""
ATTEMPTS = 200
"""Number of samples of a pose before there counts to be no space for it."""


class Surface(ABC):
    """Surface of a workspace.

    Its bodies are loaded once and posed at every reset. Sampled values are read back from their poses in the
    world, so that the state of the world includes the state of the surface.

    :param workspace: [[x low, x high], [y low, y high], [z low, z high]] (m)
    :param site: width and length (m) of the base of the task's structure
    """

    keeps_poses: ClassVar[bool] = True
    """Whether a body that is laid on the surface is at rest without simulation."""
    sloping: ClassVar[bool] = False
    """Whether objects may lie at an angle. Open-loop actions then tilt the gripper by default, and tasks that
    need level ground reject the surface."""
    words: ClassVar[str] = ""
    """Words for the surface in instructions, such as "in the tray"."""
    slide: ClassVar[float] = 0.005
    """Distance (m) that a body may move while it comes to rest; it is laid that far from the border."""

    def __init__(self, workspace: list[list[float]], site: Point = SITE) -> None:
        (x0, x1), (y0, y1), _ = self.workspace = workspace
        self.centre: Point = ((x0 + x1) / 2.0, (y0 + y1) / 2.0)
        """Centre (m) of the workspace."""
        self.site = site
        self.bodies: list[Body] = []
        """Bodies of the surface, parked ones included."""

    @abstractmethod
    def load(self, world: World) -> None:
        """Load the surface's bodies, once."""

    def arrange(self, rng: np.random.Generator) -> None:
        """Sample the surface of an episode, before the objects are arranged."""
        return

    @property
    def level(self) -> float:
        """Height (m) of the level ground for structures."""
        return 0.0

    @abstractmethod
    def heights(self, points: ArrayLike) -> FloatArray:
        """Return the height (m) of the surface, (n,), at points of the world, (n, 2)."""

    def height(self, xy: Point) -> float:
        """Return the height (m) of the surface at a point of the world."""
        return float(self.heights([xy])[0])

    @abstractmethod
    def normal(self, xy: Point) -> Vector:
        """Return the unit normal of the surface at a point of the world."""

    def pose(self, xy: Point, yaw: float) -> Pose:
        """Return a frame on the surface at a point, with its z axis along the normal, rotated by ``yaw``."""
        upright = Pose.planar(*xy, self.height(xy), yaw)
        x, y, z = self.normal(xy)
        if (x, y, z) == UP:
            return upright
        w = math.sqrt((1.0 + z) / 2.0)
        tilt = Pose((0.0, 0.0, 0.0), (-y / (2.0 * w), x / (2.0 * w), 0.0, w))
        return Pose(upright.position, tilt.compose(upright).orientation)

    def lay(self, body: BodySpec, xy: Point, yaw: float) -> Pose:
        """Return the pose of a body that lies on the surface at a point, rotated by ``yaw`` (rad)."""
        return self.pose(xy, yaw).compose(Pose((0.0, 0.0, -float(body.mesh.bounds[0, 2]))))

    def fits(self, footprint: Footprint, margin: float = 0.0) -> bool:
        """Return True if an object with this footprint can lie there, ``margin`` (m) from the border."""
        return footprint.is_inside(self.workspace, margin)

    def fits_site(self, footprint: Footprint) -> bool:
        """Return True if a footprint is inside the level ground for structures."""
        return self.fits(footprint)

    def goal_site(self, size: Point, rng: np.random.Generator, max_yaw: float = math.pi) -> Pose:
        """Sample a site for a structure on the level ground.

        :param size: width and length (m) of its base, along x and y of the returned frame
        :param max_yaw: largest absolute yaw (rad), if the surface permits several
        :return: level frame on the ground at the centre of the base
        :raises PlacementError: there is no such site
        """
        for pose in self._sites(size, rng, max_yaw):
            if self.fits_site(Footprint.rectangle(size, pose)):
                return pose
        raise PlacementError(f"workspace: no level ground of {size[0]:.3f} x {size[1]:.3f} m")

    def _sites(self, size: Point, rng: np.random.Generator, max_yaw: float) -> Iterator[Pose]:
        """Sample level frames, some of which may be sites."""
        for _ in range(ATTEMPTS):
            point = self.sample_position(rng, min(size) / 2.0)
            yield Pose.planar(*point, self.level, float(rng.uniform(-max_yaw, max_yaw)))

    def sample_position(self, rng: np.random.Generator, margin: float) -> Point:
        """Sample a point at least ``margin`` (m) from the workspace's border and clear of obstacles.

        :raises PlacementError: the workspace is too narrow, or the obstacles leave no such point
        """
        for _ in range(ATTEMPTS):
            point = self._uniform_position(rng, margin)
            if self._is_clear(point, COVERED_SHARE * margin):
                return point
        raise PlacementError(f"workspace: the surface leaves no room for a margin of {margin:.3f} m")

    def _is_clear(self, point: Point, distance: float) -> bool:
        return True

    def _uniform_position(self, rng: np.random.Generator, margin: float) -> Point:
        (x0, x1), (y0, y1) = self.workspace[:2]
        if x1 - x0 < 2.0 * margin:
            raise PlacementError(
                f"workspace: {self.workspace[:2]} has no point {margin:.3f} m from its border"
            )
        return float(rng.uniform(x0 + margin, x1 - margin)), float(rng.uniform(y0 + margin, y1 - margin))


FLOOR = BodySpec(
    "floor",
    (Piece(Box((3.0, 3.0, 0.01)), Pose((0.0, 0.0, -0.005))),),
    mass=0.0,
    colour=(0.79, 0.84, 0.89, 1.0),
)
"""Visible part of the ground plane z = 0."""


class FlatSurface(Surface):
    """The plane z = 0."""

    def load(self, world: World) -> None:
        self.bodies.append(world.add_plane(FLOOR))

    def heights(self, points: ArrayLike) -> FloatArray:
        return np.full(len(np.asarray(points)), self.level)

    def normal(self, xy: Point) -> Vector:
        return UP


class TraySurface(FlatSurface):
    """Floor of a tray at the centre of the workspace, whose height is returned for all points."""

    words = "in the tray"

    def __init__(self, workspace: list[list[float]], site: Point = SITE) -> None:
        super().__init__(workspace, site)
        self._size = 5.0 / 6.0 * (workspace[0][1] - workspace[0][0])  # 25 cm of the closed-loop 30 cm
        self._side = self._size - RIM

    def load(self, world: World) -> None:
        super().load(world)
        for spec in (tray_floor(self._size), tray_walls(self._size)):
            self.bodies.append(world.add(spec, Pose((*self.centre, 0.0))))

    @property
    def level(self) -> float:
        """Height (m) of the tray's floor."""
        return FLOOR_HEIGHT

    def fits(self, footprint: Footprint, margin: float = 0.0) -> bool:
        half = self._side / 2.0
        return footprint.is_inside([[middle - half, middle + half] for middle in self.centre], margin)

    def sample_position(self, rng: np.random.Generator, margin: float) -> Point:
        """Sample a point at which an object with this margin (m) to the workspace's border is on the floor.

        :raises PlacementError: the floor is too small for the object
        """
        reach = self._side / 2.0 - COVERED_SHARE * margin
        if reach < 0.0:
            raise PlacementError(
                f"workspace: its tray of {self._side:.3f} m has no room for a margin of {margin:.3f} m"
            )
        dx, dy = rng.uniform(-reach, reach, 2).tolist()
        return self.centre[0] + dx, self.centre[1] + dy
