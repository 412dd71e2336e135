"""Creation of augmentations from their names, for arguments and YAML files."""

from collections.abc import Mapping
from typing import Any

from sb3_extensions.common.components import make_component
from sb3_extensions.replay.augmentation import RAD, Augmentation, DrQ, Sequence
from sb3_extensions.replay.rotation import Rotation

AUGMENTATIONS: dict[str, type[Augmentation]] = {"rotation": Rotation, "rad": RAD, "drq": DrQ}

AugmentationSpec = Augmentation | str | Mapping[str, Mapping[str, Any] | None] | None


def make_augmentation(spec: AugmentationSpec, action_sequence: str | None = None) -> Augmentation | None:
    """
    Create an augmentation from its specification.

    :param spec: an augmentation, None, a name (``"drq"``), or names with their arguments in the order of
        application (``{"rotation": {}, "rad": {"size": 64}}``)
    :param action_sequence: default ``action_sequence`` of a rotation
    :raises ValueError: if the specification is something else
    """
    if isinstance(spec, Augmentation) or spec is None:
        return spec
    named = {spec: None} if isinstance(spec, str) else spec
    if not isinstance(named, Mapping) or not named:
        raise ValueError(f"augmentation must be None, a name, or names with arguments, got {spec!r}")
    steps = []
    for name, arguments in named.items():
        default = {"action_sequence": action_sequence} if name == "rotation" and action_sequence else {}
        step = make_component("augmentation", {name: {**default, **(arguments or {})}}, AUGMENTATIONS)
        steps += [] if step is None else [step]
    return steps[0] if len(steps) == 1 else Sequence(tuple(steps))
