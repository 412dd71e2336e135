"""Supervising Covid tests."""

import math
from collections.abc import Iterator, Sequence

import numpy as np

from bulletarm_gym.config import CLOSE_LOOP, OPEN_LOOP, WIDE, EnvConfig, ParameterError, TaskDefaults
from bulletarm_gym.control import GraspParams
from bulletarm_gym.experts import CLOSED, OPEN, Waypoint
from bulletarm_gym.experts.approach import RELEASE, place_pose
from bulletarm_gym.geometry import Pose, wrap_angle
from bulletarm_gym.objects import containers
from bulletarm_gym.scene import ObjectSlot, Scene, SceneObject, scaled
from bulletarm_gym.scene.predicates import inside, is_empty, loose_objects, success_at_rest
from bulletarm_gym.scene.sampling import goal_site, random_yaw
from bulletarm_gym.tasks.task import Task

ROUNDS = 3
"""Number of tests in an episode (paper, Covid Test)."""
SIDE = 0.3
"""Side (m) of the square that the three containers fill."""
TUBES_APART, TUBE_ROW = containers.NEW_TUBE_BOX[0] / 3.3, containers.NEW_TUBE_BOX[1] / 4.0
"""Distance (m) between tubes along x, and their y (m), in the frame of their box."""
SWABS_APART, SWAB_ROW = containers.NEW_TUBE_BOX[0] / 3.7, -containers.NEW_TUBE_BOX[1] / 9.0
"""Distance (m) between swabs along x, and their y (m), in the frame of their box."""
SPREAD = math.radians(30.0)
"""Largest absolute yaw of tubes and of swabs."""
MAX_SCALE = 0.858
"""Largest scale at which swabs and tubes of any yaw do not overlap in their box."""
USER_REACH = (0.0125, 0.1)
"""Largest distances (m) along x and y of a used tube from the centre of the test area."""
GRASP_DEPTH = 0.008
"""Depth (m) of grasps below the tops of swabs and tubes."""
AWAY = 0.05
"""Height (m) of the fingertips above the test area from which the user can test."""
FINGER_GAP = 0.0075
"""Gap (m) between an object and each open finger, because a swab may lie close to a tube."""
OPENING = 0.04
"""Largest distance (m) between the fingers, for the narrow gap between two tubes."""
QUARTER = math.pi / 2.0
CONTAINERS = {
    "new box": (containers.new_tube_box, containers.NEW_TUBE_BOX, (-1.0, 1.0)),
    "test area": (containers.test_area, containers.TEST_AREA, (1.0, 0.0)),
    "used box": (containers.used_tube_box, containers.USED_TUBE_BOX, (-1.0, -1.0)),
}
"""Function, side lengths (m) and corner of the square, in x and y, of each container."""
KINDS = {"swab": containers.swab, "tube": containers.tube, "used tube": containers.used_tube}
TARGETS = {
    "swab": ("test area", (0.0, 0.07), QUARTER),
    "tube": ("test area", (0.0, -0.05), QUARTER),
    "used tube": ("used box", (0.0, 0.0), 0.0),
}
"""Container, position (m) and yaw (rad) in it at which the expert releases each kind of object."""


class CovidTest(Task):
    """Present pairs of a swab and a tube to be tested, and collect the used tubes.

    Description: three containers side by side: a box with three new swabs, 7 x 1 x 1 cm, and three new tubes,
    8 x 1.7 x 1.7 cm, a test area and a box for used tubes. As soon as a swab and a tube are in the test area
    and the gripper is empty and 5 cm above, a simulated user replaces them by one used tube.
    Randomisation: the pose of the three containers together, and whether they are mirrored; the yaws of the
    swabs and of the tubes, within 30 degrees; the pose of a used tube. With ``random_orientation=False`` all
    objects lie along y.
    Success: all used tubes are in their box; the gripper is empty and nothing moves.
    Validity: at most one tube, used or not, and at most one swab are in the test area.
    Expert: repeat until solved: move a swab, then a tube to the test area, then the used tube to its box.
    """

    instructions = (
        "Move a swab and a tube to the test area three times, and collect the used tubes.",
        "Present three pairs of a swab and a tube, and put each used tube into the box for used tubes.",
    )
    defaults = TaskDefaults(
        num_objects=2 * ROUNDS,
        max_steps=30,
        object_scale=containers.COVID_SCALE,
        allowed_objects=(2 * ROUNDS,),
        no_tray="the three places do not fit into the tray",
        level_ground="the three places need 30 x 30 cm of level ground",
        close_loop={"max_steps": 300, "workspace": WIDE},
    )
    controls = (OPEN_LOOP, CLOSE_LOOP)
    site = (SIDE, SIDE)

    @property
    def grasp_params(self) -> GraspParams:
        return GraspParams(pick_offset=GRASP_DEPTH, opening=OPENING)

    def bodies(self, config: EnvConfig) -> list[ObjectSlot]:
        if max(config.scales) > MAX_SCALE:
            takes = f"sizes up to {MAX_SCALE}: larger swabs and tubes overlap in their box"
            raise ParameterError.of("object_scale_range", config.object_scale_range, takes)
        containers = [ObjectSlot(name, (make(name),)) for name, (make, _, _) in CONTAINERS.items()]
        return containers + [
            scaled(config, f"{kind} {number}", make, kind)
            for kind, make in KINDS.items()
            for number in range(ROUNDS)
        ]

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        site = goal_site(scene, rng, self.site)
        mirror = float(rng.choice((-1.0, 1.0)))
        for name, (_, size, (right, up)) in CONTAINERS.items():
            x, y = ((SIDE - extent) / 2.0 for extent in size[:2])
            scene[name].place(site.compose(Pose((mirror * right * x, up * y, 0.0))))
        for kind, pitch, row in (("tube", TUBES_APART, TUBE_ROW), ("swab", SWABS_APART, SWAB_ROW)):
            yaw = -QUARTER + random_yaw(scene, rng, SPREAD)
            for number in range(ROUNDS):
                x = (number - (ROUNDS - 1) / 2.0) * pitch
                self._lay(scene, f"{kind} {number}", "new box", (x, row), yaw)

    def _lay(self, scene: Scene, name: str, container: str, point: Sequence[float], yaw: float) -> None:
        """Place an object on the floor of a container, at a pose in its frame."""
        height = containers.BOX_FLOOR - float(scene[name].spec.mesh.bounds[0, 2])
        pose = Pose.planar(point[0], point[1], height, yaw)
        scene[name].place(scene[container].pose.compose(pose))

    def after_action(self, scene: Scene, rng: np.random.Generator) -> None:
        swabs, tubes = (self._inside(scene, kind, "test area") for kind in ("swab", "tube"))
        away = scene.robot.pose.z > scene["test area"].pose.z + AWAY
        if not (len(swabs) == len(tubes) == 1 and is_empty(scene) and away):
            return
        swabs[0].park()
        tubes[0].park()
        number = len(self._of_kind(scene, "used tube"))
        point = [float(rng.uniform(-reach, reach)) for reach in USER_REACH]
        yaw = random_yaw(scene, rng, math.pi) if self.config.random_orientation else QUARTER
        self._lay(scene, f"used tube {number}", "test area", point, yaw)

    def evaluate(self, scene: Scene) -> dict[str, bool]:
        collected = len(self._inside(scene, "used tube", "used box")) == ROUNDS
        return success_at_rest(scene, is_collected=collected)

    def parts(self, scene: Scene, rng: np.random.Generator) -> tuple[int, int]:
        tested = len(self._of_kind(scene, "used tube"))  # by two moves each
        placed = sum(len(self._inside(scene, kind, name)) for kind, (name, _, _) in TARGETS.items())
        return 2 * tested + placed, len(TARGETS) * ROUNDS

    def is_valid(self, scene: Scene) -> bool:
        swabs, tubes, used = (len(self._inside(scene, kind, "test area")) for kind in KINDS)
        return super().is_valid(scene) and swabs <= 1 and tubes + used <= 1

    def plan(self, scene: Scene, rng: np.random.Generator) -> Iterator[Waypoint]:
        held = scene.held
        if held is None:
            yield self._pick(scene, self._next(scene))
            return
        kind = held.slot.kind
        name, spot, yaw = TARGETS[kind]
        container = scene[name].pose
        rotation = wrap_angle(container.yaw + yaw - held.pose.yaw, math.pi)
        point = container.transform((*spot, containers.BOX_FLOOR))
        top = max((scene.world.top(obj.body) for obj in self._inside(scene, kind, name)), default=point[2])
        yield Waypoint(place_pose(scene, held, point, top + RELEASE, rotation), CLOSED, finish=OPEN)

    def _next(self, scene: Scene) -> SceneObject:
        """Return the object to grasp: a used tube, a swab or a tube outside its container."""
        has_swab = bool(self._inside(scene, "swab", "test area"))
        for kind in ("used tube", "tube" if has_swab else "swab"):
            there = self._inside(scene, kind, TARGETS[kind][0])
            missing = [obj for obj in self._of_kind(scene, kind) if obj not in there]
            if missing:
                return missing[0]
        return max(loose_objects(scene), key=lambda obj: obj.pose.z)

    def _pick(self, scene: Scene, obj: SceneObject) -> Waypoint:
        x, y, _ = obj.pose.position
        height = max(float(obj.bounds[1, 2]) - GRASP_DEPTH, obj.lowest + RELEASE)
        opening = (obj.spec.extents[1] + 2.0 * FINGER_GAP) / scene.robot.model.gripper.stroke
        pose = Pose.planar(x, y, height, obj.pose.yaw + QUARTER)  # across the object's length
        return Waypoint(pose, min(opening, OPEN), finish=CLOSED)

    def _of_kind(self, scene: Scene, kind: str) -> list[SceneObject]:
        return [obj for obj in scene if obj.slot.kind == kind]

    def _inside(self, scene: Scene, kind: str, container: str) -> list[SceneObject]:
        """Return the objects of a kind in a container, except the grasped one."""
        objects = (obj for obj in self._of_kind(scene, kind) if obj is not scene.held)
        return [obj for obj in objects if inside(obj, scene[container])]
