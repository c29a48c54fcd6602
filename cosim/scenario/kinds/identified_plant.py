"""What an identifier has behind it: regressor, observer, the model of y, and the data of a fit."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Final, TypeAlias

import numpy as np
from pydantic import Field, TypeAdapter, ValidationError

from cosim.arrays import Mask, Matrix, Vector, as_columns
from cosim.blocks.field_data import units_of_samples
from cosim.core.clock import LARGEST_NS, seconds
from cosim.core.connections import Connection, components_driving
from cosim.core.graph import Graph
from cosim.core.port import Port
from cosim.core.recording import Recording
from cosim.core.signals import SAMPLE_TIMES, Interface, PortUnit
from cosim.core.structure.cycles import reached_from
from cosim.errors import AssumptionError, UsageError, quoted
from cosim.native.estimation.alphas import Alpha, AlphaSignal, signals_among
from cosim.native.numerics.programs import evaluate_at
from cosim.scenario.document.schema import Limit, Number, TomlTable
from cosim.scenario.kinds.base import BuildContext, Kind
from cosim.scenario.kinds.capabilities import HasSamples
from cosim.scenario.kinds.observer_design import AnyReconstruction
from cosim.scenario.kinds.observers import DesignedObserver, UnknownInputObserverKind
from cosim.scenario.kinds.regressor import RegressorKind
from cosim.scenario.kinds.values import ImpliedConnection
from cosim.theory.assessment.accuracy import check_step
from cosim.theory.covariance import is_covariance
from cosim.theory.disturbances.families import Family
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant
from cosim.theory.estimators.output_error import OutputErrorProblem
from cosim.theory.observers.observer import identification_start_time
from cosim.theory.reconstruction.filters import ConsistentFilter, FirstOrderFilter

# (lower, upper) of each theta, or of some by their index
ThetaBounds: TypeAlias = Sequence[Sequence[float]] | Mapping[int, tuple[float, float]]
OUTPUT_ERROR: Final = "output-error"
NO_SIGNALS: Final = np.zeros((0, 0))
_INTERVAL: Final = TypeAdapter(tuple[Limit, Limit])


# --- what drives an identifier ---


class StartTable(TomlTable):
    """Identification start time T_id by (36)-(38)."""

    epsilon_observer: Number = Field(
        description="remaining fraction of the initial observer error at T_id, in (0, 1)"
    )
    epsilon_filter: Number = Field(
        description="remaining fraction of the initial filter transient at T_id, in (0, 1)"
    )


DEFAULT_START = StartTable(epsilon_observer=1e-3, epsilon_filter=1e-3)


@dataclass(frozen=True, eq=False)
class ObserverSource:
    """The observer that drives a regressor alone."""

    name: str
    kind: UnknownInputObserverKind
    context: BuildContext

    @property
    def design(self) -> DesignedObserver:
        """Its design, and the model that it is designed on."""
        return self.kind.design(self.name, self.context)

    @property
    def reconstruction(self) -> AnyReconstruction:
        """How it makes delta."""
        return self.kind.reconstruction(self.name, self.context)

    def units(self, interface: Interface) -> dict[str, PortUnit]:
        """Return the units of the signals that are taken where the observer takes them."""
        named: dict[str, PortUnit] = {}
        for port, designed in self.design.model.units.items():
            names = tuple(unit.name for unit in designed if unit.name is not None)
            if names:
                named[port] = names
        named |= self.kind.units
        if "y" in named and SAMPLE_TIMES in interface.by_name:
            most = interface.by_name[SAMPLE_TIMES].size
            named["samples"] = units_of_samples(named["y"], most)
        inputs = [signal.name for signal in interface.inputs]
        return {name: named[name] for name in inputs if name in named}


class IdentifierSource:
    """The regressor that drives an identifier, and the observer that drives the regressor.

    Parameters
    ----------
    identifier : str
    context : BuildContext

    Attributes
    ----------
    context : BuildContext
    identifier, regressor : str
    regression : RegressorDesign
    observer : ObserverSource or None
        None: what drives the regressor is no observer, or several.

    Raises
    ------
    UsageError
        If no regressor drives the identifier directly.
    """

    def __init__(self, identifier: str, context: BuildContext) -> None:
        name = context.driver(Port(identifier, "regressor"))
        kind = None if name is None else context.spec(name)
        if name is None or not isinstance(kind, RegressorKind):
            raise UsageError(
                "'regressor' must be driven directly by a component of kind 'regressor', "
                "which has the terms to identify"
            )
        self.identifier = identifier
        self.regressor = name
        self.regression = kind.design(name, context)
        self.observer: ObserverSource | None = None
        self.context = context
        observer = context.driver(Port(name, "delta"))
        kind_of_observer = None if observer is None else context.spec(observer)
        if observer is not None and isinstance(kind_of_observer, UnknownInputObserverKind):
            self.observer = ObserverSource(observer, kind_of_observer, context)

    @property
    def window(self) -> float:
        """How long the observer has no delta [s]."""
        return 0.0 if self.observer is None else self.observer.reconstruction.window

    def check_step(self) -> None:
        """Refuse a communication step between whose ends an alpha is no straight line.

        A signal that only the run computes is one.

        Raises
        ------
        AssumptionError
            If it is too long.
        """
        clock = self.context.clock
        known = self.regression.known
        if known.names:
            check_step(known, known.names, start=clock.start_time, stop=clock.stop, h=clock.h)

    def missing_model(self) -> str:
        """Return why there is no model of y that output error can fit; empty: there is one."""
        for alpha in signals_among(self.regression.alphas):
            if alpha.lag > 0.0:
                return (
                    f"expected an alpha without lag, got {alpha.text!r} with a lag of "
                    f'{alpha.lag:g} s; method = "least-squares" allows it'
                )
        if self.observer is None:
            return (
                "expected exactly one observer that drives the regressor; its design model is "
                "the model of y"
            )
        if self.observer.kind.relinearize:
            return (
                f"{self.observer.name!r} is relinearized during the run, so y has no fixed model; "
                'expected relinearize = false, or method = "least-squares"'
            )
        model = self.observer.design.model
        n_d = model.reduced.C5.shape[1]
        elements = len(self.regression.members)
        if n_d == elements and not model.constant:
            return ""
        what = "a constant input"
        if n_d != elements:
            what = f"{n_d} unknown disturbances, the terms describe {elements} elements of delta"
        return (
            f"the design model of {self.observer.name!r} has {what}; expected terms for every "
            'disturbance and no constant input, or method = "least-squares"'
        )

    # --- when it starts ---

    def start_time(self, start: float | StartTable | None) -> float:
        """Return the first communication point not before T_id, and record it.

        A computed T_id (36)-(38) is counted from the start of the run.

        Raises
        ------
        UsageError
            If it is to be computed, and there is no observer to compute it from.
        AssumptionError
            If the regressor has no value there, or it is in no run.
        """
        clock = self.context.clock
        if isinstance(start, float | int):
            T_id = float(start)
            elapsed_ns = T_id * 1e9 - clock.start_ns
        else:
            T_id = self._computed_start(start or DEFAULT_START)
            elapsed_ns = T_id * 1e9
        # Rounded to 1e-3 ns: a T_id on a communication point must not become the next point.
        elapsed_ns = round(elapsed_ns, 3)
        longest = max(self.regression.delays)
        needed_ns = round((longest + self.window) * 1e9, 3)
        needed = f"the longest delay, {longest} s"
        if self.window:
            needed += f" and the observer's window, {self.window} s"
        of_alphas_ns = float(self.regression.constants.alphas.samples * clock.step_ns)
        if of_alphas_ns > needed_ns:
            needed_ns = of_alphas_ns
            names = ", ".join(alpha.text for alpha in signals_among(self.regression.alphas))
            needed = f"{needed_ns / 1e9:g} s, the longest delay and the lag of delta, for {names!r}"
        if elapsed_ns < needed_ns:
            raise AssumptionError(
                f"start: expected at least {needed}, got {T_id} s; the regressor has no value so "
                f"soon after the start of the run, {clock.start_time} s"
            )
        if not T_id <= LARGEST_NS / 1e9:
            raise AssumptionError(
                f"start: expected T_id within a run, got {T_id:g} s; if it is computed: increase "
                "filter_rate, move the eigenvalues of the observer to the left, or increase the "
                "fractions"
            )
        time = clock.grid.instant(math.ceil(elapsed_ns / clock.step_ns))
        self.context.add_metadata(self.identifier, {"start_time": time})
        return time

    def _computed_start(self, start: StartTable) -> float:
        """Compute T_id from the observer that drives the regressor [s], and record its parts."""
        if self.observer is None:
            raise UsageError(
                "start: to compute T_id, exactly one observer must drive the regressor; "
                "otherwise give start as a time [s]"
            )
        reconstruction = self.observer.reconstruction
        filter_rate = None
        if isinstance(reconstruction, FirstOrderFilter | ConsistentFilter):
            filter_rate = reconstruction.rate
        times = identification_start_time(
            lambda_obs=self.observer.design.design.lambda_obs,
            filter_rate=filter_rate,
            window=reconstruction.window or None,
            delays=self.regression.delays,
            epsilon_observer=start.epsilon_observer,
            epsilon_filter=start.epsilon_filter,
        )
        self.context.add_metadata(self.identifier, asdict(times))
        return times.T_id

    # --- samples of y ---

    @property
    def samplers(self) -> dict[str, HasSamples]:
        """What drives the input with the samples of y."""
        drivers = self.context.drivers(Port(self.identifier, "samples"))
        return {name: kind for name, kind in drivers.items() if isinstance(kind, HasSamples)}

    def most_samples(self) -> int:
        """Return how many samples of y are taken in a step; 0: y at the communication points.

        Raises
        ------
        UsageError
            If y has values between samples, and these do not reach the identifier.
        """
        samplers = self.samplers.items()
        most = [kind.most_in_a_step(name, self.context) for name, kind in samplers]
        if any(most):
            return max(most)
        sampled = sampled_behind(Port(self.identifier, "y"), self.context)
        if sampled is not None:
            raise UsageError(
                f"y is interpolated between the samples of {sampled!r}; expected y directly from "
                "all outputs of one such component, or from sensors, with at most one scalar "
                "gain, so that the samples themselves can be used"
            )
        return 0


def sample_connections(
    name: str,
    connections: Mapping[Port, Connection],
    implied: Mapping[Port, ImpliedConnection],
    specs: Mapping[str, Kind],
) -> dict[Port, ImpliedConnection]:
    """Return the connections to the samples of what drives y, where it has any.

    Those of several elements stand one element behind the other, as the elements do in y. Those
    that have no time of their own are of the communication points. There are none where several
    components have times of their own.
    """
    to = Port(name, "y")
    y = connections.get(to)
    origin: Port | None = to
    if y is None and to in implied:
        y = implied[to].connection
        origin = implied[to].origin
    if y is None or y.matrix.ndim:
        return {}
    sources = []
    timed_by = None
    for source in y.sources:
        spec = specs.get(source.component)
        signal = spec.samples_of(source.signal) if isinstance(spec, HasSamples) else None
        if not isinstance(spec, HasSamples) or signal is None:
            sources.append(source)
            continue
        is_alone = all(other.component == source.component for other in y.sources)
        if not spec.samples_at_points and (source.element is not None or not is_alone):
            return {}
        sources.append(replace(source, signal=signal))
        timed_by = source.component
    if timed_by is None:
        return {}
    samples = Connection(sources, y.gain, y.offset, y.unit)
    times = Connection(Port(timed_by, SAMPLE_TIMES))
    return {
        Port(name, "samples"): ImpliedConnection(samples, origin),
        Port(name, SAMPLE_TIMES): ImpliedConnection(times, origin),
    }


def sampled_behind(to: Port, context: BuildContext) -> str | None:
    """Return the field data that an input follows, or a sensor with samples that drives it.

    None: there is none.
    """
    for name, kind in context.behind(to).items():
        if kind.is_recorded and isinstance(kind, HasSamples) and not kind.samples_at_points:
            return name
    for name, kind in context.drivers(to).items():
        if isinstance(kind, HasSamples) and kind.most_in_a_step(name, context):
            return name
    return None


# --- the model of y, and its data ---


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


# --- what the tables say of theta, and of the noise ---


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
