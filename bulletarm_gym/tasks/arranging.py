"""Arranging bottles in a tray."""

import math
from collections.abc import Iterator

import numpy as np

from bulletarm_gym.config import CLOSE_LOOP, OPEN_LOOP, WIDE, EnvConfig, TaskDefaults, TrayUse
from bulletarm_gym.control import GraspParams
from bulletarm_gym.experts import CLOSED, OPEN, Waypoint
from bulletarm_gym.experts.approach import RELEASE, place_pose
from bulletarm_gym.geometry import Pose, planar_distance, wrap_angle
from bulletarm_gym.objects.bottles import BOTTLES, HEIGHT, TRAY, TRAY_FLOOR, bottle, bottle_tray
from bulletarm_gym.scene import ObjectSlot, Scene, SceneObject, shaped
from bulletarm_gym.scene.predicates import inside, loose_objects, success_at_rest, touching, upright
from bulletarm_gym.scene.sampling import goal_site, place_apart
from bulletarm_gym.tasks.task import Task

MAX_BOTTLES = 6
"""Largest number of bottles (paper, Bottle Arrangement), and number of positions in the tray."""
ROWS, COLUMNS = 2, 3
BOTTLE_SPACING = 0.024
"""Smallest gap (m) around a bottle at the start, for the fingers at its neck."""
PICK_OFFSET = 0.025
"""Depth (m) of a grasp below the top of a bottle of scale 1, at its neck."""
PLACE_OFFSET = 0.002
"""Gap (m) between a bottle and the tray's floor at the release."""
OPENING = 0.05
"""Largest distance (m) between the fingers, wider than any neck, to avoid the neighbours."""


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

    defaults = TaskDefaults(
        num_objects=MAX_BOTTLES,
        max_steps=20,
        object_scale=0.8,
        allowed_objects=tuple(range(1, MAX_BOTTLES + 1)),
        tray=TrayUse((False,), "the bottles and their own tray do not fit into the tray"),
        level_ground="bottles fall over on a slope",
        close_loop={"max_steps": 240, "workspace": WIDE},
    )
    controls = (OPEN_LOOP, CLOSE_LOOP)
    site = TRAY[:2]

    @property
    def height(self) -> float:
        """Height (m) of the middle of a bottle in the tray."""
        return TRAY_FLOOR + HEIGHT * max(self.config.scales) / 2.0

    @property
    def grasp_params(self) -> GraspParams:
        """Parameters of grasps at necks, and of releases close to the tray, because bottles tip over."""
        depth = PICK_OFFSET * max(self.config.scales)
        return GraspParams(pick_offset=depth, place_offset=PLACE_OFFSET, opening=OPENING)

    def bodies(self, config: EnvConfig) -> list[ObjectSlot]:
        """Return the tray, and the bottles with all shapes in all sizes."""
        names = [f"bottle {number}" for number in range(config.num_objects)]
        bottles = [shaped(config, name, bottle, len(BOTTLES)) for name in names]
        return [ObjectSlot("tray", (bottle_tray("tray"),)), *bottles]

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        """Place the tray, and the bottles next to it."""
        scene["tray"].place(goal_site(scene, rng, self.site))
        place_apart(scene, rng, self.grasped(scene), BOTTLE_SPACING)

    def evaluate(self, scene: Scene) -> dict[str, bool]:
        """Return whether all bottles are in the tray, the gripper is empty and nothing moves."""
        arranged = all(self._is_in_tray(scene, obj) for obj in loose_objects(scene))
        return success_at_rest(scene, is_arranged=arranged)

    def is_valid(self, scene: Scene) -> bool:
        """Return True if all objects are inside the workspace and every bottle is upright."""
        return super().is_valid(scene) and all(
            upright(obj) for obj in loose_objects(scene) if obj is not scene.held
        )

    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        """Grasp the next bottle, or release it in the tray."""
        held, yaw, bottles = scene.held, scene["tray"].pose.yaw, loose_objects(scene)
        if held is not None:
            rotation = wrap_angle(yaw - scene.robot.pose.yaw, math.pi / 2.0)
            spot = self._most_free(scene, [obj for obj in bottles if obj is not held])
            goal = place_pose(scene, held, spot.position, spot.z + RELEASE, rotation)
            yield Waypoint(goal, CLOSED, finish=OPEN)
            return
        obj = next((obj for obj in bottles if not self._is_in_tray(scene, obj)), bottles[0])
        x, y, _ = obj.pose.position
        height = scene.world.top(obj.body) - self.grasp_params.pick_offset
        yield Waypoint(Pose.planar(x, y, height, yaw), OPEN, finish=CLOSED)

    def _is_in_tray(self, scene: Scene, obj: SceneObject) -> bool:
        tray = scene["tray"]
        return inside(obj, tray) and upright(obj) and obj is not scene.held and touching(scene, tray, obj)

    def _most_free(self, scene: Scene, others: list[SceneObject]) -> Pose:
        """Return the position in the tray, in the world, with the largest distance to other bottles."""
        points = [obj.pose.position for obj in others]
        spots = [scene["tray"].pose.compose(position) for position in tray_positions()]
        return max(
            spots, key=lambda spot: min((planar_distance(spot.position, p) for p in points), default=0.0)
        )


def tray_positions() -> list[Pose]:
    """Return the positions of bottles on the tray's floor, in the tray's frame."""
    pitch = (TRAY[0] / COLUMNS, TRAY[1] / ROWS)
    columns = [pitch[0] * (column - (COLUMNS - 1) / 2.0) for column in range(COLUMNS)]
    rows = [pitch[1] * (row - (ROWS - 1) / 2.0) for row in range(ROWS)]
    return [Pose((x, y, TRAY_FLOOR)) for x in columns for y in rows]
