"""Packing blocks into a bin, and bottles into a tray."""

import itertools
import math
from collections.abc import Iterator

import numpy as np
from scipy.ndimage import maximum_filter

from bulletarm_gym.config import CLOSE_LOOP, OPEN_LOOP, WIDE, EnvConfig, TaskDefaults
from bulletarm_gym.control import GraspParams
from bulletarm_gym.experts import CLOSED, OPEN, Waypoint
from bulletarm_gym.experts.approach import RELEASE, place_pose, rotates
from bulletarm_gym.experts.pick_place import pick, resting_frame
from bulletarm_gym.geometry import FloatArray, Footprint, Pose, matrix, wrap_angle
from bulletarm_gym.objects import containers
from bulletarm_gym.objects.blocks import SHAPES, packing_block
from bulletarm_gym.objects.containers import BIN, BOTTLES, TRAY
from bulletarm_gym.observations import HeightRenderer, Window
from bulletarm_gym.scene import ObjectSlot, Scene, SceneObject, shaped
from bulletarm_gym.scene.predicates import inside, is_top, loose_objects, success_at_rest, touching, upright
from bulletarm_gym.scene.sampling import GRASP_AREA, footprint, goal_site, most_free, place_apart
from bulletarm_gym.tasks.task import Task

BLOCK_SPACING = 0.025
"""Smallest gap (m) between blocks at the start."""
PICK_OFFSET = 0.0125
"""Depth (m) of a grasp below the top of a block of scale 1, so that every gripper stays above the rim."""
OPENING = 0.058
"""Largest distance (m) between the fingers, half a block wider than a block, to avoid its neighbours."""
PACKING_CLEARANCE = 0.001
"""Gap (m) around a packed block and its fingers."""
FINGER_RELEASE = 0.004
"""Displacement (m) of a finger at a release."""
BELOW_RIM = 0.003
"""Smallest depth (m) of a packed block's expected origin below the rim."""
ROW_WEIGHT = 0.5
"""Weight of the distance to the long walls relative to the distance to the short wall."""
VIEW = 0.24
"""Side (m) of a square that contains the bin at any yaw."""
PITCH = 0.001
"""Side (m) of a pixel of the elevation map of the bin."""

SPOTS = [
    (x, y, containers.TRAY_FLOOR)
    for x in (-TRAY[0] / 3.0, 0.0, TRAY[0] / 3.0)
    for y in (-TRAY[1] / 4.0, TRAY[1] / 4.0)
]
"""Positions (m) of six bottles, in the frame of the tray."""
BOTTLE_SPACING = 0.024
"""Smallest gap (m) around a bottle at the start, for the fingers at its neck."""
NECK_OFFSET = 0.025
"""Depth (m) of a grasp below the top of a bottle of scale 1, at its neck."""
BOTTLE_GAP = 0.002
"""Gap (m) between a bottle and the tray's floor at the release."""
NECK_OPENING = 0.05
"""Largest distance (m) between the fingers, wider than any neck, to avoid the neighbours."""


class BinPacking(Task):
    """Put all blocks into a bin.

    Description: eight (one to eight) blocks of seven shapes, 4 x 4 x 2 to 8 x 4 x 4 cm, lie on the surface
    next to a fixed bin, 17.6 x 14.4 x 8 cm.
    Randomisation: the shapes, the positions and yaws of blocks and bin. With ``random_orientation=False`` the
    long sides of bin and blocks are along y.
    Success: all blocks are in the bin, their origins below its rim; the gripper is empty and nothing moves.
    Expert: repeat until solved: grasp the largest block outside, release it as low as possible in the bin,
    close to a corner.
    """

    instructions = ("Put all blocks into a bin{surface}.", "Pack the blocks into the bin{surface}.")
    defaults = TaskDefaults(
        num_objects=8,
        max_steps=20,
        object_scale=0.8,
        allowed_objects=tuple(range(1, 9)),
        no_tray="the bin and its blocks do not fit into the tray",
        close_loop={"max_steps": 200, "workspace": WIDE},
    )
    controls = (OPEN_LOOP, CLOSE_LOOP)
    site = (BIN[1], BIN[0])
    height = BIN[2]

    @property
    def grasp_params(self) -> GraspParams:
        return GraspParams(pick_offset=PICK_OFFSET * max(self.config.scales), opening=OPENING)

    def bodies(self, config: EnvConfig) -> list[ObjectSlot]:
        names = [f"block {number}" for number in range(config.num_objects)]
        blocks = [shaped(config, name, packing_block, len(SHAPES)) for name in names]
        return [ObjectSlot("bin", (containers.packing_bin("bin"),)), *blocks]

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        site = goal_site(scene, rng, self.site)
        scene["bin"].place(site.compose(Pose.planar(0.0, 0.0, 0.0, math.pi / 2.0)))
        base = footprint(scene["bin"])

        def is_graspable(pose: Pose) -> bool:
            area = Footprint.rectangle(GRASP_AREA, pose)
            return not self.config.random_orientation or area.gap(base) > 0.0

        place_apart(scene, rng, scene.objects[1:], BLOCK_SPACING, allows=is_graspable)

    def evaluate(self, scene: Scene) -> dict[str, bool]:
        packed = all(self._is_in_bin(scene, block) for block in loose_objects(scene))
        return success_at_rest(scene, is_packed=packed)

    def parts(self, scene: Scene, rng: np.random.Generator) -> tuple[int, int]:
        blocks = loose_objects(scene)
        return sum(self._is_in_bin(scene, block) for block in blocks), len(blocks)

    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        held, blocks = scene.held, loose_objects(scene)
        if held is not None:
            yield Waypoint(FreeSpace(scene, held).best(), CLOSED, finish=OPEN)
            return
        outside = [block for block in blocks if not self._is_in_bin(scene, block)] or blocks
        free = [block for block in outside if is_top(block, blocks)] or outside
        yield pick(scene, max(free, key=lambda block: math.prod(block.spec.extents)), rng, OPENING)

    def _is_in_bin(self, scene: Scene, block: SceneObject) -> bool:
        rise = block.pose.z - scene["bin"].pose.z
        return inside(block, scene["bin"]) and rise < BIN[2] and block is not scene.held


class FreeSpace:
    """Search for a release pose in the bin, without collisions of the grasped block and the open fingers.

    All coordinates are in the bin's frame, and positions refer to the fingertips.
    """

    def __init__(self, scene: Scene, held: SceneObject) -> None:
        self._scene = scene
        self._held = held
        self._bin = scene["bin"].pose
        self._xs, self._ys = (np.arange(PITCH / 2.0 - side / 2.0, side / 2.0, PITCH) for side in BIN[:2])
        self._heights = self._elevation()

    def best(self) -> Pose:
        """Return the tool pose in the world that releases the block as low as possible, close to a corner."""
        above = Pose.planar(0.0, 0.0, 2.0 * BIN[2], self._yaws()[0])
        found = [option for yaw in self._yaws() if (option := self._lowest(yaw))]
        _, pose = min(found, key=lambda option: option[0], default=((), above))
        return self._bin.compose(pose)

    def _yaws(self) -> list[float]:
        """Return the gripper's yaws with the block's long side along the bin's x and y axes."""
        yaw = self._scene.robot.pose.yaw - self._bin.yaw
        if not rotates(self._scene):
            return [yaw]
        across = yaw - (resting_frame(self._held).yaw - self._bin.yaw)
        return [across + math.pi / 2.0, across]

    def _lowest(self, yaw: float) -> tuple[tuple[float, ...], Pose] | None:
        """Return a key for comparison and the pose of the lowest release at a yaw."""
        low, high = self._outline(yaw)
        rest = self._highest(low, high, math.inf)
        lowest = rest + RELEASE - low[2]
        origin = self._held.pose.z - self._scene.robot.pose.z
        fits = rest - low[2] + origin < BIN[2] - BELOW_RIM
        tips = lowest
        for outline, height in self._fingers(yaw):
            tips = np.maximum(tips, self._highest(*outline, 0.0) + PACKING_CLEARANCE - height)
        if not fits.any():
            return None
        free = fits & (tips <= lowest)
        steps = np.round(np.where(free, rest, np.inf) / PITCH)
        if not free.any():  # released higher, so that the fingers touch nothing
            steps = np.round(np.where(fits, tips, np.inf) / PITCH)
        cost = self._xs[:, None] - ROW_WEIGHT * np.abs(self._ys)
        row, column = np.unravel_index(np.where(steps == steps.min(), cost, np.inf).argmin(), steps.shape)
        pose = Pose.planar(self._xs[row], self._ys[column], tips[row, column], yaw)
        return (not free.any(), float(steps[row, column]), yaw != self._yaws()[0]), pose

    def _outline(self, yaw: float) -> tuple[FloatArray, FloatArray]:
        """Return the lowest and the highest corner (m) of the block relative to the fingertips at a yaw."""
        tool, held = self._scene.robot.pose, self._held
        points = held.spec.mesh.vertices @ matrix(held.pose).T + held.pose.position - np.array(tool.position)
        rotated = points @ matrix(Pose.planar(0.0, 0.0, 0.0, yaw + self._bin.yaw - tool.yaw)).T
        in_bin = rotated @ matrix(self._bin)
        return in_bin.min(axis=0) - PACKING_CLEARANCE, in_bin.max(axis=0) + PACKING_CLEARANCE

    def _fingers(self, yaw: float) -> Iterator[tuple[tuple[FloatArray, FloatArray], float]]:
        """Yield outlines of the opened fingers, see :meth:`_outline`, and heights (m) above the tips."""
        gripper = self._scene.robot.model.gripper
        thickness, width, _ = gripper.finger
        inner = self._scene.robot.opening / 2.0
        for (thick, height), side in itertools.product(((thickness, 0.0), gripper.shoulder), (1.0, -1.0)):
            corners = [
                Pose.planar(0.0, 0.0, 0.0, yaw).transform((side * x, y, 0.0))
                for x in (inner, inner + FINGER_RELEASE + thick)
                for y in (-width / 2.0, width / 2.0)
            ]
            yield (np.min(corners, axis=0), np.max(corners, axis=0)), height

    def _elevation(self) -> FloatArray:
        """Return the heights (m) in the bin, its walls included, per pixel along its x and y axes."""
        bodies = [obj.body for obj in self._scene if obj not in (self._scene["bin"], self._held)]
        size = round(VIEW / PITCH)
        view = HeightRenderer.of(self._scene).heights_of(bodies, Window(self._bin.position[:2], VIEW, size))
        grid = np.stack(np.meshgrid(self._xs, self._ys, indexing="ij"), axis=-1)
        rows, columns = ((grid @ matrix(self._bin)[:2, :2].T + VIEW / 2.0) / VIEW * size).astype(int).T
        heights = np.maximum(view[rows.T, columns.T] - self._bin.z, containers.BIN_WALL)
        inside = (np.abs(grid) < np.array(BIN[:2]) / 2.0 - containers.BIN_WALL).all(axis=-1)
        return np.where(inside, heights, BIN[2])

    def _highest(self, low: FloatArray, high: FloatArray, outside: float) -> FloatArray:
        """Return the largest height (m) in an outline around each position, with a height next to the bin."""
        first, last = np.floor(low[:2] / PITCH).astype(int), np.ceil(high[:2] / PITCH).astype(int)
        count, margin = last - first + 1, max(0, *-first, *last)
        highest = maximum_filter(np.pad(self._heights, margin, constant_values=outside), tuple(count))
        (row, column), (rows, columns) = margin + first + count // 2, self._heights.shape
        found: FloatArray = highest[row : row + rows, column : column + columns]
        return found


class BottleArrangement(Task):
    """Put all bottles into a tray.

    Description: six (one to six) bottles of eight shapes, about 5 x 5 x 14 cm, stand on the surface next to a
    fixed tray, 24 x 16 x 5 cm.
    Randomisation: the shapes, the positions and yaws of bottles and tray.
    Success: all bottles stand upright in the tray; the gripper is empty and nothing moves.
    Validity: no bottle has fallen over.
    Expert: repeat until solved: grasp a bottle at its neck, release it at the most free of the tray's six
    positions.
    """

    instructions = ("Put all bottles into a tray.", "Arrange the bottles upright in the tray.")
    defaults = TaskDefaults(
        num_objects=6,
        max_steps=20,
        object_scale=0.8,
        allowed_objects=tuple(range(1, 7)),
        no_tray="the bottles and their own tray do not fit into the tray",
        level_ground="bottles fall over on a slope",
        close_loop={"max_steps": 240, "workspace": WIDE},
    )
    controls = (OPEN_LOOP, CLOSE_LOOP)
    site = TRAY[:2]

    @property
    def height(self) -> float:
        """Height (m) of the middle of a bottle in the tray."""
        return containers.TRAY_FLOOR + containers.BOTTLE_HEIGHT * max(self.config.scales) / 2.0

    @property
    def grasp_params(self) -> GraspParams:
        depth = NECK_OFFSET * max(self.config.scales)
        return GraspParams(pick_offset=depth, place_offset=BOTTLE_GAP, opening=NECK_OPENING)

    def bodies(self, config: EnvConfig) -> list[ObjectSlot]:
        names = [f"bottle {number}" for number in range(config.num_objects)]
        bottles = [shaped(config, name, containers.bottle, len(BOTTLES)) for name in names]
        return [ObjectSlot("tray", (containers.bottle_tray("tray"),)), *bottles]

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        scene["tray"].place(goal_site(scene, rng, self.site))
        place_apart(scene, rng, scene.objects[1:], BOTTLE_SPACING)

    def evaluate(self, scene: Scene) -> dict[str, bool]:
        arranged = all(self._is_in_tray(scene, obj) for obj in loose_objects(scene))
        return success_at_rest(scene, is_arranged=arranged)

    def parts(self, scene: Scene, rng: np.random.Generator) -> tuple[int, int]:
        bottles = loose_objects(scene)
        return sum(self._is_in_tray(scene, obj) for obj in bottles), len(bottles)

    def is_valid(self, scene: Scene) -> bool:
        return super().is_valid(scene) and all(
            upright(obj) for obj in loose_objects(scene) if obj is not scene.held
        )

    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        held, yaw, bottles = scene.held, scene["tray"].pose.yaw, loose_objects(scene)
        if held is not None:
            rotation = wrap_angle(yaw - scene.robot.pose.yaw, math.pi / 2.0)
            others = [obj for obj in bottles if obj is not held]
            spot = most_free(map(scene["tray"].pose.transform, SPOTS), others)
            goal = place_pose(scene, held, spot, spot[2] + RELEASE, rotation)
            yield Waypoint(goal, CLOSED, finish=OPEN)
            return
        obj = next((obj for obj in bottles if not self._is_in_tray(scene, obj)), bottles[0])
        x, y, _ = obj.pose.position
        height = scene.world.top(obj.body) - self.grasp_params.pick_offset
        yield Waypoint(Pose.planar(x, y, height, yaw), OPEN, finish=CLOSED)

    def _is_in_tray(self, scene: Scene, obj: SceneObject) -> bool:
        tray = scene["tray"]
        return inside(obj, tray) and upright(obj) and obj is not scene.held and touching(scene, tray, obj)
