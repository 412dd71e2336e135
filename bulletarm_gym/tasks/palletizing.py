"""Stacking boxes on a pallet."""

import itertools
import math
from collections.abc import Iterator

import numpy as np

from bulletarm_gym.config import CLOSE_LOOP, OPEN_LOOP, WIDE, EnvConfig, TaskDefaults
from bulletarm_gym.control import GraspParams
from bulletarm_gym.experts import Waypoint
from bulletarm_gym.experts.approach import rotates
from bulletarm_gym.experts.pick_place import pick, put, resting_frame
from bulletarm_gym.geometry import Footprint, PlacementError, Pose, wrap_angle
from bulletarm_gym.objects.blocks import BOX, palletizing_box
from bulletarm_gym.objects.containers import PALLET, pallet
from bulletarm_gym.scene import ObjectSlot, Scene, SceneObject, sampling, scaled
from bulletarm_gym.scene.predicates import UPRIGHT, inside, is_top, loose_objects, success_at_rest
from bulletarm_gym.scene.sampling import GRASP_AREA, footprint, goal_site, sample_until
from bulletarm_gym.tasks.task import Task

LAYER = 6
"""Number of boxes in a layer (paper, Box Palletizing: 6, 12 or 18 boxes)."""
BOX_SPACING = 0.02
"""Gap (m) between the boxes of a layer, for a finger that releases a box."""
YAW_TOLERANCE = math.pi / 8.0
"""Largest yaw (rad) of a box relative to its layer's."""
LAYER_TOLERANCE = 0.25
"""Largest height difference of a box from its layer, relative to its height."""
PICK_OFFSET = 0.02
"""Depth (m) of a grasp below the top of a box of scale 1."""
BOX_MARGIN = 0.01
"""Distance (m) of a new box to the workspace's border and the pallet, because it may slide on bumps."""
ASIDE_CLEARANCE = 0.03
"""Gap (m) around a box that is put aside."""
ATTEMPTS = 4000
"""Number of samples for a new box, because the gripper fits only in a small part of the workspace."""
NO_ROOM = "no room"
"""Memory of the task if the next box has no free pose."""


class BoxPalletizing(Task):
    """Stack boxes on a pallet in layers of six, each rotated by 90 degrees against the one below.

    Description: a fixed pallet, 23.2 x 19.2 x 3 cm, and a box, 7.2 x 4.5 x 4.5 cm. When all present boxes are
    placed correctly and the gripper is empty, the next box appears, until there are N: 18, 12 or 6.
    Randomisation: position and yaw of the pallet, and of each new box next to it. With
    ``random_orientation=False`` the pallet's long side is along y and a new box has the yaw of its layer. All
    boxes of an episode have the same size.
    Success: all N boxes are placed correctly: six per layer from the bottom up, upright, their yaws within
    22.5 degrees of their layer's, which is along the pallet's long side in the first and third layer, across
    it in the second. The gripper is empty and nothing moves.
    Validity: the next box has a free pose when it is due.
    Expert: repeat until solved: grasp the box, release it at the next free place of the lowest layer that is
    not full.
    """

    instructions = (
        "Stack {num_objects} boxes on a pallet{surface}, six a layer.",
        "Load the pallet{surface} with {num_objects} boxes in layers of six.",
    )
    defaults = TaskDefaults(
        num_objects=3 * LAYER,
        max_steps=40,
        object_scale=0.8,
        allowed_objects=(LAYER, 2 * LAYER, 3 * LAYER),
        no_tray="the pallet and a box next to it do not fit into the tray",
        close_loop={"max_steps": 400, "workspace": WIDE},
    )
    controls = (OPEN_LOOP, CLOSE_LOOP)
    site = (PALLET[1], PALLET[0])

    @property
    def _layers(self) -> int:
        return self.config.num_objects // LAYER

    @property
    def height(self) -> float:
        """Height (m) of the middle of a box of the top layer."""
        return PALLET[2] + (self._layers - 0.5) * BOX[2] * max(self.config.scales)

    @property
    def grasp_params(self) -> GraspParams:
        return GraspParams(pick_offset=PICK_OFFSET * max(self.config.scales))

    def bodies(self, config: EnvConfig) -> list[ObjectSlot]:
        first, *others = (f"box {number}" for number in range(config.num_objects))
        boxes = [scaled(config, name, palletizing_box, like=first) for name in others]
        return [ObjectSlot("pallet", (pallet("pallet"),)), scaled(config, first, palletizing_box), *boxes]

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        site = goal_site(scene, rng, self.site)
        scene["pallet"].place(site.compose(Pose.planar(0.0, 0.0, 0.0, math.pi / 2.0)))
        self._add_box(scene, rng)

    def after_action(self, scene: Scene, rng: np.random.Generator) -> None:
        boxes = loose_objects(scene)
        done = success_at_rest(scene, is_stacked=len(self._correct(scene)) == len(boxes))
        if done["success"] and len(boxes) < self.config.num_objects:
            try:
                self._add_box(scene, rng)
            except PlacementError:
                self.memory = NO_ROOM

    def is_valid(self, scene: Scene) -> bool:
        return super().is_valid(scene) and self.memory != NO_ROOM

    def _add_box(self, scene: Scene, rng: np.random.Generator) -> None:
        """Place the next box on the surface, with space for the gripper next to the pallet."""
        number = len(loose_objects(scene))
        box, base = scene[f"box {number}"], footprint(scene["pallet"])
        layer_direction = scene["pallet"].pose.yaw + layer_yaw(number // LAYER)

        def draw() -> Pose:
            x, y = (float(rng.uniform(low, high)) for low, high in self.config.workspace[:2])
            random = self.config.random_orientation
            yaw = float(rng.uniform(-math.pi, math.pi)) if random else layer_direction
            return scene.surface.lay(box.spec, (x, y), yaw)

        def fits(pose: Pose) -> bool:
            shadow = footprint(box, pose)
            yaw = pose.yaw if rotates(scene) else 0.0
            area = Footprint.rectangle(GRASP_AREA, Pose.planar(*pose.position, yaw))
            free = min(area.gap(base), shadow.gap(base) - BOX_MARGIN) > 0.0
            return free and scene.surface.fits(shadow, BOX_MARGIN)

        box.place(sample_until(draw, fits, ATTEMPTS))

    def evaluate(self, scene: Scene) -> dict[str, bool]:
        return success_at_rest(scene, is_stacked=len(self._correct(scene)) == self.config.num_objects)

    def parts(self, scene: Scene, rng: np.random.Generator) -> tuple[int, int]:
        return len(self._correct(scene)), self.config.num_objects

    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        held = scene.held
        if held is None:
            yield pick(scene, self._next(scene), rng)
            return
        free = self._free(scene, held) or [self._aside(scene, rng, held)]
        yield put(scene, held, free[0])

    def _aside(self, scene: Scene, rng: np.random.Generator, held: SceneObject) -> Pose:
        try:
            aside = sampling.free_pose(scene, rng, held, ASIDE_CLEARANCE)
        except PlacementError:
            return scene.surface.pose(sampling.most_free_point(scene, held), 0.0)
        return scene.surface.pose((aside.x, aside.y), aside.yaw)

    def _next(self, scene: Scene) -> SceneObject:
        """Return a misplaced box, or the highest box if none is misplaced."""
        boxes, correct = loose_objects(scene), self._correct(scene)
        wrong = [box for box in boxes if box not in correct]
        highest = max(wrong or boxes, key=lambda box: box.pose.z)
        return next((box for box in wrong if is_top(box, boxes)), highest)

    def _correct(self, scene: Scene) -> list[SceneObject]:
        """Return the correctly placed boxes, of a layer only if all layers below are full."""
        found = [(self._layer(scene, box), box) for box in loose_objects(scene) if box is not scene.held]
        correct: list[SceneObject] = []
        for number in range(self._layers):
            boxes = [box for layer, box in found if layer == number]
            if len(correct) == number * LAYER and len(boxes) <= LAYER:
                correct += boxes
        return correct

    def _layer(self, scene: Scene, box: SceneObject) -> int | None:
        """Return the layer in which a box is placed correctly."""
        frame = scene["pallet"].pose.inverse().compose(resting_frame(box))
        level = (frame.z - PALLET[2]) / box.spec.extents[2] - 0.5
        layer = round(level)
        stands = layer >= 0 and abs(level - layer) < LAYER_TOLERANCE and frame.tilt < UPRIGHT
        yaw_error = abs(wrap_angle(frame.yaw - layer_yaw(layer), math.pi))
        return layer if stands and inside(box, scene["pallet"]) and yaw_error < YAW_TOLERANCE else None

    def _free(self, scene: Scene, held: SceneObject) -> list[Pose]:
        """Return the free places of the lowest layer that is not full, in the world."""
        layer = min(len(self._correct(scene)) // LAYER, self._layers - 1)
        width, length, height = held.spec.extents
        base = scene["pallet"].pose.compose(Pose((0.0, 0.0, PALLET[2] + layer * height)))
        others = [box for box in loose_objects(scene) if box is not held]
        taken = [footprint(box) for box in others if scene.world.top(box.body) > base.z + height / 2.0]
        frames = [base.compose(frame) for frame in places(layer, width, length)]
        areas = [Footprint.rectangle((width, length), frame) for frame in frames]
        are_free = [area.gap(*taken) > 0.0 for area in areas]
        return list(itertools.compress(frames, are_free))


def layer_yaw(layer: int) -> float:
    """Return the yaw (rad) of a layer's boxes relative to the pallet; their y axis is the long one."""
    return 0.0 if layer % 2 else math.pi / 2.0


def places(layer: int, width: float, length: float) -> list[Pose]:
    """Return the places of a layer's six boxes in the pallet's frame, at the bottom of the layer."""
    columns = [side * (length + BOX_SPACING) / 2.0 for side in (-1.0, 1.0)]
    rows = [side * (width + BOX_SPACING) for side in (-1.0, 0.0, 1.0)]
    grid = [(row, column) if layer % 2 else (column, row) for column in columns for row in rows]
    return [Pose.planar(*point, 0.0, layer_yaw(layer)) for point in grid]
