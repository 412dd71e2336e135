"""Independent streams of seeds, so that evaluation scenes differ from training scenes."""

from enum import IntEnum

import numpy as np


class SeedStream(IntEnum):
    """Purpose of a stream. Training itself uses the run's seed."""

    EVALUATION = 1
    TEST = 2
    PRETRAINING = 3
    SAMPLER = 4


def stream_seed(seed: int, stream: SeedStream, index: int = 0) -> int:
    """
    Return a seed below 2**31 of a stream.

    :param seed: Seed of the run, at least 0
    :param index: Index in the stream, for example the time step of a periodic evaluation
    """
    state = np.random.SeedSequence((seed, stream, index)).generate_state(1)
    return int(state[0]) % 2**31
