"""How items stand to each other: the words that goals and experts are written in."""

import math
from collections.abc import Iterable, Sequence

from bulletarm_gym.footprint import Footprint
from bulletarm_gym.geometry import planar_distance
from bulletarm_gym.scene import Item, Scene

TOUCHING = 2e-3
"""Gap (m) up to which two items touch: what a collision leaves between them when they come to rest."""
UPRIGHT = math.pi / 9.0
"""Greatest tilt (rad) of what stands upright, as in the original BulletArm release."""


def touching(scene: Scene, first: Item, second: Item) -> bool:
    """Whether two items are in contact."""
    return scene.world.distance(first.body, second.body, TOUCHING) <= TOUCHING


def is_held(scene: Scene, item: Item) -> bool:
    """Whether the gripper holds an item."""
    return scene.robot.held is item.body


def is_empty(scene: Scene) -> bool:
    """Whether the gripper holds nothing."""
    return scene.robot.held is None


def at_rest(scene: Scene) -> bool:
    """Whether nothing moves."""
    return not scene.world.has_motion


def upright(item: Item) -> bool:
    """Whether an item stands as it was made to stand."""
    return item.pose.tilt < UPRIGHT


def on_ground(scene: Scene, item: Item) -> bool:
    """Whether an item touches the ground, level or not."""
    world = scene.world
    standing = (body for body in scene.surface.bodies if world.active[body.index])
    return any(world.distance(item.body, body, TOUCHING) <= TOUCHING for body in standing)


def on_site(scene: Scene, item: Item) -> bool:
    """Whether an item stands, all of it, on the level ground where structures are built."""
    footprint = Footprint.of(item.spec.mesh.vertices, item.pose)
    return abs(item.lowest - scene.surface.level) <= TOUCHING and scene.surface.fits_site(footprint)


def on_top(scene: Scene, bottom: Item, top: Item) -> bool:
    """Whether an item lies on another: higher by half its height, in contact, its middle over the other."""
    if top.pose.z - bottom.pose.z < min(bottom.spec.extents[2], top.spec.extents[2]) / 2.0:
        return False
    reach = max(*bottom.spec.extents[:2], *top.spec.extents[:2]) / 2.0
    beside = max(abs(top.pose.x - bottom.pose.x), abs(top.pose.y - bottom.pose.y))
    return beside <= reach and touching(scene, bottom, top)


def stacked(scene: Scene, items: Iterable[Item]) -> bool:
    """Whether items form one stack: the lowest on the ground, each of the others on the one before alone."""
    lowest, *others = sorted(items, key=lambda item: item.pose.z)
    chain = zip([lowest, *others], others, strict=False)
    return (
        not any(is_held(scene, item) for item in (lowest, *others))
        and on_ground(scene, lowest)
        and all(on_top(scene, below, item) and not on_ground(scene, item) for below, item in chain)
    )


def is_top(item: Item, pool: Sequence[Item]) -> bool:
    """Whether none of the items in the pool is above an item."""
    return not any(
        other.pose.z > item.pose.z
        and planar_distance(other.pose.position, item.pose.position) < min(item.spec.extents[:2])
        for other in pool
        if other is not item
    )
