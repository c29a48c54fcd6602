"""Local searches without derivatives, from several starts.

Two methods of :func:`scipy.optimize.minimize`, in coordinates from 0 to 1:

* COBYQA [1]_, the default, fits quadratic models in a trust region. To the same accuracy it needs a
  half to a third of the members of Nelder-Mead on smooth objectives, and finds an optimum at a
  bound. The rms of a residual is minimized as its square: near a good fit that is the smooth one.
  Where a member fails, the model sees the worst cost so far: no infinity.
* Nelder-Mead compares costs only: for objectives with kinks, or where many members fail.

Powell's method needed more members than both and ended far from the optimum beside failures.

One start is searched after the other, one member at a time: scipy holds a lock while COBYQA runs,
so that several cannot go on side by side. Nothing here depends on how many members there may be:
with more of them a search goes on as it began.

References
----------
.. [1] T. M. Ragonneau, Z. Zhang, "An optimal interpolation set for model-based derivative-free
   optimization methods", Optimization Methods and Software, 2024.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, TypeAlias

import numpy as np

from cosim.arrays import Vector
from cosim.studies.tuning.space import SearchSpace
from cosim.studies.tuning.trials import Trials

PointCost: TypeAlias = Callable[[Vector], float]
LocalMethod: TypeAlias = Literal["cobyqa", "nelder-mead"]

TOLERANCE: Final = 1e-5  # of the range between the bounds
FIRST_RADIUS: Final = 0.1  # of the range between the bounds
MOST_FAILING_STARTS: Final = 10  # tried for each start
_ENDLESS: Final = 10**6  # evaluations; the trials end the search


@dataclass(frozen=True, slots=True)
class SearchEnd:
    """Where a search from one start ended.

    Parameters
    ----------
    start, point : mapping of key to value
    cost : float
        At ``point``.
    converged : bool
    reason : str
        Why it ended.
    """

    start: Mapping[str, Any]
    point: Mapping[str, Any]
    cost: float
    converged: bool
    reason: str


@dataclass(frozen=True, slots=True)
class LocalSearch:
    """A local search of one tuning.

    Parameters
    ----------
    space : SearchSpace
        All keys have bounds.
    trials : Trials
    method : {"cobyqa", "nelder-mead"}
    squared : bool
        The costs are not negative, and their squares are smoother.
    ends : list of SearchEnd
        Of the searches that have ended so far.
    """

    space: SearchSpace
    trials: Trials
    method: LocalMethod
    squared: bool
    ends: list[SearchEnd]

    def from_starts(self, first: Vector, count: int, seed: int) -> None:
        """Search from a start, and from more that are spread between the bounds.

        Raises
        ------
        SearchEnded
            If the trials have ended.
        """
        if math.isfinite(self._costs([first])[0]):
            self.from_point(first, FIRST_RADIUS)
        for start in self._more_starts(count - 1, seed):
            self.from_point(start, FIRST_RADIUS)

    def from_point(self, start: Vector, radius: float) -> None:
        """Search from one point, with a first radius of its own."""
        cost = _ShapedCost(lambda point: self._costs([point])[0], squared=self.squared)
        minimize = _METHODS[self.method]
        # of infinite costs Nelder-Mead takes the difference
        with np.errstate(invalid="ignore", over="ignore"):
            converged, reason = minimize(cost, start, radius)
        point = self.space.point(cost.best_at)
        origin = self.space.point(start)
        self.ends.append(SearchEnd(origin, point, cost.best, converged, reason))

    def _more_starts(self, count: int, seed: int) -> list[Vector]:
        """Return starts of a Sobol sequence whose members do not fail."""
        from scipy.stats import qmc

        sequence = qmc.Sobol(len(self.space.bounded), rng=np.random.default_rng(seed))
        starts: list[Vector] = []
        drawn: list[Vector] = []
        for _ in range(MOST_FAILING_STARTS if count else 0):
            number = 1 << (count - 1).bit_length()  # a sequence is balanced in powers of two
            missing = count - len(starts)
            if len(drawn) < missing:
                drawn += list(sequence.random(number))
            points = drawn[:missing]
            drawn = drawn[missing:]  # those left out would lie in one half of the first axis
            costs = self._costs(points)
            for point, cost in zip(points, costs, strict=True):
                if math.isfinite(cost):
                    starts.append(point)
            if len(starts) == count:
                break
        return starts

    def _costs(self, coordinates: Sequence[Vector]) -> list[float]:
        return self.trials.costs([self.space.point(each) for each in coordinates])


class _ShapedCost:
    """The cost as an optimizer sees it: squared, divided by the first one, and with what it found.

    Parameters
    ----------
    ask : callable
        The cost; +inf where a member failed.
    squared : bool
    """

    def __init__(self, ask: PointCost, *, squared: bool) -> None:
        self._ask = ask
        self._squared = squared
        self._scale = 0.0
        self._worst = 0.0
        self.best = math.inf
        self.best_at: Vector = np.empty(0)

    def __call__(self, coordinates: Vector) -> float:
        """Return the cost at coordinates, shape (n,); +inf where the member failed."""
        inside = np.clip(coordinates, 0.0, 1.0)  # beyond a bound by rounding
        cost = self._ask(inside)
        if cost < self.best or not self.best_at.size:
            self.best = cost
            self.best_at = inside
        if not math.isfinite(cost):
            return math.inf
        if self._scale == 0.0:
            self._scale = abs(cost)
        shaped = cost / self._scale if self._scale > 0.0 else cost
        return shaped * shaped if self._squared else shaped

    def finite(self, coordinates: Vector) -> float:
        """Return the cost, or the worst one so far where the member failed."""
        cost = self(coordinates)
        if math.isfinite(cost):
            self._worst = max(self._worst, cost)
            return cost
        return self._worst


def _cobyqa(cost: _ShapedCost, start: Vector, radius: float) -> tuple[bool, str]:
    from scipy.optimize import minimize

    options = {
        "initial_tr_radius": max(radius, TOLERANCE),
        "final_tr_radius": TOLERANCE,
        "maxfev": _ENDLESS,
        "maxiter": _ENDLESS,
    }
    bounds = [(0.0, 1.0)] * start.size
    try:
        found = minimize(cost.finite, start, method="COBYQA", bounds=bounds, options=options)
    except np.linalg.LinAlgError as error:
        return False, f"COBYQA stopped: {error}"
    if not found.success:
        return False, f"COBYQA stopped: {found.message}"
    return True, f"COBYQA converged: trust region {TOLERANCE:g} of the bounds"


def _nelder_mead(cost: _ShapedCost, start: Vector, radius: float) -> tuple[bool, str]:
    from scipy.optimize import minimize

    # away from the nearer bound: a corner that is clipped would make the simplex flat
    steps = np.where(start < 0.5, radius, -radius)
    options = {
        "initial_simplex": np.vstack([start, start + np.diag(steps)]),
        "xatol": TOLERANCE,
        "fatol": math.inf,
        "maxfev": _ENDLESS,
        "maxiter": _ENDLESS,
    }
    bounds = [(0.0, 1.0)] * start.size
    minimize(cost, start, method="Nelder-Mead", bounds=bounds, options=options)
    return True, f"Nelder-Mead converged: simplex {TOLERANCE:g} of the bounds"


_METHODS: Final[dict[str, Callable[[_ShapedCost, Vector, float], tuple[bool, str]]]] = {
    "cobyqa": _cobyqa,
    "nelder-mead": _nelder_mead,
}
