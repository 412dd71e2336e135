"""The scene: its objects, predicates on them, and sampling of free poses."""

from bulletarm_gym.scene.scene import Scene, SceneObject, cached_by_pose
from bulletarm_gym.scene.slots import ObjectSlot, scaled, shaped

__all__ = ["ObjectSlot", "Scene", "SceneObject", "cached_by_pose", "scaled", "shaped"]
