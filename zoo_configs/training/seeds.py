"""Independent streams of environment seeds: an evaluation shows an agent no scene it was trained on."""

from __future__ import annotations

from enum import IntEnum

import numpy as np


class SeedStream(IntEnum):
    """What the environments of a stream are for; training itself uses the run's seed as it is."""

    EVALUATION = 1
    TEST = 2
    PRETRAINING = 3


def stream_seed(seed: int, stream: SeedStream, index: int = 0) -> int:
    """
    Seed of one stream of environments.

    :param seed: Seed of the run, at least 0
    :param stream: What the environments are for
    :param index: Which use of the stream, for example the time step of a periodic evaluation
    :return: A seed below 2**31
    """
    state = np.random.SeedSequence((seed, stream, index)).generate_state(1)
    return int(state[0]) % 2**31
