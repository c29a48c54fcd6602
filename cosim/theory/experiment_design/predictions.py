"""What estimators on the regression find: the root of their expected equation, and around it.

Least squares and the Rayleigh quotient rest on the sum of products of rows, S, alone. Its mean is
that of the rows without noise and of the noise; what the estimator makes of the mean is where the
estimates lie, which is not theta where the regression has noise in it or delta hat is not delta.
Around there they scatter with the covariance of

    least squares    delta eta   = -(E S_mm)^-1 sum m (m' eta - p),     theta = recover(eta)
    Rayleigh         delta theta = -H^-1 sum (c_k' M) (chi' M) / chi' N chi,
                     c_k = chi_k - (chi_k' N chi / chi' N chi) chi,

chi_k the derivatives of chi, and H that of the gradient of half the quotient by theta.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.errors import AssumptionError
from cosim.native.estimation.rayleigh import RayleighModel
from cosim.theory.disturbances.families import AlphaGroup, Family, generators, group_by_alpha
from cosim.theory.disturbances.regression import Term, check_delays, count_terms, expand
from cosim.theory.estimators.least_squares import RANK, plan, recover
from cosim.theory.estimators.rayleigh import rayleigh_constants
from cosim.theory.experiment_design.minors import Minors
from cosim.theory.experiment_design.reconstruction_noise import ReconstructionNoise
from cosim.theory.experiment_design.regression_noise import NoisyRegression

_DIFFERENCE: Final = 1e-5  # of numerical derivatives, relative to what they are by
_SAME: Final = 0.1  # of the predicted error: minima less apart are one


@dataclass(frozen=True, eq=False)
class PredictedEstimate:
    """Where estimates of theta lie, and how they scatter.

    Parameters
    ----------
    bias : Vector, shape (P,)
        Their mean less theta.
    covariance : Matrix, shape (P, P)
    """

    bias: Vector
    covariance: Matrix

    @property
    def standard_error(self) -> Vector:
        """Their deviation about their mean, shape (P,)."""
        variances = np.diag(self.covariance)
        return np.sqrt(np.maximum(variances, 0.0))

    @property
    def error(self) -> Vector:
        """The root mean square of their distance from theta, shape (P,)."""
        total: Vector = np.hypot(self.bias, self.standard_error)
        return total


@dataclass(frozen=True, eq=False)
class _Terms:
    """The terms of (25), and what follows from them alone."""

    terms: tuple[Term, ...]
    row: NDArray[np.integer]
    minors: Minors


@dataclass(frozen=True, eq=False, kw_only=True)
class RegressionExperiment:
    """A record of delta hat without noise, and what is known of it.

    Parameters
    ----------
    delta : Vector, shape (N,)
        Reconstructed without noise of y, at successive communication points; NaN: no value.
    alpha : Matrix, shape (N, components)
        The known factor of each component at the instants that delta belongs to, its lag before.
    names : tuple of str
        Of the alphas; components with equal ones share a group.
    families : sequence of Family
        Of the components.
    theta : Vector, shape (P,)
        The true one.
    step : float
        Between communication points [s].
    noise : ReconstructionNoise
        Of delta hat.
    settled : int
        Communication points from the first one on after which delta has no transient.
    start : int, optional
        The first point that counts, where it is given; by default one longest delay after that.
    is_held : bool
        Least squares weighs all rows alike, as it takes delta for held.
    """

    delta: Vector
    alpha: Matrix
    names: tuple[str, ...]
    families: Sequence[Family]
    theta: Vector
    step: float
    noise: ReconstructionNoise
    settled: int
    start: int | None = None
    is_held: bool = False

    def __post_init__(self) -> None:
        """Check the sizes."""
        shape = (len(self.delta), len(self.families))
        if self.alpha.shape != shape or len(self.names) != len(self.families):
            raise AssumptionError(
                f"alpha: expected shape {shape}, got {self.alpha.shape} and {len(self.names)} names"
            )
        needed = generators(self.families).parameters
        if self.theta.shape != (needed,):
            raise AssumptionError(f"theta: expected shape ({needed},), got {self.theta.shape}")

    @cached_property
    def groups(self) -> tuple[AlphaGroup, ...]:
        """The components by alpha."""
        return group_by_alpha(self.names, self.families)

    @cached_property
    def sizes(self) -> tuple[int, ...]:
        """The number of basis functions of each group."""
        return tuple(group.size for group in self.groups)

    @property
    def delays_needed(self) -> int:
        """l + 1."""
        return sum(self.sizes) + 1

    @cached_property
    def terms(self) -> _Terms:
        """The expansion of the determinant."""
        terms = expand(self.sizes)
        row = np.array([term.row for term in terms])
        minors = Minors(generators(self.families), self.groups, terms)
        return _Terms(terms, row, minors)

    def regression(self, steps: tuple[int, ...], *, block: int = 1) -> NoisyRegression:
        """Return the rows of the regression with delays of so many samples.

        Raises
        ------
        AssumptionError
            If the delays do not fit, or leave too few rows.
        """
        check_delays([steps_of * self.step for steps_of in steps], self.delays_needed)
        begin = self.settled + max(steps) if self.start is None else self.start
        if begin < max(steps):
            raise AssumptionError(
                f"start: expected at least the longest delay, {max(steps) * self.step:g} s, got "
                f"{begin * self.step:g} s"
            )
        rows = (len(self.delta) - begin) // block
        needed = 2 * count_terms(self.sizes)
        if rows < needed:
            raise AssumptionError(
                f"delays of up to {max(steps) * self.step:g} s: expected at least {needed} rows of "
                f"the regression, got {max(rows, 0)}"
            )
        delayed = [slice(begin - count, begin - count + rows * block) for count in steps]
        delta = np.array([self.delta[part] for part in delayed])
        if not np.isfinite(delta).all():
            raise AssumptionError("delta has no value at instants that the regression needs")
        return NoisyRegression(
            products=self._products(delayed),
            row=self.terms.row,
            delta=delta,
            steps=steps,
            block=block,
            noise=self.noise,
        )

    def least_squares(
        self, steps: tuple[int, ...], *, P0: float | None = None
    ) -> PredictedEstimate:
        """Predict least squares (33)-(35) with delays of so many samples.

        Raises
        ------
        AssumptionError
            If it has no theta.
            If the delays do not fit the record or the formulas (35).
        """
        delays = [count * self.step for count in steps]
        recovery = plan(self.terms.terms, self.groups, delays)
        regression = self._weighted(self.regression(steps))
        information = regression.moment
        if P0 is not None:
            information[1:, 1:] += np.eye(recovery.n_eta) / P0
        of_m = information[1:, 1:]
        if not _is_regular(of_m):
            raise AssumptionError("no estimate: the rows of the regression are dependent")
        inverse = np.linalg.inv(of_m)
        eta = -inverse @ information[1:, 0]
        theta = recover(recovery, eta)
        slopes = np.empty((len(theta), len(eta)))
        for k in range(len(eta)):
            ahead = eta.copy()
            behind = eta.copy()
            difference = _DIFFERENCE * max(1.0, abs(eta[k]))
            ahead[k] += difference
            behind[k] -= difference
            change = recover(recovery, ahead) - recover(recovery, behind)
            slopes[:, k] = change / (2.0 * difference)
        if not np.isfinite(slopes).all():
            raise AssumptionError(
                "no estimate: the coefficients of the regression belong to no theta"
            )
        d = np.hstack([np.zeros((len(theta), 1)), -slopes @ inverse])
        g = np.concatenate([[1.0], eta])
        return PredictedEstimate(theta - self.theta, regression.covariance(d, g))

    def rayleigh(self, steps: tuple[int, ...]) -> PredictedEstimate:
        """Predict the Rayleigh quotient with delays of so many samples.

        Its rows are means over half of the smallest difference of delays.

        Raises
        ------
        AssumptionError
            If it has no theta.
            If the delays do not fit the record, or the regression is too large.
        """
        gap = int(np.diff(np.sort(np.array(steps))).min())
        block = max(1, round(0.5 * gap))
        regression = self.regression(steps, block=block)
        delays = np.array(steps) * self.step
        span = (len(self.delta) - 1) * self.step
        constants = rayleigh_constants(
            self.families, self.groups, self.terms.terms, delays.tolist()
        )
        N = regression.unit_noise
        R = regression.triangle
        model = RayleighModel(constants)
        status, theta, _ = model.minimize(R, N, self.theta)
        if status != 0:
            raise AssumptionError("no estimate: the quotient has no minimum near theta")

        def gradient(point: Vector) -> tuple[Vector, Matrix, Vector]:
            chi, slopes = self.terms.minors.chi(point, delays)
            variance = chi @ N @ chi
            c = slopes - np.outer(slopes @ N @ chi / variance, chi)
            slope = (c @ R.T) @ (R @ chi)  # not c S chi: S chi may be nothing but rounding
            return slope / variance, c / variance, chi

        P = len(theta)
        H = np.empty((P, P))
        for k in range(P):
            difference = _DIFFERENCE * max(abs(theta[k]), 1.0 / span)
            offset = difference * np.eye(P)[k]
            change = gradient(theta + offset)[0] - gradient(theta - offset)[0]
            H[:, k] = change / (2.0 * difference)
        _, c, chi = gradient(theta)
        if not abs(np.linalg.det(H)) > 0.0:
            raise AssumptionError("no estimate: the minimum of the quotient is flat")
        d = np.asarray(-np.linalg.solve(H, c), np.float64)
        predicted = PredictedEstimate(theta - self.theta, regression.covariance(d, chi))
        beside = theta + predicted.standard_error
        _, again, _ = model.minimize(R, N, beside)
        apart = np.abs(again - theta)
        rounding = _DIFFERENCE * np.maximum(np.abs(theta), 1.0 / span)
        if not (apart <= _SAME * predicted.error + rounding).all():
            raise AssumptionError(
                "no estimate: the quotient has no single minimum within its standard error"
            )
        return predicted

    def _products(self, delayed: Sequence[slice]) -> Matrix:
        """Return the products of the alphas of every term, with its sign, shape (q + 1, N)."""
        of_groups = [self._alpha_rows[group.components[0]] for group in self.groups]
        products = []
        for term in self.terms.terms:
            product = np.full(delayed[0].stop - delayed[0].start, float(term.sign))
            for alpha, part in zip(of_groups, term.parts, strict=True):
                for row in part:
                    product *= alpha[delayed[row]]
            products.append(product)
        return np.array(products)

    @cached_property
    def _alpha_rows(self) -> Matrix:
        """The alphas, one component behind the other, shape (components, N)."""
        return np.ascontiguousarray(self.alpha.T)

    def _weighted(self, regression: NoisyRegression) -> NoisyRegression:
        """Return the rows times the roots of the weights of the integral (33)."""
        weights = np.full(regression.samples, self.step)
        weights[-1] *= 0.0 if self.is_held else 0.5
        weights[0] *= 1.0 if self.is_held else 0.5
        products = np.sqrt(weights) * regression.products
        return NoisyRegression(
            products=products,
            row=regression.row,
            delta=regression.delta,
            steps=regression.steps,
            block=1,
            noise=regression.noise,
        )


def _is_regular(information: Matrix) -> bool:
    """Return whether the run finds all pivots of the information to be beyond rounding."""
    try:
        pivots = np.diag(np.linalg.cholesky(information))
    except np.linalg.LinAlgError:
        return False
    return bool(pivots.min() > RANK * pivots.max())
