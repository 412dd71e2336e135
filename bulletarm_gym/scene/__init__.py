"""The scene: its objects, predicates on them, and sampling of free poses."""

from bulletarm_gym.scene.scene import (
    ObjectSlot as ObjectSlot,
    Scene as Scene,
    SceneObject as SceneObject,
    cached_by_pose as cached_by_pose,
    scaled as scaled,
    shaped as shaped,
)
