"""How large an error of the step is, from three runs: Richardson extrapolation.

A signal that is computed with the step h errs by ``e(t) h^p`` and terms of higher order, where e
does not depend on h. Of runs with h, h/2 and h/4 the differences are then

    d1 = y_h - y_h/2   = e h^p (1 - 2^-p)
    d2 = y_h/2 - y_h/4 = d1 2^-p

so that their ratio shows the order p, and the error of the run at h is

    y_h - y_0 = d1 + d2 / (1 - 2^-p)

where y_0 is the limit of small steps. All of that rests on e: one function of time for all steps.
Where something jumps or bends between the points of the grid, where the signal is chaotic, where
the step does not resolve what happens, or where the differences are rounding, it is not, and the
ratio of the differences is not 2^p at every time. That is checked: on the whole, in parts of the
run one by one, and where the error is largest. A part counts where its differences are more than
``SMALL`` of the largest: smaller ones cannot be the largest error, which is what is estimated.

Where orders meet, such as the first of a held input and the second of straight lines, the error is
``a(t) h + b(t) h^2``, whose ratio is steady nowhere, and two differences determine both terms:

    y_h - y_0 = 2/3 d1 + 8/3 d2

Nothing is left to check that with, so it is no estimate. But where the differences shrink, the
error is within

    |y_h - y_0| <= |d1| + 3 |d2|

for all such a and b, for one order of 1 or more, and with a third of both to spare for terms of
higher order: c h^3 needs an eighth of itself.

What no three runs can show: an error that is the same in all of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from cosim.arrays import Vector
from cosim.theory.documents import StepError

STEADY: Final = 0.3  # by which an order may differ from a whole number, and over time
MOST_RESIDUAL: Final = 2.0**STEADY - 1.0  # of d1 - 2^p d2, over d1: the same in amplitudes
HIGHEST_ORDER: Final = 4
GROWN_ROUNDING: Final = 1e-8  # of the largest value: what grows with the number of steps
GROWTH: Final = -1.0 + STEADY  # orders below it: the differences grow at least as 1/h
PARTS: Final = 8  # of a run
SMALL: Final = 0.05  # part of the largest difference
FEWEST: Final = 2 * PARTS  # instants
COMMON: Final = 0.9  # of the instants with values: those where all runs have one
ROUNDING: Final = 1e3 * np.finfo(np.float64).eps  # of the largest value, over a run


@dataclass(frozen=True, slots=True)
class _Differences:
    """The two differences of three runs at instants ``t``, all of shape (N,)."""

    t: Vector
    first: Vector
    second: Vector

    def part(self, rows: slice) -> _Differences:
        return _Differences(self.t[rows], self.first[rows], self.second[rows])

    @property
    def parts(self) -> list[_Differences]:
        """The parts of the run."""
        ends = np.linspace(0, len(self.t), PARTS + 1).astype(int)
        return [self.part(slice(*ends[k : k + 2])) for k in range(PARTS)]

    @property
    def order(self) -> float:
        """The order by their root mean squares; infinite where the second is zero."""
        first = _rms(self.first)
        second = _rms(self.second)
        if first == 0.0 or second == 0.0:
            return math.inf if second == 0.0 else -math.inf
        return math.log2(first) - math.log2(second)  # no ratio that under- or overflows

    @property
    def bound(self) -> float:
        """What the error is within, of orders 1 and 2 together."""
        return float((np.abs(self.first) + 3.0 * np.abs(self.second)).max())

    def largest(self, factor: float) -> float:
        """Return the largest of the first, and of the second times a factor."""
        return max(float(np.abs(self.first).max()), factor * float(np.abs(self.second).max()))

    def error(self, p: int) -> Vector:
        """Return the error of the run at h, where its order is p."""
        error: Vector = self.first + self.second / (1.0 - 2.0**-p)
        return error

    def residual(self, p: int) -> Vector:
        """Return what the first differs from 2^p times the second."""
        residual: Vector = self.first - 2.0**p * self.second
        return residual


@np.errstate(over="ignore", invalid="ignore")  # of signals that leave all bounds
def step_error(t: Vector, coarse: Vector, half: Vector, quarter: Vector) -> StepError:
    """Estimate the error of a signal of the run with the step h.

    Parameters
    ----------
    t : Vector, shape (N,)
        Instants [s], the same for all.
    coarse, half, quarter : Vector, shape (N,)
        Its values in the runs with the steps h, h/2 and h/4; NaN where it has none.
    """
    runs = (coarse, half, quarter)
    have_value = np.array([np.isfinite(run) for run in runs])
    in_all = have_value.all(axis=0)
    most = int(have_value.sum(axis=1).max())
    if not most:
        return StepError(reason="it has no value")
    if int(in_all.sum()) < COMMON * most:
        return StepError(reason="it has values at other instants in the runs with finer steps")
    scale = max(float(np.abs(run[in_all]).max()) for run in runs)
    first = coarse[in_all] - half[in_all]
    second = half[in_all] - quarter[in_all]
    return _of_differences(_Differences(t[in_all], first, second), scale)


def _of_differences(differences: _Differences, scale: float) -> StepError:
    """Estimate the error by the differences; ``scale`` is the largest value of the signal."""
    largest = differences.largest(1.0)
    if largest == 0.0:
        return StepError(0.0, float(differences.t[0]), 0.0)
    if largest <= ROUNDING * scale:
        return _rounding(largest)
    if len(differences.t) < FEWEST:
        return StepError(
            reason=f"it has values at {len(differences.t)} instants; expected {FEWEST} to see "
            "whether the ratio of the differences is steady"
        )
    order = differences.order
    if order < GROWTH and largest <= GROWN_ROUNDING * scale:
        return _rounding(largest)
    shown = order if math.isfinite(order) else None
    last = _last(differences.parts[-1], scale)
    p = _whole(order)
    reason = _unsteady(differences, order, p)
    bound = differences.bound if order >= STEADY else None
    if reason:
        return StepError(last=last, order=shown, reason=reason, grows=order < GROWTH, bound=bound)
    error = differences.error(p)
    worst = int(np.abs(error).argmax())
    if abs(differences.residual(p)[worst]) > MOST_RESIDUAL * abs(differences.first[worst]):
        local = differences.part(slice(worst, worst + 1)).order
        reason = (
            f"the order is {order:.2f} on the whole, and {local:.2f} where the error is largest, "
            f"at t = {differences.t[worst]:g} s"
        )
        return StepError(last=last, order=order, reason=reason, bound=bound)
    return StepError(float(abs(error[worst])), float(differences.t[worst]), last, order)


def _rounding(largest: float) -> StepError:
    reason = f"the differences, {largest:.2g}, are at the level of rounding"
    # d1 = e h (1 - 2^-p) is half of the error where p = 1, and more of it where p is larger.
    return StepError(reason=reason, is_rounding=True, bound=2.0 * largest)


def _whole(order: float) -> int:
    """Return the whole number nearest to an order; 0: there is none that an order can be."""
    p = round(order) if math.isfinite(order) else 0
    return p if 1 <= p <= HIGHEST_ORDER else 0


def _unsteady(differences: _Differences, order: float, p: int) -> str:
    """Return why the ratio of the differences is not that of one order; empty where it is."""
    if order < GROWTH:
        first = _rms(differences.first)
        second = _rms(differences.second)
        return (
            f"the differences grow as the step is halved, from {first:.2g} to {second:.2g} rms: "
            "smaller steps make it worse"
        )
    if not p or abs(order - p) > STEADY:
        return (
            f"the observed order is {order:.2f}; expected a whole number from 1 on, within {STEADY}"
        )
    least = SMALL * differences.largest(2.0**p)
    for part in differences.parts:
        if part.largest(2.0**p) < least:
            continue
        if not _is_steady(part, p):
            return (
                f"the order is not steady: {order:.2f} on the whole, {_order_text(part, p)} from "
                f"t = {part.t[0]:g} s to {part.t[-1]:g} s"
            )
    return ""


def _is_steady(part: _Differences, p: int) -> bool:
    """Return whether the differences of a part have the order p, together and one by one."""
    return abs(part.order - p) <= STEADY and _rms(part.residual(p)) <= MOST_RESIDUAL * _rms(
        part.first
    )


def _order_text(part: _Differences, p: int) -> str:
    """Return what is found of a part that is not steady."""
    if abs(part.order - p) > STEADY:
        return f"{part.order:.2f}"
    return "differences of another course"


def _last(part: _Differences, scale: float) -> float | None:
    """Return the error at the last instant, if the last part of the run shows it."""
    p = _whole(part.order)
    if not p or part.largest(1.0) <= ROUNDING * scale or not _is_steady(part, p):
        return None
    allowed = MOST_RESIDUAL * max(abs(float(part.first[-1])), _rms(part.first))
    is_known = abs(float(part.residual(p)[-1])) <= allowed
    return float(part.error(p)[-1]) if is_known else None


def _rms(values: Vector) -> float:
    return float(np.sqrt(np.mean(values**2)))
