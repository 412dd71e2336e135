"""Seeds of the independent random streams of an algorithm."""

from enum import IntEnum

import numpy as np


class SeedKey(IntEnum):
    """Purpose of a random stream. Environments have the algorithm's seed and the following ones."""

    AUGMENTATION = 0xA6
    EXPERT = 0xE9
    EXPLORATION = 0xE8


def derive_seed(seed: int, key: SeedKey) -> int:
    """Return the seed, 32 bits, of a random stream of an algorithm with a seed."""
    return int(np.random.SeedSequence([seed, key]).generate_state(1)[0])
