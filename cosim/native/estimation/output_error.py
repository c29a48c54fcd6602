"""The kernel that estimates theta by output error, or by variable projection."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from ctypes import POINTER, byref, c_double, c_int32, c_int64, c_void_p
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Mask, Matrix, Vector
from cosim.errors import AssumptionError
from cosim.native.library import declare, int32, library, pointer

MOST_COLUMNS: Final = 48  # COSIM_MOST_COLUMNS
MOST_PARAMETERS: Final = 16  # COSIM_MOST_PARAMETERS
MOST_ITERATIONS: Final = 120

NO_INFORMATION: Final = 1  # COSIM_NO_VALUE
NOT_CONVERGED: Final = 4  # COSIM_NOT_CONVERGED


class ParameterState(IntEnum):
    """What became of a parameter in a fit."""

    ESTIMATED = 0
    FIXED = 1  # its bounds are equal
    ABSENT = 2  # noise alone explains its component
    DEPENDENT = 3  # other parameters have the same effect
    AT_BOUND = 4


class OutputErrorStruct(ctypes.Structure):
    """cosim_output_error."""

    _fields_ = (
        *((name, c_int32) for name in ("states", "outputs", "components", "sources")),
        *((name, c_int32) for name in ("offset", "ar", "average")),
        *((name, c_void_p) for name in ("size", "count", "source", "c", "G0", "G1")),
        *((name, c_void_p) for name in ("step", "Ad", "B0", "B1", "K", "L")),
        *((name, c_void_p) for name in ("C", "D", "W", "a", "every")),
        ("forgetting", c_double),
    )


class RecordStruct(ctypes.Structure):
    """cosim_record."""

    _fields_ = (
        *((name, c_int64) for name in ("first", "end")),
        *((name, c_void_p) for name in ("residual", "alpha", "interval", "between")),
    )


class ExperimentStruct(ctypes.Structure):
    """cosim_experiment."""

    _fields_ = (
        ("model", c_void_p),
        ("record", RecordStruct),
        *((name, c_void_p) for name in ("work", "amplitudes")),
    )


class KnownInputStruct(ctypes.Structure):
    """cosim_known_input."""

    _fields_ = (
        ("inputs", c_int32),
        *((name, c_void_p) for name in ("B0", "B1", "D", "predicts")),
    )


class FitStruct(ctypes.Structure):
    """cosim_fit."""

    _fields_ = (
        *((name, c_int32) for name in ("experiments", "components", "parameters")),
        *((name, c_int32) for name in ("most_iterations", "iterations")),
        *((name, c_void_p) for name in ("experiment", "count", "lower", "upper", "scale")),
        ("threshold", c_void_p),
        *((name, c_double) for name in ("accuracy", "tolerance", "most_squares")),
        *((name, c_void_p) for name in ("theta", "estimate", "covariance", "statistics", "state")),
        *((name, c_double) for name in ("variance", "freedom")),
    )


@dataclass(frozen=True, eq=False)
class Generator:
    """One component among those of :class:`Generators`.

    Parameters
    ----------
    c : Vector, shape (V,)
    G0 : Matrix, shape (V, V)
    G1 : shape (parameters, V, V)
    basis : slice
        Its place among the functions of the basis.
    theta : slice
        Its place in theta.
    """

    c: Vector
    G0: Matrix
    G1: NDArray[np.float64]
    basis: slice
    theta: slice

    def matrix(self, own: Vector) -> Matrix:
        """Return G at its own parameters, shape (V, V)."""
        G: Matrix = self.G0.copy()
        for value, slope in zip(own, self.G1, strict=True):
            G += value * slope
        return G


@dataclass(frozen=True, eq=False)
class Generators:
    """The components of a disturbance as autonomous linear systems (4)-(5).

    ``f_i = c_i' expm(G_i t) beta_i`` with ``G_i = G0_i + sum_j theta_ij G1_ij``.

    Parameters
    ----------
    size : tuple of int
        V_i.
    count : tuple of int
        Parameters of each component.
    c, G0, G1 : Vector
        Those of all components one behind the other.
    """

    size: tuple[int, ...]
    count: tuple[int, ...]
    c: Vector
    G0: Vector
    G1: Vector

    @property
    def order(self) -> int:
        """The number of basis functions."""
        return sum(self.size)

    @property
    def parameters(self) -> int:
        """The number of entries of theta."""
        return sum(self.count)

    @property
    def each(self) -> tuple[Generator, ...]:
        """The components one by one."""
        components = []
        basis = at_G0 = at_G1 = theta = 0
        for V, count in zip(self.size, self.count, strict=True):
            squares = V * V
            component = Generator(
                c=self.c[basis : basis + V],
                G0=self.G0[at_G0 : at_G0 + squares].reshape(V, V),
                G1=self.G1[at_G1 : at_G1 + count * squares].reshape(count, V, V),
                basis=slice(basis, basis + V),
                theta=slice(theta, theta + count),
            )
            components.append(component)
            basis += V
            at_G0 += squares
            at_G1 += count * squares
            theta += count
        return tuple(components)


@dataclass(frozen=True, eq=False, kw_only=True)
class OutputErrorConstants:
    """The numbers of cosim_output_error.

    Parameters
    ----------
    generators : Generators
    step : Vector, shape (n_intervals,)
        Lengths of the intervals between samples that differ [s].
    Ad : shape (n_intervals, n, n)
    B0, B1 : shape (n_intervals, sources, n)
        The effect of the disturbance at both ends of the interval.
    K : shape (n_intervals, n, n_y)
        Gain of the predictor, which Ad and B0 contain.
    L : shape (n_intervals, n_y, n_y)
        Lower triangles, which turn what is predicted wrong into the covariance of the noise.
    C : Matrix, shape (n_y, n)
    D : Matrix, shape (sources, n_y)
    W : Matrix, shape (n_y, n_y)
        Makes the noise of the outputs white, of equal deviation.
    a : Matrix, shape (n_y, order)
        Autoregressive model of the noise of each output.
    offset : bool
        A constant on every output is unknown.
    forgetting : float
        Weight of the square of a sample over that of the next one.
    average : int
        Steps, the mean of whose samples is one row of the regression; more than 1 only without
        ``a``.
    every : tuple of float, optional
        Time from one value of an output to the next that ``a`` is for [s]; by default the first
        step.
    source : tuple of int, optional
        Which alpha, B and D each component has; by default each its own.
    """

    generators: Generators
    step: Vector
    Ad: NDArray[np.float64]
    B0: NDArray[np.float64]
    B1: NDArray[np.float64]
    K: NDArray[np.float64]
    L: NDArray[np.float64]
    C: Matrix
    D: Matrix
    W: Matrix
    a: Matrix
    offset: bool = False
    forgetting: float = 1.0
    average: int = 1
    every: tuple[float, ...] | None = None
    source: tuple[int, ...] | None = None


class OutputErrorModel:
    """The regression matrix of a disturbed plant, pass by pass over samples.

    Parameters
    ----------
    constants : OutputErrorConstants
    fitted_to : {"y", "delta"} or None
        Theta is estimated with it, which limits its size; None: only its columns are made.

    Raises
    ------
    AssumptionError
        If there are more unknowns than can be fitted at once.
    """

    def __init__(
        self, constants: OutputErrorConstants, *, fitted_to: Literal["y", "delta"] | None = "y"
    ) -> None:
        generators = constants.generators
        self.constants = constants
        source = constants.source
        if source is None:
            source = tuple(range(len(generators.size)))
        arrays: list[NDArray[Any]] = [
            int32(generators.size),
            int32(generators.count),
            int32(source),
        ]
        for values in (
            generators.c,
            generators.G0,
            generators.G1,
            constants.step,
            constants.Ad,
            constants.B0,
            constants.B1,
            constants.K,
            constants.L,
            constants.C,
            constants.D,
            constants.W,
            constants.a,
        ):
            arrays.append(np.ascontiguousarray(values, np.float64))
        n_y, n = constants.C.shape
        every = constants.every or (float(constants.step[0]),) * n_y
        arrays.append(np.array(every, np.float64))
        self.outputs = n_y
        self.linear = generators.order + n + (n_y if constants.offset else 0)
        self.arrays = arrays
        self.struct = OutputErrorStruct(
            n,
            n_y,
            len(generators.size),
            len(constants.D),
            int(constants.offset),
            constants.a.shape[1],
            constants.average,
            *map(pointer, arrays),
            constants.forgetting,
        )
        self.memory = int(library.cosim_output_error_memory(byref(self.struct)))
        self.columns = int(library.cosim_output_error_columns(byref(self.struct)))
        if fitted_to is not None:
            states = "states" if fitted_to == "y" else "modes of the observer"
            self._check_capacity(fitted_to, f"{n} {states}")

    def _check_capacity(self, signal: str, states: str) -> None:
        generators = self.constants.generators
        unknowns = self.columns - 1
        if self.columns <= MOST_COLUMNS and generators.parameters <= MOST_PARAMETERS:
            return
        offsets = self.outputs if self.constants.offset else 0
        derivatives = unknowns - self.linear
        raise AssumptionError(
            f"the fit to {signal} has {generators.parameters} parameters, and {states}, "
            f"{generators.order} amplitudes, their {derivatives} derivatives and {offsets} "
            f"offsets as {unknowns} columns; expected at most {MOST_PARAMETERS} parameters and "
            f"{MOST_COLUMNS - 1} columns; use a model with fewer states, or method = "
            '"least-squares"'
        )


@dataclass(frozen=True, eq=False)
class KnownInput:
    """The numbers of cosim_known_input.

    Parameters
    ----------
    B0, B1 : shape (n_intervals, n, n_u)
        The effect of the inputs at both ends of an interval.
    D : Matrix, shape (n_y, n_u)
    predicts : shape (n_intervals,)
        Whether the gain of the predictor is used.
    """

    B0: NDArray[np.float64]
    B1: NDArray[np.float64]
    D: Matrix
    predicts: Mask


def known_input_struct(known: KnownInput) -> tuple[KnownInputStruct, list[NDArray[Any]]]:
    """Return the struct, and the arrays that must outlive it."""
    arrays: list[NDArray[Any]] = []
    for values in (known.B0, known.B1, known.D):
        arrays.append(np.ascontiguousarray(values, np.float64))
    arrays.append(np.ascontiguousarray(known.predicts, np.uint8))
    return KnownInputStruct(known.D.shape[1], *map(pointer, arrays)), arrays


def residual_of(
    model: OutputErrorModel,
    known: KnownInput,
    *,
    u: Matrix,
    y: Matrix,
    interval: NDArray[np.integer] | None,
) -> Matrix:
    """Compute y less its known part, the response to u from x(0) = 0, shape (N, n_y)."""
    struct, _keep = known_input_struct(known)
    u = np.ascontiguousarray(u, np.float64)
    y = np.ascontiguousarray(y, np.float64)
    intervals = None if interval is None else int32(interval)
    states = np.zeros(2 * model.struct.states + 1)
    residual = np.empty_like(y)
    library.cosim_output_error_residual(
        byref(model.struct),
        byref(struct),
        0,
        len(y),
        pointer(u),
        pointer(y),
        None if intervals is None else pointer(intervals),
        pointer(states),
        pointer(residual),
    )
    return residual


class ResponseRecord:
    """Samples of one experiment beside the model of its outputs.

    Parameters
    ----------
    model : OutputErrorModel
    residual : Matrix, shape (N, n_y)
        The outputs less their known part; NaN where not measured.
    alpha : Matrix, shape (N, components)
    interval : array of int, shape (N,), optional
        Which of the model's intervals ends at each sample; by default the first.
    """

    def __init__(
        self,
        model: OutputErrorModel,
        residual: Matrix,
        alpha: Matrix,
        interval: NDArray[np.integer] | None = None,
    ) -> None:
        self.model = model
        self.residual = np.ascontiguousarray(residual, np.float64)
        self.alpha = np.ascontiguousarray(alpha, np.float64)
        self.interval = None if interval is None else int32(interval)
        self.work = np.zeros(model.memory)
        self.amplitudes = np.zeros(max(model.linear, 1))
        intervals = None if self.interval is None else pointer(self.interval)
        record = RecordStruct(
            0, len(self.residual), pointer(self.residual), pointer(self.alpha), intervals, None
        )
        self.struct = ExperimentStruct(
            ctypes.addressof(model.struct), record, pointer(self.work), pointer(self.amplitudes)
        )

    @property
    def R(self) -> Matrix:
        """The upper triangle of [basis, x(0), offset, d basis/d theta, residual]."""
        M = self.model.columns
        return self.work[: M * M].reshape(M, M)

    def rows(self, theta: Vector) -> NDArray[np.float64]:
        """Compute the rows at ``theta``, shape (N, n_y, columns), neither filtered nor weighed."""
        theta = np.ascontiguousarray(theta, np.float64)
        shape = (len(self.residual), self.model.outputs, self.model.columns)
        rows = np.empty(shape)
        record = byref(self.struct.record)
        addresses = (pointer(self.work), pointer(rows))
        library.cosim_output_error_rows(
            byref(self.model.struct), pointer(theta), record, *addresses
        )
        return rows

    def make(self, theta: Vector) -> Matrix:
        """Pass over all samples at ``theta``; return R."""
        theta = np.ascontiguousarray(theta, np.float64)
        model = byref(self.model.struct)
        work = pointer(self.work)
        library.cosim_output_error_start(model, pointer(theta), work)
        record = self.struct.record
        library.cosim_output_error_take(
            model, pointer(theta), byref(record), 0, len(self.residual), work
        )
        return self.R.copy()


@dataclass(frozen=True, eq=False)
class GaussNewtonResult:
    """What :func:`minimize` found.

    Parameters
    ----------
    status : int
        0, NO_INFORMATION or NOT_CONVERGED.
    theta : Vector, shape (P,)
    covariance : Matrix, shape (P, P)
        From the variance of the residual; zero where not estimated.
    variance : float
        Of the residual, weighted.
    freedom : float
        Samples less unknowns.
    statistics : Vector, shape (components,)
        ``beta' C^-1 beta`` with the covariance C of beta for noise of deviation 1.
    states : tuple of ParameterState
    iterations : int
    """

    status: int
    theta: Vector
    covariance: Matrix
    variance: float
    freedom: float
    statistics: Vector
    states: tuple[ParameterState, ...]
    iterations: int


@dataclass(frozen=True, eq=False, kw_only=True)
class SearchLimits:
    """What bounds a search for theta.

    Parameters
    ----------
    lower, upper : Vector, shape (P,)
        Bounds; where they are equal theta is known.
    scale : Vector, shape (P,)
        Longest steps.
    threshold : Vector, shape (components,)
        Statistic, in variances of the residual, from which on a component is no noise.
    accuracy : float
        Of a weighted residual: smaller ones are rounding.
    """

    lower: Vector
    upper: Vector
    scale: Vector
    threshold: Vector
    accuracy: float


def minimize(
    records: Sequence[ResponseRecord],
    theta: Vector,
    limits: SearchLimits,
    iterations: int | None = None,
) -> GaussNewtonResult:
    """Minimize the weighted squares of the residuals of all records over theta.

    Parameters
    ----------
    records : sequence of ResponseRecord
        Of the same disturbance; afterwards their ``amplitudes`` are those of the minimum.
    theta : Vector, shape (P,)
        Where to start.
    limits : SearchLimits
    iterations : int, optional
        At most; by default, and never more than, ``MOST_ITERATIONS``.
    """
    generators = records[0].model.constants.generators
    P = generators.parameters
    components = len(generators.size)
    structs = (ExperimentStruct * len(records))(*(one.struct for one in records))
    count = int32(generators.count)
    bounds = (limits.lower, limits.upper, limits.scale, limits.threshold)
    inputs = [np.array(values, np.float64) for values in bounds]
    at = np.array(theta, np.float64)
    estimate = np.array(theta, np.float64)
    covariance = np.zeros((P, P))
    statistics = np.zeros(components)
    states = np.zeros(P, np.uint8)
    outputs: list[NDArray[Any]] = [at, estimate, covariance, statistics, states]
    fit = FitStruct(
        len(records),
        components,
        P,
        min(iterations or MOST_ITERATIONS, MOST_ITERATIONS),
        0,
        ctypes.addressof(structs),
        pointer(count),
        *map(pointer, inputs),
        limits.accuracy,
        1.0,
        np.inf,
        *map(pointer, outputs),
    )
    status = int(library.cosim_output_error_fit(byref(fit)))
    if status != NO_INFORMATION:
        library.cosim_output_error_settle(byref(fit))
    return GaussNewtonResult(
        status,
        estimate,
        covariance,
        fit.variance,
        fit.freedom,
        statistics,
        tuple(ParameterState(int(state)) for state in states),
        fit.iterations,
    )


declare(
    {
        "cosim_output_error_memory": (c_int64, (POINTER(OutputErrorStruct),)),
        "cosim_output_error_columns": (c_int32, (POINTER(OutputErrorStruct),)),
        "cosim_output_error_start": (None, (POINTER(OutputErrorStruct), c_void_p, c_void_p)),
        "cosim_output_error_take": (
            None,
            (
                POINTER(OutputErrorStruct),
                c_void_p,
                POINTER(RecordStruct),
                c_int64,
                c_int64,
                c_void_p,
            ),
        ),
        "cosim_output_error_residual": (
            None,
            (
                POINTER(OutputErrorStruct),
                POINTER(KnownInputStruct),
                c_int64,
                c_int64,
                *(c_void_p,) * 5,
            ),
        ),
        "cosim_output_error_rows": (
            None,
            (POINTER(OutputErrorStruct), c_void_p, POINTER(RecordStruct), c_void_p, c_void_p),
        ),
        "cosim_output_error_fit": (c_int32, (POINTER(FitStruct),)),
        "cosim_output_error_settle": (None, (POINTER(FitStruct),)),
        "cosim_output_error_update": (c_int32, (POINTER(FitStruct),)),
    }
)
