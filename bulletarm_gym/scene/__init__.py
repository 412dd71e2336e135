"""The scene: its objects, predicates on them, and sampling of free poses."""

from bulletarm_gym.scene.scene import ObjectSlot, Scene, SceneObject, cached_by_pose, scaled, shaped

__all__ = ["ObjectSlot", "Scene", "SceneObject", "cached_by_pose", "scaled", "shaped"]
