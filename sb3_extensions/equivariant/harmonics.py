"""Circular harmonics on the pixel grid of a filter.

A sampled harmonic of one frequency also responds to parts of an image with other frequencies, because
the grid only has rotations by 90 degrees. :func:`harmonic_basis` suppresses this response.
"""

import math
from functools import cache

import numpy as np
import numpy.typing as npt

Samples = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]

RING_WIDTH = 0.6
"""Standard deviation (pixels) of the radial profile of a ring, as in escnn."""
CORRELATION_LENGTH = 3.0
"""Correlation length (pixels) of the random images for which harmonics suppress other frequencies."""
PLANE_VARIANCE = 1e3
"""Variance of the constant and of the slope in the random images. Both are suppressed exactly."""
SUPPRESSION = 1e-5
"""Weight of the distance from the sampled ring relative to the response to other frequencies."""
GRID_ROTATIONS = 4
"""Number of rotations that map the pixel grid to itself."""
QUADRATURE_ANGLES = 64
"""Number of rotations that approximate the mean over all rotations, exact to rounding up to 15 pixels."""


@cache
def harmonic_basis(kernel_size: int, rotations: int) -> tuple[Samples, tuple[int, ...]]:
    """Return circular harmonics on Gaussian rings, sampled on the grid of a filter.

    Rings are one pixel apart. The ring of radius r carries the frequencies 0 to ``floor(r) + 1``. Each
    frequency above 0 has two functions, cosine and sine, next to each other.

    :param kernel_size: side of the filter, pixels
    :param rotations: number of rotations of the group. With 1, 2 and 4 every filter is exact on the grid, and
        the harmonics are sampled without suppression
    :return: samples (number of functions, kernel_size, kernel_size), each frequency's of unit energy, and
        the frequency of each cosine (or constant), in order
    """
    offsets = np.arange(kernel_size) - (kernel_size - 1) / 2
    positions: Complex = np.add.outer(offsets, 1j * offsets).ravel()  # row + i column
    parts: dict[int, Complex] = {}
    samples, frequencies = [], []
    for ring in np.unique(abs(positions.real)):
        profile = np.exp(-0.5 * ((abs(positions) - ring) / RING_WIDTH) ** 2)
        for frequency in range(int(ring) + 2 if ring > 0 else 1):
            wave = profile * _wave(positions, frequency)
            if GRID_ROTATIONS % rotations:
                if frequency not in parts:
                    parts[frequency] = _suppression(positions, frequency)
                wave = np.linalg.solve(parts[frequency], wave)
            pair = np.stack([wave.real, wave.imag][: 1 + (frequency > 0)])
            pair /= math.sqrt((pair**2).sum() / len(pair))
            samples.append(pair.reshape(-1, kernel_size, kernel_size))
            frequencies.append(frequency)
    return np.concatenate(samples), tuple(frequencies)


def _wave(positions: Complex, frequency: int) -> Complex:
    """Return the samples of exp(i frequency angle), 0 at the centre for frequencies above 0."""
    wave: Complex = np.exp(1j * frequency * np.angle(positions))
    return wave if frequency == 0 else np.where(abs(positions) > 0, wave, 0.0)


def _suppression(positions: Complex, frequency: int) -> Complex:
    """Return the matrix of the linear system that suppresses the response to other frequencies.

    The solution minimises the mean square response to the parts of isotropic Gaussian images with other
    frequencies, plus :data:`SUPPRESSION` times the squared distance from the sampled harmonic.
    """
    total = _covariance(positions, positions)
    own = np.zeros_like(total)
    for angle in np.arange(QUADRATURE_ANGLES) * (2 * np.pi / QUADRATURE_ANGLES):
        own += _covariance(positions, np.exp(1j * angle) * positions) * np.exp(1j * frequency * angle)
    matrix: Complex = np.eye(len(positions)) + (total - own / QUADRATURE_ANGLES) / SUPPRESSION
    return matrix


def _covariance(first: Complex, second: Complex) -> Complex:
    """Return the covariance of the random images between all pairs of two sets of positions."""
    squared = abs(np.subtract.outer(first, second)) ** 2
    plane = 1.0 + np.outer(first, second.conj()).real
    covariance: Complex = np.exp(-squared / (2 * CORRELATION_LENGTH**2)) + PLANE_VARIANCE * plane + 0j
    return covariance
