"""What drives an identifier, its regressor, the observer behind it, samples of y; its start."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace

from pydantic import Field

from cosim.blocks.field_data import units_of_samples
from cosim.core.clock import LARGEST_NS
from cosim.core.connections import Connection
from cosim.core.port import Port
from cosim.core.signals import SAMPLE_TIMES, Interface, PortUnit
from cosim.errors import AssumptionError, UsageError
from cosim.instants import step_seconds
from cosim.native.estimation.alphas import signals_among
from cosim.scenario.document.schema import Number, TomlTable
from cosim.scenario.kinds.base import BuildContext, HasSamples, Kind
from cosim.scenario.kinds.observers import DesignedObserver, UnknownInputObserverKind
from cosim.scenario.kinds.reconstruction import AnyReconstruction
from cosim.scenario.kinds.regressor import RegressorKind
from cosim.scenario.kinds.values import ImpliedConnection
from cosim.theory.assessment.accuracy import check_step
from cosim.theory.observers.observer import identification_start_time
from cosim.theory.reconstruction.filters import ConsistentFilter, FirstOrderFilter


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
    identifier, regressor : str
    kind : RegressorKind
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
        self.kind = kind
        self.regression = kind.design(name, context)
        self.observer: ObserverSource | None = None
        self._context = context
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
        clock = self._context.clock
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

    # --- samples of y ---

    @property
    def samplers(self) -> dict[str, HasSamples]:
        """What drives the input with the samples of y."""
        drivers = self._context.drivers(Port(self.identifier, "samples"))
        return {name: kind for name, kind in drivers.items() if isinstance(kind, HasSamples)}

    def most_samples(self) -> int:
        """Return how many samples of y are taken in a step; 0: y at the communication points.

        Raises
        ------
        UsageError
            If y has values between samples, and these do not reach the identifier.
        """
        samplers = self.samplers.items()
        most = [kind.most_in_a_step(name, self._context) for name, kind in samplers]
        if any(most):
            return max(most)
        sampled = sampled_behind(Port(self.identifier, "y"), self._context)
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


# --- when it starts ---


def start_time(
    start: Number | StartTable | None, source: IdentifierSource, context: BuildContext
) -> float:
    """Return the first communication point not before T_id, and record it.

    A computed T_id (36)-(38) is counted from the start of the run.

    Raises
    ------
    UsageError
        If it is to be computed, and there is no observer to compute it from.
    AssumptionError
        If the regressor has no value there, or it is in no run.
    """
    clock = context.clock
    if isinstance(start, float | int):
        T_id = float(start)
        elapsed_ns = T_id * 1e9 - clock.start_ns
    else:
        T_id = _computed(start or DEFAULT_START, source, context)
        elapsed_ns = T_id * 1e9
    # Rounded to 1e-3 ns: a T_id on a communication point must not become the next point.
    elapsed_ns = round(elapsed_ns, 3)
    needed_ns = source.regression.constants.alphas.samples * clock.step_ns
    if needed_ns and elapsed_ns < needed_ns:
        signals = signals_among(source.regression.alphas)
        names = ", ".join(repr(alpha.text) for alpha in signals)
        raise AssumptionError(
            f"start: expected at least {step_seconds(needed_ns):g} s after the start of the run "
            f"(longest delay plus lag of delta), got {T_id} s; alpha {names} has no earlier value"
        )
    longest = max(source.regression.delays)
    if elapsed_ns < round((longest + source.window) * 1e9, 3):
        since = f" after start_time, {clock.start_time} s" if clock.start_ns else ""
        plus = f" and the observer's window, {source.window} s," if source.window else ""
        raise AssumptionError(
            f"start: expected at least the longest delay, {longest} s{plus}{since}, got {T_id} s; "
            "the regressor has no earlier value"
        )
    if not T_id <= LARGEST_NS / 1e9:
        raise AssumptionError(
            f"start: expected T_id within a run, got {T_id:g} s; if it is computed: increase "
            "filter_rate, move the eigenvalues of the observer to the left, or increase the "
            "fractions"
        )
    time = clock.grid.instant(math.ceil(elapsed_ns / clock.step_ns))
    context.add_metadata(source.identifier, {"start_time": time})
    return time


def _computed(start: StartTable, source: IdentifierSource, context: BuildContext) -> float:
    """Compute T_id from the observer that drives the regressor [s], and record its parts."""
    if source.observer is None:
        raise UsageError(
            "start: to compute T_id, exactly one observer must drive the regressor; "
            "otherwise give start as a time [s]"
        )
    reconstruction = source.observer.reconstruction
    filter_rate = None
    if isinstance(reconstruction, FirstOrderFilter | ConsistentFilter):
        filter_rate = reconstruction.rate
    times = identification_start_time(
        lambda_obs=source.observer.design.design.lambda_obs,
        filter_rate=filter_rate,
        window=reconstruction.window or None,
        delays=source.regression.delays,
        epsilon_observer=start.epsilon_observer,
        epsilon_filter=start.epsilon_filter,
    )
    context.add_metadata(source.identifier, asdict(times))
    return times.T_id
