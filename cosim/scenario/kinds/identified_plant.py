"""What is identified, and what is judged of it at the end of a run.

Verdicts are the same for every method: output error is fitted to what the observer took in as y and
u, and what the identifier says is held against it. Where the identifier takes samples of y at times
of their own, it is fitted to these; where it has a moving window, to the last one. They are
results, not signals: they rest on linear algebra whose last bits depend on the processor.

The same tests tell whether the samples of a residual are what noise leaves: it is the output of a
plant without states, input and disturbance.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np
from pydantic import TypeAdapter, ValidationError

from cosim.arrays import Mask, Matrix, Vector, as_columns
from cosim.core.clock import seconds
from cosim.core.connections import components_driving
from cosim.core.contracts import Block
from cosim.core.graph import Graph
from cosim.core.port import Port
from cosim.core.recording import Recording
from cosim.core.structure.cycles import reached_from
from cosim.errors import AssumptionError, RunError, UsageError, quoted
from cosim.native.estimation.alphas import Alpha, AlphaSignal, signals_among
from cosim.native.numerics.programs import evaluate_at
from cosim.scenario.document.schema import Limit
from cosim.scenario.record import IdentifierVerdicts, IrregularEffect, IrregularPart
from cosim.theory.assessment.advice import advised
from cosim.theory.assessment.amplitude_verdicts import amplitude_verdicts
from cosim.theory.assessment.assessing import assess
from cosim.theory.assessment.undetected import undetected_errors
from cosim.theory.assessment.verdicts import Assessment, judge
from cosim.theory.covariance import is_covariance
from cosim.theory.disturbances.families import Family, Polynomial
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant
from cosim.theory.estimators.output_error import OutputErrorProblem

if TYPE_CHECKING:
    from cosim.theory.bounded.feasible_program import Watch
    from cosim.theory.bounded.irregular_part import GuaranteedInterval, Programs

# (lower, upper) of each theta, or of some by their index
ThetaBounds: TypeAlias = Sequence[Sequence[float]] | Mapping[int, tuple[float, float]]
OUTPUT_ERROR: Final = "output-error"
IDENTIFY_WITH_OFFSET: Final = "`cosim identify --offset`"
NO_SIGNALS: Final = np.zeros((0, 0))
_INTERVAL: Final = TypeAdapter(tuple[Limit, Limit])
FREQUENCIES: Final = 1025  # of a spectrum, from 0 to half the sampling frequency


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
        return self.alpha_at(t, t, NO_SIGNALS)

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

    @property
    def ports(self) -> dict[str, Port]:
        """What the observer takes in, y and u, and the signals among the alphas, as ``alpha``."""
        ports = {"y": Port(self.observer, "y")}
        if self.plant.D.shape[1]:
            ports["u"] = Port(self.observer, "u")
        if signals_among(self.alphas):
            ports["alpha"] = Port(self.regressor, "alpha")
        return ports

    def recorded(self, run: Recording) -> tuple[Vector, dict[str, Matrix]]:
        """Return what :meth:`data_set` takes from a recording: instants, and rows by port."""
        t = seconds(run.time_ns(self.observer))
        return t, {name: as_columns(run[port]) for name, port in self.ports.items()}

    def data_set(
        self, graph: Graph, t: Vector, rows: Mapping[str, Matrix], samples: SampleRows | None = None
    ) -> DataSet:
        """Return what the observer took in as the data of output error.

        Parameters
        ----------
        graph : Graph
            That it was in: which of u had a zero-order hold, and which depend on y.
        t : Vector, shape (N,)
        rows : mapping of name to Matrix, shape (N, size)
            As of :attr:`ports`.
        samples : SampleRows, optional
            What counts in the place of y.

        Raises
        ------
        AssumptionError
            If the alphas, as they were recorded, do not determine the regression.
        """
        inputs = graph.layout[self.observer].interface.input_columns()
        held = graph.held[self.observer][inputs.get("u", slice(0, 0))]
        points = t
        y = rows["y"]
        u = rows.get("u", np.zeros((len(t), 0)))
        if samples is not None:
            t, y, u = samples.beside(t, u, held, y.shape[1])
        alpha = self.alpha_at(t, points, rows.get("alpha", NO_SIGNALS))
        self.check_alphas(t, alpha)
        in_feedback = inputs_in_feedback(graph, self.observer) | self.closed_loop
        return DataSet(t, y, u, alpha, held, np.isin(t, points), in_feedback)


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
    try:
        lower, upper = _INTERVAL.validate_python(row)
    except ValidationError as error:
        raise UsageError(
            f"bounds of theta[{j}]: expected two numbers, [lower, upper], inf where there is "
            f"none, such as [-1, inf], got {row}"
        ) from error
    if not lower <= upper or lower == np.inf or upper == -np.inf:
        raise UsageError(
            f"bounds of theta[{j}]: expected lower <= upper with numbers between them, -inf or "
            f"inf where there is no bound, got [{lower:g}, {upper:g}]"
        )
    return lower, upper


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
        return diagonal_covariance("deviation", deviation, outputs)
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


def diagonal_covariance(source: str, deviations: object, outputs: int) -> Matrix:
    """Return the covariance of independent noise, shape (outputs, outputs).

    Parameters
    ----------
    source : str
        Where the deviations are from, for messages.
    deviations : object
        One number, or one per output.
    outputs : int

    Raises
    ------
    UsageError
        If they are not that, or not positive.
    """
    try:
        row = np.array(deviations, np.float64)
        is_row = row.ndim < 2 and bool(((row > 0.0) & (row < np.inf)).all())
    except (TypeError, ValueError):
        is_row = False
    if not is_row:
        raise UsageError(f"{source}: expected positive finite numbers, got {quoted(deviations)}")
    if row.ndim and len(row) != outputs:
        raise UsageError(
            f"{source}: expected one number, or one per output ({outputs}), got {len(row)}"
        )
    return np.diag(np.broadcast_to(row, outputs) ** 2)


# --- verdicts ---


class Assessor:
    """Keeps what verdicts need of the rows of a run.

    Parameters
    ----------
    graph : Graph
    identified : mapping of identifier to IdentifiedPlant
    """

    def __init__(self, graph: Graph, identified: Mapping[str, IdentifiedPlant]) -> None:
        self._graph = graph
        self._identified = identified
        self._times: list[Vector] = []
        self._rows: dict[Port, list[Matrix]] = {}
        for name, one in identified.items():
            own = [Port(name, key) for key in ("sample_times", "samples")]
            self._rows |= {port: [] for port in (*one.ports.values(), *own)}
        self._last = np.zeros(0)

    def _columns(self, port: Port) -> slice:
        """Return where a signal is in the row; nowhere: it is not there."""
        return self._graph.layout[port.component].signal_columns.get(port.signal, slice(0, 0))

    def take(self, block: Block, signals: Matrix) -> None:
        """Keep the rows of a block."""
        first = 1 if self._times else 0
        self._times.append(block.time[first:].copy())
        for port, rows in self._rows.items():
            rows.append(signals[first:, self._columns(port)].copy())
        self._last = signals[-1].copy()

    def results(self) -> dict[str, Any]:
        """Return the verdicts by identifier, as plain values."""
        return {name: self._verdicts(name).to_dict() for name in self._identified}

    def _verdicts(self, name: str) -> IdentifierVerdicts:
        """Return the verdicts on the last estimate, or why there are none."""
        if not self._times:
            return IdentifierVerdicts(problem="the run ended before there were data")
        if self._identified[name].problem:
            return IdentifierVerdicts(problem=self._identified[name].problem)
        try:
            return self._assessed(name, self._identified[name])
        except (AssumptionError, np.linalg.LinAlgError) as error:
            return IdentifierVerdicts(problem=str(error))

    def _kept(self, port: Port) -> Matrix:
        return np.concatenate(self._rows[port])

    def _assessed(self, name: str, identified: IdentifiedPlant) -> IdentifierVerdicts:
        t = np.concatenate(self._times)
        samples = None
        values = self._kept(Port(name, "samples"))
        if values.shape[1]:
            samples = SampleRows(t, self._kept(Port(name, "sample_times")), values)
        rows = {key: self._kept(port) for key, port in identified.ports.items()}
        data = identified.data_set(self._graph, t, rows, samples)
        theta = self._last[self._columns(Port(name, "theta"))]  # none without parameters
        error = self._last[self._columns(Port(name, "standard_error"))]
        fitted = assess(identified.problem_of([data.last(identified.window)]), theta)
        assessment = advised(fitted, [identified.alpha])
        amplitudes = amplitude_verdicts(assessment)
        with_offset = "`offset = true`" if identified.has_offset_key else IDENTIFY_WITH_OFFSET
        return replace(
            verdicts_of(assessment),
            extent=identified.extent,
            amplitudes=amplitudes,
            undetected=undetected_errors(assessment, amplitudes, with_offset=with_offset),
            estimate=judge(assessment, theta, error if len(error) else None),
            irregular=_irregular(assessment, identified.irregular),
        )


def verdicts_of(assessment: Assessment) -> IdentifierVerdicts:
    """Return what a fit by output error says of theta, and of the noise."""
    return IdentifierVerdicts(**assessment.to_dict() | {"parameters": assessment.parameters})


def _irregular(assessment: Assessment, bound: float | None) -> IrregularPart | None:
    """Return what an irregular part within its bound leaves open, or why that is not known."""
    if bound is None:
        return None
    from cosim.theory.bounded.irregular_part import Programs  # rarely needed

    try:
        interval = interval_of(assessment, bound, Programs.BEYOND_FIRST_ORDER)
    except (AssumptionError, RunError) as error:
        return IrregularPart(bound, problem=str(error))
    return irregular_part(bound, interval)


def irregular_part(bound: float, interval: GuaranteedInterval) -> IrregularPart:
    """Return what an interval that is guaranteed for a bound says of every theta."""
    columns = (interval.lower, interval.upper, interval.half_width, interval.first_order_holds)
    effects = []
    for j, (lower, upper, half_width, holds) in enumerate(zip(*columns, strict=True)):
        effect = IrregularEffect(
            name=f"theta[{j}]",
            first_order=float(half_width),
            holds=bool(holds),
            is_explained=not np.isnan([lower, upper]).any(),
            lower=float(lower) if np.isfinite(lower) else None,
            upper=float(upper) if np.isfinite(upper) else None,
        )
        effects.append(effect)
    unsolved = 0 if interval.feasible is None else interval.feasible.unsolved
    return IrregularPart(bound, tuple(effects), interval.confidence, unsolved)


def interval_of(
    assessment: Assessment, bound: float, programs: Programs, watch: Watch | None = None
) -> GuaranteedInterval:
    """Return which theta data allow if an irregular part of delta is within a bound.

    Where the noise of y is not stated it is as large as the residual, which holds the irregular
    part too; errors of step and quantization are allowed for.

    Parameters
    ----------
    assessment : Assessment
        Of one data set.
    bound : float
        Of the irregular part, ``|delta_0| <= bound``.
    programs : Programs
        When linear programs are solved.
    watch : callable, optional
        Is told after every linear program how many have been solved.

    Raises
    ------
    AssumptionError
        If not every theta was estimated, samples are missing or at unequal distances, or the plant
        is unstable.
    """
    from cosim.theory.bounded.irregular_part import guaranteed_interval  # rarely needed

    problem = assessment.problem
    missing = np.flatnonzero(~assessment.fit.estimated)
    if len(missing):
        raise AssumptionError(
            f"{', '.join(f'theta[{j}]' for j in missing)} was not estimated; bounding theta for an "
            "irregular part of the disturbance takes an estimate of every theta"
        )
    accuracy = assessment.consistency.accuracy[0]
    if problem.stated is None:
        sigma = _largest_deviations(assessment)
    else:
        sigma = np.sqrt(np.diag(problem.stated))
    return guaranteed_interval(
        problem.data[0],
        problem.plant,
        problem.families,
        assessment.fit,
        bound=bound,
        sigma=sigma,
        sampling_error=float(np.abs(accuracy.step).max()) + 0.5 * float(accuracy.spacing.max()),
        noise=assessment.noise.without_color(),
        programs=programs,
        watch=watch,
    )


def _largest_deviations(assessment: Assessment) -> Vector:
    """Return deviations of white noise whose means are as large as those of each residual.

    Of colored noise that is the one at the frequency where its spectrum is largest.
    """
    noise = assessment.noise
    if assessment.consistency.is_exact:
        return np.zeros(len(noise.a))
    frequencies = np.linspace(0.0, np.pi, FREQUENCIES)
    lags = np.arange(1, noise.order + 1)
    waves = np.exp(-1j * np.outer(frequencies, lags))
    gains = 1.0 / np.abs(1.0 - waves @ noise.a.T)
    return np.asarray(assessment.deviations * gains.max(axis=0), np.float64)


def residual_noise(t: Vector, residual: Vector) -> tuple[str, float, float]:
    """Test samples of a residual, shape (N,), at ascending instants t [s].

    Returns
    -------
    problem : str
        Why it is not what noise leaves; empty: it is.
    power : float
        The largest power of the noise at a frequency, over its mean; 1: it is white.
    freedom : float
        Degrees of freedom of that power.

    Raises
    ------
    AssumptionError
        If there are hardly any.
    """
    samples = len(residual)
    from cosim.theory.assessment.noise_color import largest_power  # rarely needed

    data = DataSet(t, residual[:, np.newaxis], np.zeros((samples, 0)), np.zeros((samples, 1)))
    A = np.zeros((0, 0))
    C = np.zeros((1, 0))
    plant = DisturbedPlant(A=A, B=A, Bd=C.T, C=C, D=C, Dd=np.ones((1, 1)))
    found = assess(OutputErrorProblem([data], plant, [Polynomial(0)]), None)
    problem = "" if found.consistency.passed else found.consistency.contradiction
    power = largest_power(found.noise.a[0])
    return problem.replace(" in y[0]", ""), power, found.noise.freedom


def inputs_in_feedback(graph: Graph, observer: str) -> Mask:
    """Return which elements of an observer's u depend on what drives its y, shape (n_u,)."""
    u = graph.layout[observer].interface.input_columns().get("u", slice(0, 0))
    in_feedback = np.zeros(u.stop - u.start, np.bool_)
    drives: defaultdict[str, set[str]] = defaultdict(set)
    for to, connection in graph.connections.items():
        for source in connection.sources:
            drives[source.component].add(to.component)
    front = components_driving(graph.connections, Port(observer, "y"))
    dependent = reached_from(set().union(*(drives[name] for name in front)), drives)
    for to, connection in graph.connections.items():
        follows_y = any(source.component in dependent for source in connection.sources)
        if follows_y and to.whole == Port(observer, "u"):
            in_feedback[graph.ports.input(to).elements] = True
    return in_feedback
