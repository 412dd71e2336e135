"""Stacking boxes on a pallet."""

import math
from collections.abc import Iterator

import numpy as np

from bulletarm_gym.config import CLOSE_LOOP, OPEN_LOOP, WIDE, EnvConfig, TaskDefaults, TrayUse
from bulletarm_gym.control import GraspParams
from bulletarm_gym.experts.pick_place import pick, put, resting_frame
from bulletarm_gym.experts.waypoints import Waypoint
from bulletarm_gym.geometry import Footprint, PlacementError, Pose, wrap_angle
from bulletarm_gym.objects.blocks import BOX, palletizing_box
from bulletarm_gym.objects.containers import PALLET, pallet
from bulletarm_gym.scene import ObjectSlot, Scene, SceneObject, scaled
from bulletarm_gym.scene.predicates import UPRIGHT, at_rest, inside, is_empty, is_top
from bulletarm_gym.scene.sampling import GRASP_ROOM, footprint, free_pose, most_free_point, sample_until
from bulletarm_gym.tasks.task import Task

LAYER = 6
"""Boxes a layer (paper, Box Palletizing: 6, 12 or 18)."""
BOX_SPACING = 0.02
"""Between the boxes of a layer (m): a finger fits in and lets go."""
YAW_TOLERANCE = math.pi / 8.0
"""Greatest yaw (rad) of a box against its layer's."""
LAYER_TOLERANCE = 0.25
"""Greatest height, in boxes, by which a box may be above or below its layer."""
PICK_OFFSET = 0.02
"""At scale 1 (m)."""
BOX_MARGIN = 0.01
"""Margin (m) of a new box to the workspace's border and the pallet: on bumps it slides until it rests."""
ASIDE_CLEARANCE = 0.03
"""Gap (m) kept around a box that is put aside."""
ATTEMPTS = 4000
"""Places tried for a new box: where the hand has room is a small part of the workspace."""
NO_ROOM = "no room"
"""What is remembered when the next box found none."""


class BoxPalletizing(Task):
    """Stack boxes on a pallet in layers of six, each turned by 90 degrees against the one below.

    Description: a fixed pallet, 23.2 x 19.2 x 3 cm, and a box, 7.2 x 4.5 x 4.5 cm. As soon as the boxes there
    are stand in right places and the gripper is empty, the next appears on the ground, until there are N: 18,
    12 or 6.
    Randomisation: position and yaw of the pallet, and of each new box beside it. With
    ``random_orientation=False`` the pallet's long side is along y and a new box has the yaw of its layer.
    Success: all N stand in right places: six each in the first, second and third layer, from the bottom up,
    upright, their yaws within 22.5 degrees of their layer's: along the pallet's long side in the first and
    third, across it in the second. The gripper is empty and nothing moves.
    Validity: there is room for the next box when it is due.
    Expert: grasp the box, put it in the next free place of the lowest layer that is not full.
    """

    defaults = TaskDefaults(
        num_objects=3 * LAYER,
        max_steps=40,
        object_scale=0.8,
        allowed_objects=(LAYER, 2 * LAYER, 3 * LAYER),
        tray=TrayUse((False,), "the pallet and a box beside it do not fit into the tray"),
        close_loop={"max_steps": 400, "workspace": WIDE},
    )
    controls = (OPEN_LOOP, CLOSE_LOOP)
    site = (PALLET[1], PALLET[0])

    @property
    def height(self) -> float:
        """Up to the middle of a box of the uppermost layer."""
        layers = self.config.num_objects // LAYER
        return PALLET[2] + (layers - 0.5) * BOX[2] * max(self.config.scales)

    @property
    def grasp_params(self) -> GraspParams:
        """The fingers close a little above a box's middle."""
        return GraspParams(pick_offset=PICK_OFFSET * max(self.config.scales))

    def bodies(self, config: EnvConfig) -> list[ObjectSlot]:
        """Return the pallet and all boxes."""
        boxes = [scaled(config, f"box {number}", palletizing_box) for number in range(config.num_objects)]
        return [ObjectSlot("pallet", (pallet("pallet"),)), *boxes]

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        """Put the pallet somewhere, and the first box beside it."""
        spread = math.pi if self.config.random_orientation else 0.0
        site = scene.surface.goal_site(self.site, rng, spread)
        scene["pallet"].place(site.compose(Pose.planar(0.0, 0.0, 0.0, math.pi / 2.0)))
        self._appear(scene, rng)

    def after_action(self, scene: Scene, rng: np.random.Generator) -> None:
        """Have the next box appear when all others stand in their places; no room for it ends the episode."""
        boxes = self._boxes(scene)
        done = len(boxes) < self.config.num_objects and len(self._right(scene)) == len(boxes)
        if done and is_empty(scene) and at_rest(scene):
            try:
                self._appear(scene, rng)
            except PlacementError:
                self.memory = NO_ROOM

    def is_valid(self, scene: Scene) -> bool:
        """Whether all is inside the workspace and the next box, when it was due, found room."""
        return super().is_valid(scene) and self.memory != NO_ROOM

    def _appear(self, scene: Scene, rng: np.random.Generator) -> None:
        """Put the next box on the ground, where the hand over it has room beside the pallet.

        :raises PlacementError: there is no such place
        """
        number = len(self._boxes(scene))
        box, base = scene[f"box {number}"], footprint(scene["pallet"])
        turned = scene["pallet"].pose.yaw + layer_yaw(number // LAYER)

        def draw() -> Pose:
            x, y = (float(rng.uniform(low, high)) for low, high in self.config.workspace[:2])
            yaw = float(rng.uniform(-math.pi, math.pi)) if self.config.random_orientation else turned
            return scene.surface.lay(box.spec, (x, y), yaw)

        def fits(pose: Pose) -> bool:
            shadow = footprint(box, pose)
            yaw = pose.yaw if "r" in self.config.action_sequence else 0.0
            hand = Footprint.rectangle(GRASP_ROOM, Pose.planar(*pose.position, yaw))
            return (
                scene.surface.fits(shadow, BOX_MARGIN)
                and min(hand.gap(base), shadow.gap(base) - BOX_MARGIN) > 0.0
            )

        box.place(sample_until(draw, fits, ATTEMPTS))

    def evaluate(self, scene: Scene) -> dict[str, bool]:
        """Look whether the boxes are stacked, and whether all is done."""
        facts = {
            "is_stacked": len(self._right(scene)) == self.config.num_objects,
            "is_empty": is_empty(scene),
            "is_at_rest": at_rest(scene),
        }
        return {"success": all(facts.values()), **facts}

    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        """Grasp the box that is not in its place, or put it there."""
        held = scene.held
        if held is None:
            yield pick(scene, self._next(scene), rng)
            return
        free = self._free(scene, held)
        if not free:
            free = [self._aside(scene, rng, held)]
        yield put(scene, held, free[:1])

    def _aside(self, scene: Scene, rng: np.random.Generator, held: SceneObject) -> Pose:
        """Return the frame of a free place on the ground, or of the freest."""
        try:
            aside = free_pose(scene, rng, held, ASIDE_CLEARANCE)
        except PlacementError:
            return scene.surface.pose(most_free_point(scene, held), 0.0)
        return scene.surface.pose((aside.x, aside.y), aside.yaw)

    def _next(self, scene: Scene) -> SceneObject:
        """Return a box that is not in its place, or the highest if all are."""
        boxes, right = self._boxes(scene), self._right(scene)
        wrong = [box for box in boxes if box not in right]
        highest = max(wrong or boxes, key=lambda box: box.pose.z)
        return next((box for box in wrong if is_top(box, boxes)), highest)

    # Places

    def _boxes(self, scene: Scene) -> list[SceneObject]:
        return [item for item in scene if item is not scene["pallet"]]

    def _right(self, scene: Scene) -> list[SceneObject]:
        """Return the boxes in right places: those of a layer count while all below it are full."""
        layers: list[list[SceneObject]] = [[] for _ in range(self.config.num_objects // LAYER)]
        for box in self._boxes(scene):
            layer = None if box is scene.held else self._layer(scene, box)
            if layer is not None and layer < len(layers):
                layers[layer].append(box)
        right: list[SceneObject] = []
        for number, layer_boxes in enumerate(layers):
            if len(right) == number * LAYER and len(layer_boxes) <= LAYER:
                right += layer_boxes
        return right

    def _layer(self, scene: Scene, box: SceneObject) -> int | None:
        """Return the layer that a box stands in as it should."""
        frame = scene["pallet"].pose.inverse().compose(resting_frame(box))
        level = (frame.z - PALLET[2]) / (BOX[2] * max(self.config.scales)) - 0.5
        layer = round(level)
        stands = layer >= 0 and abs(level - layer) < LAYER_TOLERANCE and frame.tilt < UPRIGHT
        turned = abs(wrap_angle(frame.yaw - layer_yaw(layer), math.pi))
        return layer if stands and inside(box, scene["pallet"]) and turned < YAW_TOLERANCE else None

    def _free(self, scene: Scene, held: SceneObject) -> list[Pose]:
        """Return the free places of the lowest layer that is not full, in the world, at its ground."""
        layer = min(len(self._right(scene)) // LAYER, self.config.num_objects // LAYER - 1)
        width, length, height = (side * max(self.config.scales) for side in BOX)
        base = scene["pallet"].pose.compose(Pose((0.0, 0.0, PALLET[2] + layer * height)))
        others = [item for item in self._boxes(scene) if item is not held]
        taken = [footprint(item) for item in others if scene.world.top(item.body) > base.z + height / 2.0]

        def is_free(frame: Pose) -> bool:
            place = Footprint.rectangle((width, length), frame)
            return all(place.gap(other) > 0.0 for other in taken)

        return [frame for frame in map(base.compose, places(layer, width, length)) if is_free(frame)]


def layer_yaw(layer: int) -> float:
    """Return the yaw (rad) of a layer's boxes against the pallet: their y axis is the long one."""
    return 0.0 if layer % 2 else math.pi / 2.0


def places(layer: int, width: float, length: float) -> list[Pose]:
    """Return the places of a layer's six boxes in the pallet's frame, on the layer's ground.

    :param width: of a box (m)
    :param length: of a box (m)
    """
    columns = [side * (length + BOX_SPACING) / 2.0 for side in (-1.0, 1.0)]
    rows = [side * (width + BOX_SPACING) for side in (-1.0, 0.0, 1.0)]
    grid = [(row, column) if layer % 2 else (column, row) for column in columns for row in rows]
    return [Pose.planar(*point, 0.0, layer_yaw(layer)) for point in grid]
