"""How items stand to each other: the words that goals and experts are written in."""

from bulletarm_gym.scene import Item, Scene

TOUCHING = 2e-3
"""Gap (m) up to which two items touch: what a collision leaves between them when they come to rest."""


def touching(scene: Scene, first: Item, second: Item) -> bool:
    """Whether two items are in contact."""
    return scene.world.distance(first.body, second.body, TOUCHING) <= TOUCHING


def is_held(scene: Scene, item: Item) -> bool:
    """Whether the gripper holds an item."""
    return scene.robot.held is item.body
