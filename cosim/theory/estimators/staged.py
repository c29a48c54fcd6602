"""Output error in stages: a start that needs no guess, and whether a fit is the best there is.

From a start, or from where the Rayleigh quotient of the regression (25) is smallest on a grid:

1. minimize the quotient,
2. improve theta by variable projection on delta,
3. fit y by output error.

A minimum of the last stage may be a local one: its own residual cannot tell, as a wrong model would
leave one of the same size. So every estimate is held against the fits from all other starts there
are, that of the quotient and the best points of a grid on y itself
(:mod:`cosim.theory.estimators.start_grid`): only where none of them leaves less is it the optimum.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.errors import AssumptionError
from cosim.native.estimation import RayleighConstants
from cosim.theory.disturbance import Family, generators
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant, sample_plant, white_noise
from cosim.theory.estimators.output_error import OutputErrorFit, fit_output_error
from cosim.theory.estimators.projection import project
from cosim.theory.estimators.rayleigh import rayleigh
from cosim.theory.estimators.start_grid import search_starts, start_grid

STARTS = 4  # points of the grid on y that are fitted from


@dataclass(frozen=True, eq=False, kw_only=True)
class Reconstruction:
    """What an observer and a regressor made of y.

    Parameters
    ----------
    mu : Matrix, shape (rows, q + 1)
        Rows of the regression, or means of them.
    N : Matrix, shape (q + 1, q + 1)
        Their noise covariance, see :func:`~cosim.theory.estimators.rayleigh.noise_covariance`.
    rayleigh : RayleighConstants
    delta : Vector, shape (N,)
        At the times of y; NaN: no value.
    modes, row : Matrix (m, m), Vector (m,)
        The observer's own dynamics, and how they enter delta.
    """

    mu: Matrix
    N: Matrix
    rayleigh: RayleighConstants
    delta: Vector
    modes: Matrix
    row: Vector


@dataclass(frozen=True, eq=False)
class StagedEstimate:
    """A fit, and whether it is the best one that is known.

    Parameters
    ----------
    fit : OutputErrorFit
    is_optimum : bool
        It converged, and from no start that was searched a fit leaves a smaller residual.
    """

    fit: OutputErrorFit
    is_optimum: bool


class StagedEstimator:
    """Estimates theta in stages, from a start or from none.

    Parameters
    ----------
    data : DataSet
        Of y.
    plant : DisturbedPlant
    families : sequence of Family
    reconstruction : Reconstruction
    offset : bool
        An unknown constant is on every output.
    average : int
        Samples of y that make one row of the grid's regression.
    """

    def __init__(
        self,
        data: DataSet,
        plant: DisturbedPlant,
        families: Sequence[Family],
        reconstruction: Reconstruction,
        *,
        offset: bool = False,
        average: int = 1,
    ) -> None:
        self._data = data
        self._plant = plant
        self._families = tuple(families)
        self._reconstruction = reconstruction
        self._offset = offset
        self._average = average

    def estimate(self, theta: Vector | None = None) -> StagedEstimate:
        """Estimate theta.

        Parameters
        ----------
        theta : Vector, shape (P,), optional
            Where to start; by default theta is searched.

        Raises
        ------
        AssumptionError
            If there are fewer samples than unknowns, or no start has a finite response.
        """
        best = self._best
        fit = best if theta is None else self._fit(self._improved(theta))
        # less than one variance apart they are the same minimum, or as good
        is_best = _squares(fit) <= _squares(best) + best.deviation**2
        return StagedEstimate(fit, fit.converged and is_best)

    @cached_property
    def _best(self) -> OutputErrorFit:
        """The best fit from all starts."""
        starts = list(self._starts_on_y())
        with suppress(AssumptionError):  # the alphas vanish: y alone decides
            starts.append(self._improved(None))
        fits = [self._fit(start) for start in starts]
        converged = [fit for fit in fits if fit.converged]
        return min(converged or fits, key=_squares)

    def _improved(self, theta: Vector | None) -> Vector:
        """Return theta after the quotient, and after delta where that converges."""
        given = self._reconstruction
        found = rayleigh(given.rayleigh, given.mu, given.N, theta=theta).theta
        fit = project(
            self._data.t,
            given.delta,
            self._data.alpha,
            self._families,
            found,
            A=given.modes,
            c=given.row,
        )
        return fit.theta if fit.converged else found

    def _starts_on_y(self) -> Matrix:
        data = self._data
        sampled = sample_plant(
            self._plant,
            generators(self._families),
            data,
            noise=white_noise(data.y.shape[1]),
            offset=self._offset,
        )
        box = self._reconstruction.rayleigh
        grid = start_grid(
            sampled.model.constants,
            box.lower,
            box.upper,
            points=box.points,
            average=self._average,
        )
        return search_starts(grid, sampled.record(data), most=STARTS)

    def _fit(self, theta: Vector) -> OutputErrorFit:
        return fit_output_error(
            [self._data], self._plant, self._families, theta, offset=self._offset
        )


def _squares(fit: OutputErrorFit) -> float:
    return float(np.square(fit.deviation)) * fit.freedom
