"""Framework for efficient robotic manipulation: contrastive learning, augmentation, demonstrations."""

from sb3_extensions.ferm.ferm import FERM
from sb3_extensions.ferm.policies import MultiInputPolicy

__all__ = ["FERM", "MultiInputPolicy"]
