"""Framework for efficient robotic manipulation: contrastive learning, augmentation, demonstrations."""

from sb3_extensions.ferm.ferm import FERM as FERM
from sb3_extensions.ferm.policies import MultiInputPolicy as MultiInputPolicy
