"""Supervising Covid tests."""

import itertools
import math
from collections.abc import Iterator, Sequence

import numpy as np

from bulletarm_gym.config import CLOSE_LOOP, OPEN_LOOP, WIDE, EnvConfig, ParameterError, TaskDefaults, TrayUse
from bulletarm_gym.control import GraspParams
from bulletarm_gym.experts.approach import RELEASE, place_pose
from bulletarm_gym.experts.waypoints import CLOSED, OPEN, Waypoint
from bulletarm_gym.geometry import Footprint, Pose, wrap_angle
from bulletarm_gym.objects.bottles import COVID_SCALE, swab, tube, used_tube
from bulletarm_gym.objects.containers import (
    BOX_FLOOR,
    NEW_TUBE_BOX,
    TEST_AREA,
    USED_TUBE_BOX,
    new_tube_box,
    test_area,
    used_tube_box,
)
from bulletarm_gym.scene import ObjectSlot, Scene, SceneObject, scaled
from bulletarm_gym.scene.predicates import at_rest, inside, is_empty
from bulletarm_gym.simulation import BodySpec
from bulletarm_gym.surfaces.surface import Point
from bulletarm_gym.tasks.task import Task

ROUNDS = 3
"""Tests an episode (paper, Covid Test)."""
SIDE = 0.3
"""Of the square (m) that the three places fill."""
TUBES_APART, TUBE_ROW = NEW_TUBE_BOX[0] / 3.3, NEW_TUBE_BOX[1] / 4.0
SWABS_APART, SWAB_ROW = NEW_TUBE_BOX[0] / 3.7, -NEW_TUBE_BOX[1] / 9.0
"""Where tubes and swabs lie in the box (m)."""
SPREAD = math.radians(30.0)
"""Greatest yaw of tubes and of swabs either way."""
USER_REACH = (0.0125, 0.1)
"""How far (m) from the middle of the test area the user leaves a used tube."""
SWAB_SPOT, TUBE_SPOT = (0.0, 0.07), (0.0, -0.05)
"""Where in the test area (m) the expert puts a swab and a tube."""
GRASP_DEPTH = 0.008
"""How far (m) below their tops swabs and tubes are grasped."""
AWAY = 0.05
"""Height (m) of the fingertips over the test area from which the user has room."""
FINGER_GAP = 0.0075
"""Gap (m) between an item and each open finger: a swab may lie close to a tube."""
OPENING = 0.04
"""Greatest distance (m) of the fingers: between two tubes there is not much room."""
QUARTER = math.pi / 2.0
PLACE_SIZES = {"new box": NEW_TUBE_BOX, "test area": TEST_AREA, "used box": USED_TUBE_BOX}


class CovidTest(Task):
    """Present pairs of a swab and a tube to be tested, and collect the used tubes.

    Description: three places side by side: a box with three new swabs, 7 x 1 x 1 cm, and three new tubes,
    8 x 1.7 x 1.7 cm, a test area and a box for used tubes. A user stands by: as soon as a swab and a tube are
    in the test area and the gripper is empty and 5 cm above, they become one used tube somewhere in it.
    Randomisation: the pose of the three places together, and whether they are mirrored; the yaws of the
    swabs and of the tubes, within 30 degrees; where the user leaves a tube, at any yaw. With
    ``random_orientation=False`` all lies along y.
    Success: all used tubes are in their box; the gripper is empty and nothing moves.
    Validity: at most one tube, used or not, and at most one swab are in the test area.
    Expert: a swab, then a tube to the test area, the used tube to its box; and so on.
    """

    defaults = TaskDefaults(
        num_objects=2 * ROUNDS,
        max_steps=30,
        object_scale=COVID_SCALE,
        allowed_objects=(2 * ROUNDS,),
        tray=TrayUse((False,), "the three places do not fit into the tray"),
        level_ground="the three places need 30 x 30 cm of level ground",
        close_loop={"max_steps": 300, "workspace": WIDE},
    )
    controls = (OPEN_LOOP, CLOSE_LOOP)
    site = (SIDE, SIDE)

    @property
    def grasp_params(self) -> GraspParams:
        """What is grasped is thin and lies close together."""
        return GraspParams(pick_offset=GRASP_DEPTH, opening=OPENING)

    def bodies(self, config: EnvConfig) -> list[ObjectSlot]:
        """Return the places, swabs, tubes, and the used tubes that they become.

        :raises ParameterError: swabs and tubes are too large to lie beside each other in their box
        """
        check_gaps(config)
        makers = {"new box": new_tube_box, "test area": test_area, "used box": used_tube_box}
        places = [ObjectSlot(name, (make(name),)) for name, make in makers.items()]
        kinds = {"swab": swab, "tube": tube, "used tube": used_tube}
        return places + [
            scaled(config, f"{kind} {number}", make, kind)
            for kind, make in kinds.items()
            for number in range(ROUNDS)
        ]

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        """Lay the three places side by side, and swabs and tubes in the first."""
        turns = self.config.random_orientation
        site = scene.surface.goal_site(self.site, rng, math.pi if turns else 0.0)
        mirror = float(rng.choice((-1.0, 1.0)))
        corners = {"new box": (-1.0, 1.0), "test area": (1.0, 0.0), "used box": (-1.0, -1.0)}
        for name, (right, up) in corners.items():
            x, y = ((SIDE - extent) / 2.0 for extent in PLACE_SIZES[name][:2])
            scene[name].place(site.compose(Pose((mirror * right * x, up * y, 0.0))))
        rows = (("tube", TUBES_APART, TUBE_ROW), ("swab", SWABS_APART, SWAB_ROW))
        for kind, pitch, row in rows:
            yaw = -QUARTER + (float(rng.uniform(-SPREAD, SPREAD)) if turns else 0.0)
            for number, point in enumerate(row_points(pitch, row)):
                self._lay(scene, f"{kind} {number}", "new box", point, yaw)

    def _lay(self, scene: Scene, name: str, place: str, point: Sequence[float], yaw: float) -> None:
        """Lay an item on the floor of a place, at a point (m) and a yaw (rad) in its frame."""
        height = BOX_FLOOR - float(scene[name].spec.mesh.bounds[0, 2])
        pose = Pose.planar(point[0], point[1], height, yaw)
        scene[name].place(scene[place].pose.compose(pose))

    def after_action(self, scene: Scene, rng: np.random.Generator) -> None:
        """Let the user test: a swab and a tube in the test area become a used tube."""
        swabs, tubes = (self._inside(scene, kind, "test area") for kind in ("swab", "tube"))
        away = scene.robot.pose.z > scene["test area"].pose.z + AWAY
        if not (len(swabs) == len(tubes) == 1 and is_empty(scene) and away):
            return
        swabs[0].park()
        tubes[0].park()
        number = len(self._items(scene, "used tube"))
        point = [float(rng.uniform(-reach, reach)) for reach in USER_REACH]
        yaw = float(rng.uniform(-math.pi, math.pi)) if self.config.random_orientation else QUARTER
        self._lay(scene, f"used tube {number}", "test area", point, yaw)

    def evaluate(self, scene: Scene) -> dict[str, bool]:
        """Look whether all used tubes are collected, and whether all is done."""
        facts = {
            "is_collected": len(self._inside(scene, "used tube", "used box")) == ROUNDS,
            "is_empty": is_empty(scene),
            "is_at_rest": at_rest(scene),
        }
        return {"success": all(facts.values()), **facts}

    def is_valid(self, scene: Scene) -> bool:
        """Whether all is inside the workspace, and the test area holds one tube and one swab at most."""
        swabs, tubes, used = (
            len(self._inside(scene, kind, "test area")) for kind in ("swab", "tube", "used tube")
        )
        return super().is_valid(scene) and swabs <= 1 and tubes + used <= 1

    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        """Bring the next item where it belongs."""
        held = scene.held
        if held is None:
            yield self._pick(scene, self._next(scene))
            return
        kind = held.slot.kind
        name, spot, along = {
            "swab": ("test area", SWAB_SPOT, QUARTER),
            "tube": ("test area", TUBE_SPOT, QUARTER),
            "used tube": ("used box", (0.0, 0.0), 0.0),
        }[kind]
        place = scene[name].pose
        turn = wrap_angle(place.yaw + along - held.pose.yaw, math.pi)
        point = place.transform((*spot, BOX_FLOOR))
        top = max((scene.world.top(item.body) for item in self._inside(scene, kind, name)), default=point[2])
        yield Waypoint(place_pose(scene, held, point, top + RELEASE, turn), CLOSED, finish=OPEN)

    def _next(self, scene: Scene) -> SceneObject:
        """Return what to grasp: a used tube, else a swab, else a tube that is not where it belongs."""
        has_swab = bool(self._inside(scene, "swab", "test area"))
        wanted = [("used tube", "used box"), ("tube" if has_swab else "swab", "test area")]
        for kind, place in wanted:
            there = self._inside(scene, kind, place)
            missing = [item for item in self._items(scene, kind) if item not in there]
            if missing:
                return missing[0]
        return max((item for item in scene if item.spec.mass > 0.0), key=lambda item: item.pose.z)

    def _pick(self, scene: Scene, item: SceneObject) -> Waypoint:
        """Return the pick of an item across its length."""
        x, y, _ = item.pose.position
        depth = max(float(item.bounds[1, 2]) - GRASP_DEPTH, item.lowest + RELEASE)
        opening = (item.spec.extents[1] + 2.0 * FINGER_GAP) / scene.robot.model.gripper.stroke
        pose = Pose.planar(x, y, depth, item.pose.yaw + QUARTER)
        return Waypoint(pose, min(opening, OPEN), finish=CLOSED)

    def _items(self, scene: Scene, kind: str) -> list[SceneObject]:
        return [item for item in scene if item.slot.kind == kind]

    def _inside(self, scene: Scene, kind: str, place: str) -> list[SceneObject]:
        """Return the items of a kind that lie in a place, seen from above, the held one aside."""
        items = (item for item in self._items(scene, kind) if item is not scene.held)
        return [item for item in items if inside(item, scene[place])]


def row_points(pitch: float, row: float) -> list[Point]:
    """Return where (m) the items of a kind lie in the box of new ones, in its frame."""
    return [((number - (ROUNDS - 1) / 2.0) * pitch, row) for number in range(ROUNDS)]


def check_gaps(config: EnvConfig) -> None:
    """Check that no swab touches a tube in the box, and none its neighbour, however both are turned.

    :raises ParameterError: they are too large
    """
    scale, spread = max(config.scales), SPREAD if config.random_orientation else 0.0
    yaws = [-QUARTER + share * spread for share in (-1.0, 0.0, 1.0)]

    def rows(body: BodySpec, points: Sequence[Point]) -> list[list[Footprint]]:
        vertices = body.mesh.vertices
        return [[Footprint.of(vertices, Pose.planar(*point, 0.0, yaw)) for point in points] for yaw in yaws]

    swabs = rows(swab("swab", scale), row_points(SWABS_APART, SWAB_ROW))
    tubes = rows(tube("tube", scale), row_points(TUBES_APART, TUBE_ROW))
    for some, others in itertools.product(swabs, tubes):
        if any(first.gap(second) <= 0.0 for first, second in itertools.combinations([*some, *others], 2)):
            takes = "smaller ones: in their box swabs and tubes would overlap"
            raise ParameterError.of("object_scale_range", config.object_scale_range, takes)
