"""Packing blocks into a bin."""

import itertools
import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from bulletarm_gym.config import CLOSE_LOOP, OPEN_LOOP, WIDE, EnvConfig, TaskDefaults, TrayUse
from bulletarm_gym.control import GraspParams
from bulletarm_gym.experts.approach import RELEASE
from bulletarm_gym.experts.pick_place import pick, resting_frame
from bulletarm_gym.experts.waypoints import CLOSED, OPEN, Waypoint
from bulletarm_gym.geometry import FloatArray, Footprint, Pose, matrix
from bulletarm_gym.objects.blocks import SHAPES, packing_block
from bulletarm_gym.objects.containers import BIN, BIN_WALL, packing_bin
from bulletarm_gym.observations import HeightRenderer, Window
from bulletarm_gym.scene import ObjectSlot, Scene, SceneObject, shaped
from bulletarm_gym.scene.predicates import at_rest, inside, is_empty, is_top
from bulletarm_gym.scene.sampling import GRASP_ROOM, footprint, place_apart
from bulletarm_gym.tasks.task import Task

MOST_BLOCKS = 8
"""As many as the paper's (Bin Packing)."""
BLOCK_SPACING = 0.025
"""Least gap (m) between blocks at the start."""
PICK_OFFSET = 0.0125
"""How far (m) below its top a block of scale 1 is grasped: on the bin's floor every hand is above the rim."""
OPENING = 0.058
"""Greatest distance (m) of the fingers: half wider than a block, so that its neighbours are not touched."""
PACKING_CLEARANCE = 0.001
"""Gap (m) kept to what is beside a block and its fingers."""
FINGER_RELEASE = 0.004
"""How far (m) a finger moves out to let go."""
BELOW_RIM = 0.003
"""How far (m) below the rim the origin of what is packed must be expected."""
ROW_WEIGHT = 0.5
"""A place is as good as it is towards one short wall and, by this share, towards the long walls."""
VIEW = 0.24
"""Side (m) of the square that is looked at: the bin at any yaw."""
PITCH = 0.001
"""Side (m) of the pixels in which room is looked for."""


class BinPacking(Task):
    """Put all blocks into a bin.

    Description: eight (one to eight) blocks of seven shapes, 4 x 4 x 2 to 8 x 4 x 4 cm, lie on the ground
    beside a fixed bin, 17.6 x 14.4 x 8 cm.
    Randomisation: the shapes, the positions and yaws of blocks and bin. With ``random_orientation=False`` the
    bin's long side is along y, as those of the blocks.
    Success: all blocks are in the bin, their origins below its rim; the gripper is empty and nothing moves.
    Expert: grasp the largest block outside, put it as low in the bin as it goes, close to a corner.
    """

    defaults = TaskDefaults(
        num_objects=MOST_BLOCKS,
        max_steps=20,
        object_scale=0.8,
        allowed_objects=tuple(range(1, MOST_BLOCKS + 1)),
        tray=TrayUse((False,), "the bin and its blocks do not fit into the tray"),
        close_loop={"max_steps": 200, "workspace": WIDE},
    )
    controls = (OPEN_LOOP, CLOSE_LOOP)
    site = (BIN[1], BIN[0])

    @property
    def height(self) -> float:
        """Blocks may be as high as the rim."""
        return BIN[2]

    @property
    def grasp_params(self) -> GraspParams:
        """Blocks are grasped near their tops."""
        return GraspParams(pick_offset=PICK_OFFSET * max(self.config.scales), opening=OPENING)

    def bodies(self, config: EnvConfig) -> list[ObjectSlot]:
        """Return the bin, and for each block all shapes in all sizes."""
        names = [f"block {number}" for number in range(config.num_objects)]
        blocks = [shaped(config, name, packing_block, len(SHAPES)) for name in names]
        return [ObjectSlot("bin", (packing_bin("bin"),)), *blocks]

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        """Put the bin somewhere, and the blocks beside it."""
        spread = math.pi if self.config.random_orientation else 0.0
        blocks = [item for item in scene.objects if item is not scene["bin"]]

        def leaves_room(pose: Pose) -> bool:
            hand = Footprint.rectangle(GRASP_ROOM, pose)
            return not self.config.random_orientation or hand.gap(footprint(scene["bin"])) > 0.0

        site = scene.surface.goal_site(self.site, rng, spread)
        scene["bin"].place(site.compose(Pose.planar(0.0, 0.0, 0.0, math.pi / 2.0)))
        place_apart(scene, rng, blocks, BLOCK_SPACING, allows=leaves_room)

    def evaluate(self, scene: Scene) -> dict[str, bool]:
        """Look whether all blocks are in the bin, and whether all is done."""
        facts = {
            "is_packed": all(self._is_in_bin(scene, item) for item in self._blocks(scene)),
            "is_empty": is_empty(scene),
            "is_at_rest": at_rest(scene),
        }
        return {"success": all(facts.values()), **facts}

    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        """Grasp the largest block that is outside, or put it into the bin."""
        held, blocks = scene.held, self._blocks(scene)
        if held is not None:
            yield Waypoint(Room(scene, held).best(), CLOSED, finish=OPEN)
            return
        outside = [item for item in blocks if not self._is_in_bin(scene, item)] or blocks
        free = [item for item in outside if is_top(item, blocks)] or outside
        yield pick(scene, max(free, key=_volume), rng)

    def _blocks(self, scene: Scene) -> list[SceneObject]:
        return [item for item in scene if item is not scene["bin"]]

    def _is_in_bin(self, scene: Scene, item: SceneObject) -> bool:
        rise = item.pose.z - scene["bin"].pose.z
        return inside(item, scene["bin"]) and rise < BIN[2] and item is not scene.held


def _volume(item: SceneObject) -> float:
    """Return the volume (m^3) of an item's bounding box."""
    return math.prod(item.spec.extents)


class Room:
    """Where in the bin the held block has room, as seen from above: the block itself and the open fingers.

    All is in the bin's frame; a place is that of the fingertips.
    """

    def __init__(self, scene: Scene, held: SceneObject) -> None:
        self._scene = scene
        self._held = held
        self._bin = scene["bin"].pose
        self._xs, self._ys = (np.arange(PITCH / 2.0 - side / 2.0, side / 2.0, PITCH) for side in BIN[:2])
        self._heights = self._look()

    def best(self) -> Pose:
        """Return the pose of the gripper that puts the block as low as it goes, close to a corner."""
        for needs_fingers in (True, False):
            found = [place for yaw in self._yaws() if (place := self._lowest(yaw, needs_fingers))]
            if found:
                return min(found, key=lambda place: place[0])[1]
        return self._bin.compose(Pose.planar(0.0, 0.0, 2.0 * BIN[2], self._yaws()[0]))

    def _yaws(self) -> list[float]:
        """Return the gripper's yaws that lay the block's long side along the bin's x or y axis."""
        hand = self._scene.robot.pose.yaw - self._bin.yaw
        if "r" not in self._scene.config.action_sequence:
            return [hand]
        across = hand - (resting_frame(self._held).yaw - self._bin.yaw)
        return [across + math.pi / 2.0, across]

    def _lowest(self, yaw: float, needs_fingers: bool) -> tuple[tuple[float, ...], Pose] | None:
        """Return where the block goes lowest with the gripper turned by a yaw, and a key to compare it by.

        :param needs_fingers: require room for the fingers; if False, the block is released above what they
            would touch
        """
        low, high = self._outline(yaw)
        rest = self._highest(low, high, math.inf)
        lowest = rest + RELEASE - low[2]
        fits = rest - low[2] + self._origin() < BIN[2] - BELOW_RIM
        tips = lowest
        for outline, height in self._fingers(yaw):
            tips = np.maximum(tips, self._highest(*outline, 0.0) + PACKING_CLEARANCE - height)
        if needs_fingers:
            fits &= tips <= lowest
        if not fits.any():
            return None
        steps = np.where(fits, np.round((rest if needs_fingers else tips) / PITCH), np.inf)
        aside = self._xs[:, None] - ROW_WEIGHT * np.abs(self._ys)
        row, column = np.unravel_index(np.where(steps == steps.min(), aside, np.inf).argmin(), steps.shape)
        pose = Pose.planar(self._xs[row], self._ys[column], tips[row, column], yaw)
        return (float(steps[row, column]), yaw != self._yaws()[0]), self._bin.compose(pose)

    def _origin(self) -> float:
        """Return the height (m) of the block's origin over the fingertips."""
        return self._held.pose.z - self._scene.robot.pose.z

    def _outline(self, yaw: float) -> tuple[FloatArray, FloatArray]:
        """Return the lowest and the highest corner (m) of the block about the fingertips, turned by a yaw."""
        hand, held = self._scene.robot.pose, self._held
        points = held.spec.mesh.vertices @ matrix(held.pose).T + held.pose.position - np.array(hand.position)
        turned = points @ matrix(Pose.planar(0.0, 0.0, 0.0, yaw + self._bin.yaw - hand.yaw)).T
        seen = turned @ matrix(self._bin)
        return seen.min(axis=0) - PACKING_CLEARANCE, seen.max(axis=0) + PACKING_CLEARANCE

    def _fingers(self, yaw: float) -> Iterator[tuple[tuple[FloatArray, FloatArray], float]]:
        """Yield outlines of the opened fingers, see :meth:`_outline`, and heights (m) over the tips."""
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

    def _look(self) -> FloatArray:
        """Return the heights (m) in the bin, walls among them, pixel by pixel along its x and y axes."""
        bodies = [item.body for item in self._scene if item not in (self._scene["bin"], self._held)]
        size = round(VIEW / PITCH)
        view = HeightRenderer.of(self._scene).heights_of(bodies, Window(self._bin.position[:2], VIEW, size))
        grid = np.stack(np.meshgrid(self._xs, self._ys, indexing="ij"), axis=-1)
        rows, columns = ((grid @ matrix(self._bin)[:2, :2].T + VIEW / 2.0) / VIEW * size).astype(int).T
        heights = np.maximum(view[rows.T, columns.T] - self._bin.z, BIN_WALL)
        inside = (np.abs(grid) < np.array(BIN[:2]) / 2.0 - BIN_WALL).all(axis=-1)
        return np.where(inside, heights, BIN[2])

    def _highest(self, low: FloatArray, high: FloatArray, outside: float) -> FloatArray:
        """Return for each place the greatest height (m) within an outline about it.

        :param outside: height (m) outside the bin
        """
        found = self._heights
        for axis in (0, 1):
            first, last = math.floor(low[axis] / PITCH), math.ceil(high[axis] / PITCH)
            margin = max(-first, last, 0)
            # Height by height along the first axis; turned over after each, both axes come first once.
            sides = np.full((margin, found.shape[1]), outside, found.dtype)
            windows = _greatest(np.concatenate([sides, found, sides]), last - first + 1)
            found = np.ascontiguousarray(windows[margin + first :][: len(found)].T)
        return found


def _greatest(rows: NDArray[np.float32], count: int) -> NDArray[np.float32]:
    """Return the greatest of each ``count`` rows that follow each other, of twice as many in each turn."""
    taken = 1
    while 2 * taken <= count:
        rows = np.maximum(rows[:-taken], rows[taken:])
        taken *= 2
    left = count - taken
    return np.maximum(rows[:-left], rows[left:]) if left else rows
