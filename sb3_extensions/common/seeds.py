"""Seeds of the independent random streams of an algorithm."""

from __future__ import annotations

from enum import IntEnum

import numpy as np


class SeedKey(IntEnum):
    """What a stream is for; environments have the algorithm's seed and those after it."""

    AUGMENTATION = 0xA6
    EXPERT = 0xE9
    EXPLORATION = 0xE8


def derive_seed(seed: int, key: SeedKey) -> int:
    """
    Seed of one stream.

    :param seed: seed of the algorithm
    :param key: which stream
    :return: 32 bits
    """
    return int(np.random.SeedSequence([seed, key]).generate_state(1)[0])
