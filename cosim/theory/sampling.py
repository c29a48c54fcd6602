"""The instants of samples: at equal distances, or at some that differ."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Vector
from cosim.errors import AssumptionError

EQUAL_STEPS: Final = 1e-9  # relative difference of two steps that still counts as none
DIGITS: Final = 12  # decimals of a step [s] that the rounding of times does not reach


def equal_step(t: Vector) -> float:
    """Return the one step [s] between instants ``t`` [s], without the rounding of these.

    Raises
    ------
    AssumptionError
        If there are fewer than two instants, or their distances differ.
    """
    if len(t) < 2:
        raise AssumptionError(f"expected two or more samples, at equal distances, got {len(t)}")
    steps = np.diff(t)
    usual = float(np.median(steps))
    deviations = np.abs(steps - usual)
    worst = int(deviations.argmax())
    rounding = 4.0 * np.finfo(np.float64).eps * float(np.abs(t).max())
    if not deviations[worst] <= EQUAL_STEPS * usual + rounding:
        raise AssumptionError(
            f"expected equally spaced samples: the one after t = {t[worst]:g} s comes "
            f"{steps[worst]:.6g} s later, half of them at most {usual:.6g} s"
        )
    return round(float(t[-1] - t[0]) / (len(t) - 1), DIGITS)


def distinct_steps(t: Vector) -> tuple[Vector, NDArray[np.integer]]:
    """Return the steps [s] that differ, and which of them ends at each instant, shape (N,).

    Steps that differ by rounding of the times are one. To the first instant none leads: 0.
    """
    if len(t) < 2:
        return np.ones(1), np.zeros(len(t), np.int32)
    distances = np.round(np.diff(t), DIGITS)
    steps, index = np.unique(distances, return_inverse=True)
    with_first = np.concatenate([[0], index.ravel()])
    return steps, with_first.astype(np.int32)
