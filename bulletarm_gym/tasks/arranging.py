"""Arranging bottles in a tray."""

import math
from collections.abc import Iterator

import numpy as np

from bulletarm_gym.config import CLOSE_LOOP, OPEN_LOOP, WIDE, EnvConfig, TaskDefaults, TrayUse
from bulletarm_gym.control import GraspParams
from bulletarm_gym.experts.approach import RELEASE, place_pose
from bulletarm_gym.experts.waypoints import CLOSED, OPEN, Waypoint
from bulletarm_gym.geometry import Pose, planar_distance, wrap_angle
from bulletarm_gym.objects.bottles import BOTTLE_HEIGHT, BOTTLES, bottle
from bulletarm_gym.objects.containers import TRAY, TRAY_FLOOR, bottle_tray
from bulletarm_gym.scene import ObjectSlot, Scene, SceneObject, shaped
from bulletarm_gym.scene.predicates import at_rest, inside, is_empty, touching, upright
from bulletarm_gym.scene.sampling import place_apart
from bulletarm_gym.tasks.task import Task

MOST_BOTTLES = 6
"""As many as the paper's (Bottle Arrangement), and places in the tray."""
ROWS, COLUMNS = 2, 3
BOTTLE_SPACING = 0.024
"""Least gap (m) around a bottle at the start: the fingers have room at its neck."""
PICK_OFFSET = 0.025
"""How far (m) below its top a bottle of scale 1 is grasped: at its neck."""
PLACE_OFFSET = 0.002
"""Gap (m) between a bottle and the tray's floor at the release."""
OPENING = 0.05
"""Greatest distance (m) of the fingers: wider than any neck, and no neighbour is touched."""
QUARTER = math.pi / 2.0


class BottleArrangement(Task):
    """Put all bottles into a tray.

    Description: six (one to six) bottles of eight shapes, about 5 x 5 x 14 cm, stand on the ground beside a
    fixed tray, 24 x 16 x 5 cm.
    Randomisation: the shapes, the positions and yaws of bottles and tray.
    Success: all bottles stand upright in the tray; the gripper is empty and nothing moves.
    Validity: no bottle has fallen over.
    Expert: grasp a bottle at its neck, put it in the emptiest of the tray's six places.
    """

    defaults = TaskDefaults(
        num_objects=MOST_BOTTLES,
        max_steps=20,
        object_scale=0.8,
        allowed_objects=tuple(range(1, MOST_BOTTLES + 1)),
        tray=TrayUse((False,), "the bottles and their own tray do not fit into the tray"),
        level_ground="bottles fall over on a slope",
        close_loop={"max_steps": 240, "workspace": WIDE},
    )
    controls = (OPEN_LOOP, CLOSE_LOOP)
    site = TRAY[:2]

    @property
    def height(self) -> float:
        """Up to the middle of a bottle in the tray."""
        return TRAY_FLOOR + BOTTLE_HEIGHT * max(self.config.scales) / 2.0

    @property
    def grasp_params(self) -> GraspParams:
        """Bottles are grasped at their necks and released close to the tray, because they tip over."""
        depth = PICK_OFFSET * max(self.config.scales)
        return GraspParams(pick_offset=depth, place_offset=PLACE_OFFSET, opening=OPENING)

    def bodies(self, config: EnvConfig) -> list[ObjectSlot]:
        """Return the tray, and for each bottle all shapes in all sizes."""
        names = [f"bottle {number}" for number in range(config.num_objects)]
        bottles = [shaped(config, name, bottle, len(BOTTLES)) for name in names]
        return [ObjectSlot("tray", (bottle_tray("tray"),)), *bottles]

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        """Put the tray somewhere, and the bottles beside it."""
        spread = math.pi if self.config.random_orientation else 0.0
        scene["tray"].place(scene.surface.goal_site(self.site, rng, spread))
        place_apart(scene, rng, self._bottles(scene, absent=True), BOTTLE_SPACING)

    def evaluate(self, scene: Scene) -> dict[str, bool]:
        """Look whether all bottles are in the tray, and whether all is done."""
        facts = {
            "is_arranged": all(self._is_in_tray(scene, item) for item in self._bottles(scene)),
            "is_empty": is_empty(scene),
            "is_at_rest": at_rest(scene),
        }
        return {"success": all(facts.values()), **facts}

    def is_valid(self, scene: Scene) -> bool:
        """Whether all is inside the workspace and every bottle stands."""
        return super().is_valid(scene) and all(
            upright(item) for item in self._bottles(scene) if item is not scene.held
        )

    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        """Grasp the next bottle, or put it into the tray."""
        held, yaw = scene.held, scene["tray"].pose.yaw
        if held is not None:
            turn = wrap_angle(yaw - scene.robot.pose.yaw, QUARTER)
            spot = self._emptiest(scene, held)
            goal = place_pose(scene, held, spot.position, spot.z + RELEASE, turn)
            yield Waypoint(goal, CLOSED, finish=OPEN)
            return
        bottles = self._bottles(scene)
        item = next((item for item in bottles if not self._is_in_tray(scene, item)), bottles[0])
        x, y, _ = item.pose.position
        height = scene.world.top(item.body) - self.grasp_params.pick_offset
        yield Waypoint(Pose.planar(x, y, height, yaw), OPEN, finish=CLOSED)

    def _bottles(self, scene: Scene, absent: bool = False) -> list[SceneObject]:
        return [item for item in (scene.objects if absent else scene) if item is not scene["tray"]]

    def _is_in_tray(self, scene: Scene, item: SceneObject) -> bool:
        tray = scene["tray"]
        lies = inside(item, tray) and upright(item)
        return lies and item is not scene.held and touching(scene, tray, item)

    def _emptiest(self, scene: Scene, held: SceneObject) -> Pose:
        """Return the place farthest from all bottles but the held one, in the world, on the tray's floor."""
        others = [item.pose.position for item in self._bottles(scene) if item is not held]
        spots = [scene["tray"].pose.compose(place) for place in places()]
        return max(
            spots, key=lambda spot: min((planar_distance(spot.position, o) for o in others), default=0.0)
        )


def places() -> list[Pose]:
    """Return the places of bottles in the tray's frame, on its floor."""
    pitch = (TRAY[0] / COLUMNS, TRAY[1] / ROWS)
    columns = [pitch[0] * (column - (COLUMNS - 1) / 2.0) for column in range(COLUMNS)]
    rows = [pitch[1] * (row - (ROWS - 1) / 2.0) for row in range(ROWS)]
    return [Pose((x, y, TRAY_FLOOR)) for x in columns for y in rows]
