"""The internal model of a disturbance class, built from theta (Francis and Wonham; Davison).

A regulated output has no steady error under every disturbance of the class if the controller
holds, for each regulated output, a copy of the system that makes the class, driven by the error::

    w' = S(theta) w + b e,    S = diag(G_1', G_2', ...),    b = (c_1; c_2; ...)

with the families' generators G and output rows c (:mod:`cosim.theory.disturbances.families`). A
family is observable from its output, so that its transpose is controllable from the error. S is
affine in theta, for G is. Families without parameters whose G is nilpotent (constant, ramp,
polynomial) contain each other: of several the largest is kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from cosim.arrays import Matrix, Vector, frozen
from cosim.errors import AssumptionError
from cosim.theory.disturbances.families import Family


@dataclass(frozen=True, eq=False)
class ParameterBox:
    """An interval of every parameter: ``lower`` and ``upper``, shape ``(P,)``.

    Raises
    ------
    AssumptionError
        If they have not one size, are not finite, or a lower end is above its upper end.
    """

    lower: Vector
    upper: Vector

    def __post_init__(self) -> None:
        """Freeze and check the ends."""
        for name in ("lower", "upper"):
            ends = getattr(self, name)
            object.__setattr__(self, name, frozen(ends, 1))
        same = self.lower.shape == self.upper.shape
        if not same or not np.isfinite(self.upper - self.lower).all():
            raise AssumptionError(
                f"interval of theta: expected two finite ends for each parameter, got {self.text}"
            )
        if (self.lower > self.upper).any():
            raise AssumptionError(f"interval of theta: expected lower <= upper, got {self.text}")

    @property
    def center(self) -> Vector:
        """The middle of every interval."""
        return 0.5 * (self.lower + self.upper)

    @property
    def text(self) -> str:
        """The intervals, for messages: ``[1.5, 2.5]``."""
        lower_ends = self.lower.tolist()
        upper_ends = self.upper.tolist()
        pairs = zip(lower_ends, upper_ends, strict=False)
        intervals = [f"[{lower:.6g}, {upper:.6g}]" for lower, upper in pairs]
        return ", ".join(intervals)

    def scaled(self, factor: float) -> ParameterBox:
        """Return the box with the same center, ``factor`` times as wide."""
        width = factor * (self.upper - self.lower)
        half_width = 0.5 * width
        lower = self.center - half_width
        upper = self.center + half_width
        return ParameterBox(lower, upper)

    def halves(self, axis: int) -> tuple[ParameterBox, ParameterBox]:
        """Return both halves of the box, cut across the interval of a parameter."""
        below = self.upper.copy()
        above = self.lower.copy()
        below[axis] = self.center[axis]
        above[axis] = self.center[axis]
        first = ParameterBox(self.lower, below)
        return first, ParameterBox(above, self.upper)

    def grid(self, points: int) -> list[Vector]:
        """Return the points of a grid with so many on every side, the ends included."""
        axes = []
        for lower, upper in zip(self.lower, self.upper, strict=True):
            count = points if lower < upper else 1
            axis = np.linspace(lower, upper, count)
            axes.append(axis.tolist())
        return [np.array(point) for point in product(*axes)]


@dataclass(frozen=True, eq=False)
class InternalModel:
    """`w' = S(theta) w + b e` for every regulated output.

    Parameters
    ----------
    S0 : Matrix
        S at theta = 0 [1/s], shape ``(n_w, n_w)``.
    S1 : tuple of Matrix
        Its derivatives with respect to the P parameters, each of that shape.
    b : Matrix
        Shape ``(n_w, p)`` for p regulated outputs.
    """

    S0: Matrix
    S1: tuple[Matrix, ...]
    b: Matrix

    def __post_init__(self) -> None:
        """Freeze the matrices."""
        S0 = frozen(self.S0, 2)
        slopes = [frozen(slope, 2) for slope in self.S1]
        b = frozen(self.b, 2)
        object.__setattr__(self, "S0", S0)
        object.__setattr__(self, "S1", tuple(slopes))
        object.__setattr__(self, "b", b)

    def S(self, theta: Vector) -> Matrix:
        """Compute S [1/s], shape ``(n_w, n_w)``."""
        total = self.S0.copy()
        for value, slope in zip(theta, self.S1, strict=True):
            total += value * slope
        return total

    def in_units(self, units: Vector) -> InternalModel:
        """Return it with w in other units, shape ``(n_w,)``."""
        rows = units[:, np.newaxis]
        S0 = self.S0 * units / rows
        slopes = [slope * units / rows for slope in self.S1]
        b = self.b / rows
        return InternalModel(S0, tuple(slopes), b)


def internal_model(families: Sequence[Family], outputs: int) -> InternalModel:
    """Build the internal model of a disturbance class, a copy for each of so many outputs.

    Raises
    ------
    AssumptionError
        If there is no family.
    """
    if not families:
        raise AssumptionError("internal model: expected the families of the disturbance, got none")
    kept = _distinct(families)
    sizes = [family.v for family in kept]
    ends = np.cumsum(sizes)
    n = int(ends[-1])
    S0 = np.zeros((n, n))
    slopes = []
    for family, end in zip(kept, ends, strict=True):
        block = slice(end - family.v, end)
        zero = np.zeros(len(family.parameters))
        G0 = family.G(zero)
        S0[block, block] = G0.T
        for unit in np.eye(len(zero)):
            slope = np.zeros((n, n))
            of_unit = family.G(unit) - G0
            slope[block, block] = of_unit.T
            slopes.append(slope)
    rows = [family.c for family in kept]
    b = np.concatenate(rows)
    S0_of_all = _copied(S0, outputs)
    slopes_of_all = [_copied(slope, outputs) for slope in slopes]
    b_of_all = _copied(b[:, np.newaxis], outputs)
    return InternalModel(S0_of_all, tuple(slopes_of_all), b_of_all)


def _copied(block: Matrix, times: int) -> Matrix:
    """Return the matrix with so many copies of a block on its diagonal."""
    identity = np.eye(times)
    copies = np.kron(identity, block)
    return np.asarray(copies, np.float64)


def _distinct(families: Sequence[Family]) -> list[Family]:
    """Leave out the families without parameters that a larger one contains."""
    fixed = [family for family in families if not family.parameters]
    nilpotent = [family for family in fixed if _is_nilpotent(family)]
    largest = max(nilpotent, key=lambda family: family.v, default=None)
    kept = []
    for family in families:
        contained = family in nilpotent and family is not largest
        if not contained and not (family is largest and family in kept):
            kept.append(family)
    return kept


def _is_nilpotent(family: Family) -> bool:
    no_theta = np.zeros(0)
    G = family.G(no_theta)
    power = np.linalg.matrix_power(G, len(G))
    return not power.any()
