"""What drives an identifier: its regressor, the observer behind it, samples of y."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from cosim.blocks.field_data import units_of_samples
from cosim.core.connections import Connection
from cosim.core.port import Port
from cosim.core.signals import SAMPLE_TIMES, Interface, PortUnit
from cosim.errors import UsageError
from cosim.native.estimation.alphas import signals_among
from cosim.scenario.kinds.base import BuildContext, Kind
from cosim.scenario.kinds.capabilities import HasSamples
from cosim.scenario.kinds.observers import DesignedObserver, UnknownInputObserverKind
from cosim.scenario.kinds.reconstruction import AnyReconstruction
from cosim.scenario.kinds.regressor import RegressorDesign, RegressorKind
from cosim.scenario.kinds.values import ImpliedConnection
from cosim.theory.assessment.accuracy import check_step
from cosim.theory.disturbances.distinguishable import check_distinguishable
from cosim.theory.disturbed_plant import DisturbedPlant, disturbed_plant
from cosim.theory.observers.observer import StateSpace
from cosim.theory.reconstruction.filters import ConsistentFilter, FirstOrderFilter


class IdentifierSource:
    """The regressor that drives an identifier, and the observer that drives the regressor.

    Parameters
    ----------
    identifier : str
    context : BuildContext

    Attributes
    ----------
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
        self.regression: RegressorDesign = kind.design(name, context)
        self.observer = _observer_behind(name, context)
        self._context = context

    @property
    def window(self) -> float:
        """How long the observer has no delta [s]."""
        return 0.0 if self.observer is None else self.observer.window

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
        if not known.known:
            return
        check_step(known, known.names, start=clock.start_time, stop=clock.stop, h=clock.h)

    def unchecked(self, *, is_judged: bool) -> list[str]:
        """Return what cannot be checked of the alphas before the run.

        Parameters
        ----------
        is_judged : bool
            Whether the estimates are judged at its end.
        """
        unknown = self.regression.known.unknown
        if not unknown or len(self.regression.groups) < 2:
            return []
        names = ", ".join(repr(alpha.text) for alpha in unknown)
        when = "at its end" if is_judged else "nowhere, as no model of y is there to judge by"
        return [
            f"alpha {names}: only the run computes it, so that the products of the alphas are "
            f"checked for independence {when}"
        ]

    def check_distinguishable(self, bounds: Mapping[int, tuple[float, float]]) -> None:
        """Check that within bounds of theta no two terms say the same.

        Raises
        ------
        AssumptionError
            If two do.
        """
        clock = self._context.clock
        design = self.regression
        texts = [alpha.text for alpha in design.alphas]
        check_distinguishable(
            design.families,
            list(zip(texts, design.elements, strict=True)),
            texts,
            bounds=bounds,
            span=clock.steps * clock.h,
        )

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
        if self.observer.is_relinearized:
            return (
                f"{self.observer.name!r} is relinearized during the run, so y has no fixed model; "
                'expected relinearize = false, or method = "least-squares"'
            )
        model = self.observer.design.model
        n_d = model.reduced.C5.shape[1]
        elements = 1 + max(self.regression.elements)
        if n_d == elements and not model.constant:
            return ""
        what = "a constant input"
        if n_d != elements:
            what = f"{n_d} unknown disturbances, the terms describe {elements} elements of delta"
        return (
            f"the design model of {self.observer.name!r} has {what}; expected terms for every "
            'disturbance and no constant input, or method = "least-squares"'
        )

    def most_samples(self) -> int:
        """Return how many samples of y are taken in a step; 0: y at the communication points.

        Raises
        ------
        UsageError
            If y has values between samples, and these do not reach the identifier.
        """
        context = self._context
        drivers = context.drivers(Port(self.identifier, "samples"))
        most = [_most_in_a_step(name, kind, context) for name, kind in drivers.items()]
        if any(most):
            return max(most)
        sampled = _sampled_behind(Port(self.identifier, "y"), context)
        if sampled is not None:
            raise UsageError(
                f"y is interpolated between the samples of {sampled!r}; expected y directly from "
                "all outputs of one such component, or from sensors, with at most one scalar "
                "gain, so that the samples themselves can be used"
            )
        return 0

    def samples_at_points(self) -> bool:
        """Return whether all samples of y are of communication points."""
        drivers = self._context.drivers(Port(self.identifier, "samples"))
        return all(map(_samples_at_points, drivers.values()))

    def late_steps(self) -> int:
        """Return how many communication steps after its instant a sample of y may come."""
        drivers = self._context.drivers(Port(self.identifier, "samples"))
        sampled = [kind for kind in drivers.values() if isinstance(kind, HasSamples)]
        return max((kind.late_steps(self._context) for kind in sampled), default=0)


class ObserverSource:
    """The observer that drives a regressor alone.

    Parameters
    ----------
    name : str
    kind : UnknownInputObserverKind
    context : BuildContext
    """

    def __init__(self, name: str, kind: UnknownInputObserverKind, context: BuildContext) -> None:
        self.name = name
        self._kind = kind
        self._context = context

    @property
    def is_relinearized(self) -> bool:
        """Whether its model is linearized anew on the way."""
        return self._kind.relinearize

    @property
    def design(self) -> DesignedObserver:
        """Its design, and the model that it is designed on."""
        return self._kind.design(self.name, self._context)

    @property
    def transient(self) -> StateSpace:
        """The dynamics of the errors of delta."""
        return self._kind.transient(self.name, self._context)

    @property
    def reconstruction(self) -> AnyReconstruction:
        """How it makes delta."""
        return self._kind.reconstruction(self.name, self._context)

    @property
    def window(self) -> float:
        """How long it has no delta [s]."""
        return self.reconstruction.window

    @property
    def filter_rate(self) -> float | None:
        """The rate of its filter [rad/s]; None: it has none, or a window."""
        reconstruction = self.reconstruction
        if isinstance(reconstruction, FirstOrderFilter | ConsistentFilter):
            return reconstruction.rate
        return None

    @property
    def sampled_by(self) -> str | None:
        """The component between whose samples its y has values, too; None: there is none."""
        return _sampled_behind(Port(self.name, "y"), self._context)

    def plant(self, elements: Sequence[int]) -> DisturbedPlant:
        """Return its design model with a component of each of these elements of delta."""
        return disturbed_plant(self.design.model.reduced, elements)

    def units(self, interface: Interface) -> dict[str, PortUnit]:
        """Return the units of the signals that are taken where the observer takes them."""
        named: dict[str, PortUnit] = {}
        for port, designed in self.design.model.units.items():
            names = tuple(unit.name for unit in designed if unit.name is not None)
            if names:
                named[port] = names
        named |= self._kind.units
        units: dict[str, PortUnit] = {}
        for signal in interface.inputs:
            if signal.name == "samples" and "y" in named:
                most = interface.by_name[SAMPLE_TIMES].size
                units[signal.name] = units_of_samples(named["y"], most)
            elif signal.name in named:
                units[signal.name] = named[signal.name]
        return units


def sample_connections(
    name: str,
    connections: Mapping[Port, Connection],
    implied: Mapping[Port, ImpliedConnection],
    specs: Mapping[str, Kind],
) -> dict[Port, ImpliedConnection]:
    """Return the connections to the samples of what drives y, where it has any.

    Those of several elements stand one element behind the other, as the elements do in y.
    """
    to = Port(name, "y")
    y = connections.get(to)
    origin: Port | None = to
    if y is None and to in implied:
        y = implied[to].connection
        origin = implied[to].origin
    if y is None or y.matrix.ndim:
        return {}
    sampled = _sampled_outputs(y, specs)
    if sampled is None:
        return {}
    sources, timed_by = sampled
    samples = Connection(sources, y.gain, y.offset, y.unit)
    times = Connection(Port(timed_by, SAMPLE_TIMES))
    return {
        Port(name, "samples"): ImpliedConnection(samples, origin),
        Port(name, SAMPLE_TIMES): ImpliedConnection(times, origin),
    }


def _sampled_outputs(y: Connection, specs: Mapping[str, Kind]) -> tuple[list[Port], str] | None:
    """Return the samples of what drives y, and the component that has their times.

    Those that have no time of their own are of the communication points. None: there are no
    samples, or several components have times of their own.
    """
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
            return None
        sources.append(replace(source, signal=signal))
        timed_by = source.component
    return None if timed_by is None else (sources, timed_by)


def _observer_behind(regressor: str, context: BuildContext) -> ObserverSource | None:
    """Return the observer that drives a regressor alone; None: there is no such component."""
    name = context.driver(Port(regressor, "delta"))
    kind = None if name is None else context.spec(name)
    if name is None or not isinstance(kind, UnknownInputObserverKind):
        return None
    return ObserverSource(name, kind, context)


def _sampled_behind(to: Port, context: BuildContext) -> str | None:
    """Return the field data that an input follows, or a sensor with samples that drives it.

    None: there is none.
    """
    for name, spec in context.behind(to).items():
        if spec.is_recorded and not _samples_at_points(spec):
            return name
    for name, kind in context.drivers(to).items():
        if _most_in_a_step(name, kind, context):
            return name
    return None


def _samples_at_points(kind: Kind) -> bool:
    return not isinstance(kind, HasSamples) or kind.samples_at_points


def _most_in_a_step(name: str, kind: Kind, context: BuildContext) -> int:
    return kind.most_in_a_step(name, context) if isinstance(kind, HasSamples) else 0
