"""What a replay buffer says about its memory."""

from __future__ import annotations

import logging
import math

import psutil

logger = logging.getLogger(__name__)

GIGABYTE = 1e9  # bytes


def announce_size(n_rows: int, n_frames: int, n_bytes: int) -> None:
    """
    Log what the full buffer takes; warn if that is more than the free memory.

    :param n_rows: number of transitions that it can hold
    :param n_frames: number of observations that it can hold
    :param n_bytes: their size together
    """
    gigabytes, available = n_bytes / GIGABYTE, psutil.virtual_memory().available / GIGABYTE
    logger.info(
        "Replay buffer: %d transitions over %d frames, %.2f GB (%.2f GB available)",
        n_rows,
        n_frames,
        gigabytes,
        available,
    )
    if gigabytes > available:
        logger.warning("The full replay buffer will not fit: %.2f GB > %.2f GB", gigabytes, available)


def warn_of_short_episodes(n_kept: int, n_rows: int, needed: float) -> None:
    """
    Warn that transitions are dropped before the table is full.

    :param n_kept: number of transitions that are kept
    :param n_rows: number of transitions for which there is room
    :param needed: frames per transition, of the episodes up to now
    """
    logger.warning(
        "Replay buffer: %d transitions instead of %d are kept, because short episodes take more frames; "
        "the oldest are dropped from now on. The episodes up to now need frames_per_transition=%.2f; "
        "frames_per_transition=2 is always enough",
        n_kept,
        n_rows,
        math.ceil(100 * needed) / 100,
    )
