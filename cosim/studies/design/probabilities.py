"""Points of the unit cube that samples are drawn at: a probability for each sampled key.

``random``
    Independent numbers, of a stream of their own for each key: neither more samples nor another
    key changes them.
``sobol``
    A scrambled Sobol sequence. More samples go on with it; another key changes it.
``saltelli``
    A Sobol sequence of n points in 2 d dimensions: its first d coordinates are the n rows of a
    matrix A, the others those of B. The points are the rows of A, then those of B, then those of
    AB_1, ..., AB_d: A with its i-th column from B. So twice as many are another design.
``latin-hypercube``
    One point in every n-th part of each axis. It is a design of n points: another number of them
    gives other points.

All points are inside of the cube, 0 < p < 1, as unbounded distributions are infinite at its faces.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from cosim.arrays import Matrix
from cosim.errors import UsageError, option
from cosim.studies.document.schema import SamplingMethod

_BITS: Final = 30  # of a point of a Sobol sequence
_SMALLEST: Final = 2.0**-54
MOST_DIMENSIONS: Final = 21_201  # of a Sobol sequence in scipy


def unit_points(method: SamplingMethod, keys: Sequence[str], samples: int, *, seed: int) -> Matrix:
    """Return the points of a design, shape (number of keys, number of points).

    Of ``saltelli`` there are (d + 2) times ``samples``, else as many as these.

    Raises
    ------
    UsageError
        If a Sobol sequence has not as many dimensions, or ``saltelli`` is of another number of
        samples than a power of two.
    """
    match method:
        case "random":
            points = np.empty((len(keys), samples))
            for row, key in zip(points, keys, strict=True):
                row[:] = _stream(key, samples, seed)
        case "latin-hypercube":
            from scipy.stats.qmc import LatinHypercube

            generator = np.random.default_rng(np.random.SeedSequence(seed))
            drawn = LatinHypercube(len(keys), rng=generator).random(samples)
            points = np.ascontiguousarray(drawn.T)
        case "sobol":
            points = _sobol(len(keys), samples, seed)
        case "saltelli":
            points = _saltelli(len(keys), samples, seed)
    return np.clip(points, _SMALLEST, 1.0 - 2 * _SMALLEST, out=points)


def _stream(key: str, samples: int, seed: int) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    sequence = np.random.SeedSequence(seed, spawn_key=tuple(key.encode()))
    return np.random.Generator(np.random.PCG64(sequence)).random(samples)


def _sobol(dimensions: int, samples: int, seed: int) -> Matrix:
    if dimensions > MOST_DIMENSIONS:
        raise UsageError(
            f"{option('sampling')}: a Sobol sequence has at most {MOST_DIMENSIONS} dimensions, "
            f"and the study has {dimensions}"
        )
    from scipy.stats.qmc import Sobol

    generator = np.random.default_rng(np.random.SeedSequence(seed))
    sequence = Sobol(dimensions, scramble=True, bits=_BITS, rng=generator)
    # The whole power of two, as a part of it has no balance that scipy would not warn of.
    points = sequence.random_base2((samples - 1).bit_length())[:samples]
    # It is a corner of its cell, and may be 0.
    rows = np.ascontiguousarray(points.T)
    rows += 2.0 ** -(_BITS + 1)
    return rows


def _saltelli(dimensions: int, samples: int, seed: int) -> Matrix:
    if samples & (samples - 1):
        below = 1 << (samples.bit_length() - 1)
        raise UsageError(
            f"{option('samples')}: expected a power of two for Saltelli's design, got {samples}; "
            f"nearest: {below} or {2 * below}"
        )
    sequence = _sobol(2 * dimensions, samples, seed)
    first = sequence[:dimensions]
    second = sequence[dimensions:]
    points = np.empty((dimensions, dimensions + 2, samples))
    points[:, 0] = first
    points[:, 1] = second
    for number in range(dimensions):
        points[:, number + 2] = first
        points[number, number + 2] = second[number]
    return points.reshape(dimensions, -1)
