"""What is needed to judge an identifier: its model, and where its data are."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from cosim.arrays import Mask, Matrix, Vector
from cosim.errors import AssumptionError, UsageError
from cosim.native.estimation.alphas import Alpha, AlphaSignal, signals_among
from cosim.native.numerics.programs import evaluate_at
from cosim.theory.covariance import is_covariance
from cosim.theory.disturbances.families import Family
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant
from cosim.theory.estimators.output_error import OutputErrorProblem

# (lower, upper) of each theta, or of some by their index
ThetaBounds: TypeAlias = Sequence[Sequence[float]] | Mapping[int, tuple[float, float]]


@dataclass(frozen=True, eq=False, kw_only=True)
class IdentifiedPlant:
    """The model of an identifier, and the observer whose inputs y and u are its data.

    Parameters
    ----------
    observer, regressor : str
    plant : DisturbedPlant
    families : sequence of Family
        Of the components of the disturbance.
    alphas : sequence of Alpha
        The known factor of each; signals are recorded as the input ``alpha`` of the regressor.
    check_alphas : callable
        Checks what only the run computes of them: takes instants ``(N,)`` and their values
        ``(N, components)``, and raises AssumptionError.
    offset : bool
        A constant on every output is unknown.
    bounds : mapping of index to (lower, upper)
        Of theta.
    problem : str
        Why nothing can be said of the estimates; empty: nothing stands against it.
    stated : Matrix, shape (n_y, n_y), or None
        Covariance of the noise of y; None: it is not known.
    has_offset_key : bool
        The table of the identifier has a key for ``offset``.
    irregular : float or None
        Bound of an irregular part of the disturbance that intervals are guaranteed for.
    closed_loop : bool
        All of u was computed from y.
    window : float
        Length of the moving window that the estimates rest on [s]; infinite: all samples.
    forgetting : float
        Time constant in which samples lose their weight [s]; infinite: they keep it.
    """

    observer: str
    regressor: str
    plant: DisturbedPlant
    families: Sequence[Family]
    alphas: Sequence[Alpha]
    check_alphas: Callable[[Vector, Matrix], None]
    offset: bool
    bounds: Mapping[int, tuple[float, float]]
    problem: str = ""
    stated: Matrix | None = None
    has_offset_key: bool = False
    irregular: float | None = None
    closed_loop: bool = False
    window: float = np.inf
    forgetting: float = np.inf

    @property
    def extent(self) -> str:
        """What the verdicts of a run rest on, where that are not simply all samples."""
        if np.isfinite(self.window):
            return f"verdicts and intervals are those of the last {self.window:g} s, the window"
        if np.isfinite(self.forgetting):
            return (
                "verdicts and intervals weigh all samples equally; theta itself forgets them "
                f"with a time constant of {self.forgetting:g} s"
            )
        return ""

    @property
    def parameters(self) -> int:
        """The number of theta."""
        return sum(len(family.parameters) for family in self.families)

    @property
    def limits(self) -> tuple[Vector, Vector]:
        """The bounds of theta as vectors, infinite where there is none, shape (P,)."""
        lower = np.full(self.parameters, -np.inf)
        upper = np.full(self.parameters, np.inf)
        for j, (low, high) in self.bounds.items():
            lower[j] = low
            upper[j] = high
        return lower, upper

    def alpha(self, t: Vector) -> Matrix:
        """Return the known factors at any instants ``(N,)`` [s], shape ``(N, components)``.

        Raises
        ------
        AssumptionError
            If one is a signal, which is known of the run alone.
        """
        for signal in signals_among(self.alphas):
            raise AssumptionError(f"alpha {signal.text!r} is a signal, known only during the run")
        return self.alpha_at(t, t, np.zeros((len(t), 0)))

    def alpha_at(self, t: Vector, points: Vector, signals: Matrix) -> Matrix:
        """Return the known factors at instants, those that are signals by interpolation.

        Parameters
        ----------
        t : Vector, shape (N,)
        points : Vector, shape (K,)
            Instants of the signals.
        signals : Matrix, shape (K, signals)
        """
        columns = []
        for alpha in self.alphas:
            if isinstance(alpha, AlphaSignal):
                columns.append(np.interp(t, points, signals[:, alpha.element]))
            else:
                columns.append(evaluate_at([alpha], t)[:, 0])
        return np.ascontiguousarray(np.array(columns).T)

    def problem_of(self, data: Sequence[DataSet]) -> OutputErrorProblem:
        """Return what output error is to explain."""
        return OutputErrorProblem(
            data, self.plant, self.families, self.stated, self.offset, self.bounds
        )

    def data_set(
        self,
        t: Vector,
        y: Matrix,
        u: Matrix,
        held: Mask,
        in_feedback: Mask,
        signals: Matrix,
        samples: SampleRows | None = None,
    ) -> DataSet:
        """Return what the observer took in as the data of output error.

        Parameters
        ----------
        t : Vector, shape (N,)
        y : Matrix, shape (N, n_y)
        u : Matrix, shape (N, n_u)
        held : Mask, shape (n_u,)
            Which of u had a zero-order hold.
        in_feedback : Mask, shape (n_u,)
            Which of u depend on y.
        signals : Matrix, shape (N, signals)
            Those among the alphas.
        samples : SampleRows, optional
            What counts in the place of y.

        Raises
        ------
        AssumptionError
            If the alphas, as they were recorded, do not determine the regression.
        """
        points = t
        if samples is not None:
            t, y, u = samples.beside(t, u, held, y.shape[1])
        alpha = self.alpha_at(t, points, signals)
        self.check_alphas(t, alpha)
        return DataSet(t, y, u, alpha, held, np.isin(t, points), in_feedback | self.closed_loop)


@dataclass(frozen=True, eq=False)
class SampleRows:
    """Samples of y, as signals have them: NaN where there is none.

    Parameters
    ----------
    t : Vector, shape (K,)
        Communication points.
    times : Matrix, shape (K, m)
        Of the samples since the one before; NaN beside a sample: it is of the communication point.
    values : Matrix, shape (K, n_y m)
        Those of one output behind those of another.
    """

    t: Vector
    times: Matrix
    values: Matrix

    def beside(
        self, points: Vector, u: Matrix, held: Mask, outputs: int
    ) -> tuple[Vector, Matrix, Matrix]:
        """Return t, y and u at the samples and at the communication points.

        Inputs and alphas go on from point to point, whatever is measured; at a point without a
        sample y is NaN.
        """
        times, values = self.flat(outputs)
        t = np.union1d(times, points)
        y = np.full((len(t), outputs), np.nan)
        y[np.searchsorted(t, times)] = values
        before = np.searchsorted(points, t, side="right") - 1
        columns = []
        for column, is_held in zip(u.T, held, strict=True):
            columns.append(column[before] if is_held else np.interp(t, points, column))
        return t, y, np.array(columns).T.reshape(len(t), u.shape[1])

    def flat(self, outputs: int) -> tuple[Vector, Matrix]:
        """Return the times and values of the samples, shapes (N,) and (N, n_y)."""
        by_output = self.values.reshape(len(self.t), outputs, -1)
        values = by_output.transpose(0, 2, 1)
        times = np.where(np.isnan(self.times), self.t[:, np.newaxis], self.times)
        is_there = np.isfinite(values).any(axis=2)
        return times[is_there], values[is_there]


def bounds_of(rows: object, parameters: int) -> dict[int, tuple[float, float]]:
    """Return bounds of theta by index.

    Parameters
    ----------
    rows : object
        ``[lower, upper]`` for each theta, or by the index of some.
    parameters : int
        Number of theta.

    Raises
    ------
    UsageError
        If they are not that.
    """
    if isinstance(rows, Mapping):
        unknown = [j for j in rows if j not in range(parameters)]
        if unknown:
            raise UsageError(f"bounds: no theta[{unknown[0]}]; there are {parameters} parameters")
        return {int(j): _bounds_of_one(row, j) for j, row in rows.items()}
    if not isinstance(rows, Sequence) or isinstance(rows, str) or len(rows) != parameters:
        raise UsageError(
            f"bounds: expected [lower, upper] for each of the {parameters} parameters, inf where "
            f"there is none, such as [[-1, 0], [-inf, inf]], got {rows}"
        )
    return {j: _bounds_of_one(row, j) for j, row in enumerate(rows)}


def _bounds_of_one(row: object, j: int) -> tuple[float, float]:
    if not isinstance(row, list | tuple) or len(row) != 2 or not all(map(_is_number, row)):
        raise UsageError(
            f"bounds of theta[{j}]: expected two numbers, [lower, upper], inf where there is "
            f"none, such as [-1, inf], got {row}"
        )
    lower, upper = map(float, row)
    if not lower <= upper or lower == np.inf or upper == -np.inf:
        raise UsageError(
            f"bounds of theta[{j}]: expected lower <= upper with numbers between them, -inf or "
            f"inf where there is no bound, got [{lower:g}, {upper:g}]"
        )
    return lower, upper


def _is_number(value: object) -> bool:
    """Return whether a value is one of a double: not NaN, nor an integer that is too large."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return abs(value) <= sys.float_info.max or abs(value) == math.inf


def stated_covariance(
    deviation: float | Sequence[float] | None,
    covariance: Sequence[Sequence[float]] | None,
    outputs: int,
) -> Matrix | None:
    """Return the covariance of the noise of y, shape (n_y, n_y); None: nothing is stated.

    Raises
    ------
    UsageError
        If both are given, or they are no deviations or covariance of so many outputs.
    """
    if deviation is not None and covariance is not None:
        raise UsageError("expected at most one of deviation and covariance, got both")
    if deviation is not None:
        deviations = np.array(deviation, np.float64)
        if deviations.ndim and deviations.shape != (outputs,):
            raise UsageError(
                f"deviation: expected one number, or one per output ({outputs}), got "
                f"{deviations.size}"
            )
        if not ((deviations > 0.0) & (deviations < np.inf)).all():
            raise UsageError(f"deviation: expected positive finite numbers, got {deviation}")
        return np.diag(np.broadcast_to(deviations, outputs) ** 2)
    if covariance is None:
        return None
    if any(len(row) != outputs for row in covariance) or len(covariance) != outputs:
        raise UsageError(
            f"covariance: expected {outputs} rows of {outputs} numbers, got "
            f"{[list(row) for row in covariance]}"
        )
    matrix = np.array(covariance, np.float64)
    if not is_covariance(matrix):
        raise UsageError(
            f"covariance: expected a symmetric positive definite matrix, got {matrix.tolist()}"
        )
    return matrix
