"""Creation of augmentations from their names, for arguments and YAML files."""

from collections.abc import Mapping
from functools import partial
from typing import Any

from sb3_extensions.common.components import make_components
from sb3_extensions.replay.augmentation import RAD, Augmentation, DrQ, Sequence
from sb3_extensions.replay.rotation import Rotation

AugmentationSpec = Augmentation | str | Mapping[str, Mapping[str, Any] | None] | None


def make_augmentation(spec: AugmentationSpec, action_sequence: str | None = None) -> Augmentation | None:
    """
    Create an augmentation from its specification.

    :param spec: an augmentation, None, a name (``"drq"``), or names with their arguments in the order of
        application (``{"rotation": {}, "rad": {"size": 64}}``)
    :param action_sequence: default ``action_sequence`` of a rotation
    :raises ValueError: if the specification is something else
    """
    if isinstance(spec, Augmentation):
        return spec
    rotation = partial(Rotation, action_sequence=action_sequence) if action_sequence else Rotation
    steps = make_components("augmentation", spec, {"rotation": rotation, "rad": RAD, "drq": DrQ})
    return Sequence(tuple(steps)) if len(steps) > 1 else next(iter(steps), None)
