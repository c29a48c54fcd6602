"""Global search by differential evolution: generations of members that run together.

A generation is tried as one batch. The search has converged when all members of the population
stand close to each other; then a local search goes on from the best. That they agree does not prove
that there is nothing better elsewhere.

The tolerances of scipy are not used: they are relative to the mean objective, so that a large
constant in the objective ends the search at once, and an objective of zero never does.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.studies.tuning.local import LocalSearch
from cosim.studies.tuning.space import SearchSpace
from cosim.studies.tuning.trials import Trials

CLOSE: Final = 0.01  # of the range between the bounds
_PER_KEY: Final = 10  # members of a generation for every key
_GENERATIONS: Final = 10**6  # the trials end the search


def search_globally(space: SearchSpace, trials: Trials, local: LocalSearch, seed: int) -> None:
    """Search between all bounds, then locally from the best that was found.

    Raises
    ------
    SearchEnded
        If the trials have ended.
    """
    from scipy.optimize import differential_evolution

    def costs(population: Matrix) -> Vector:
        """Return the costs of a generation, shape (S,); its shape is (n, S)."""
        points = [space.point(column) for column in population.T]
        return np.array(trials.costs(points))

    def close_together(intermediate_result: Any) -> bool:
        spread = np.ptp(intermediate_result.population, axis=0)
        return bool((spread <= CLOSE).all())

    with np.errstate(invalid="ignore"):  # differences of infinite costs
        found = differential_evolution(
            costs,
            [(0.0, 1.0)] * len(space.bounded),
            popsize=_PER_KEY,
            maxiter=_GENERATIONS,
            tol=0.0,
            atol=-1.0,  # equal costs far from each other are no end
            polish=False,
            updating="deferred",
            vectorized=True,
            rng=np.random.default_rng(seed),
            callback=close_together,
        )
    if np.isfinite(found.fun):
        local.from_point(np.clip(found.x, 0.0, 1.0), CLOSE)
