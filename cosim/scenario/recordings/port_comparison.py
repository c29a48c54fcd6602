"""Compare two components, before one takes the other's place: port by port, then as a whole.

A row has one aspect of one port in both components. Its verdict is "error" where the difference
stops the run, "differs" where it does not, "unknown" where one of them does not declare it, and
"ok". Numbers are compared in the unit of the component before; where one of the units is not
declared or not known, as they are. Where they are then more than ten times as large, or less than a
tenth, the units are probably not what they seem. For ports that are missing, ports of other names
are proposed.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.core.signals import Causality, Interface, Signal
from cosim.fmi.description import INTERFACE_TYPE_NAMES
from cosim.fmi.linearizing.linearization import is_singular, pole_text, poles
from cosim.scenario.kinds.values import LinearSystem
from cosim.scenario.record import ComparedAspect, PortVerdict
from cosim.units import (
    Conversion,
    Unit,
    comparable,
    conversion,
    conversions_between,
    units_text,
)

_WORST_FIRST: Final[tuple[PortVerdict, ...]] = ("error", "differs", "unknown", "ok")
SAME = 1e-9  # relative difference up to which two numbers are the same
ROUNDING = 1e-6  # numbers below are compared as if they were as large: what rounding leaves of 0


@dataclass(frozen=True, slots=True)
class ComponentCapabilities:
    """What a component can do for the master; None: unknown.

    Parameters
    ----------
    kind : str
        ``"model exchange"``, ``"co-simulation"``, ``"recording"``, or the kind of a component of
        ours.
    rollback, variable_step, interpolation, directional_derivatives : bool or None
        Goes back to a saved state; takes steps of any length; interpolates inputs inside a step;
        has its Jacobians.
    """

    kind: str
    rollback: bool | None = None
    variable_step: bool | None = None
    interpolation: bool | None = None
    directional_derivatives: bool | None = None

    @property
    def of_fmu(self) -> bool:
        """Whether they are those of an FMU; ``kind`` is then its interface type."""
        return self.kind in INTERFACE_TYPE_NAMES.values()

    def items(self) -> list[tuple[str, Any]]:
        """Return (aspect, value)."""
        pairs = []
        for name, value in asdict(self).items():
            pairs.append((name.replace("_", " "), value))
        return pairs


@dataclass(frozen=True, slots=True)
class LinearBehavior:
    """A component near its initial state.

    Parameters
    ----------
    system : LinearSystem
    has_ports : bool
        Whether its inputs and outputs are all those of the component.
    """

    system: LinearSystem
    has_ports: bool = True

    @property
    def poles(self) -> NDArray[np.complex128]:
        """Eigenvalues [1/s], sorted by real part."""
        return poles(self.system.A)

    @property
    def pairs(self) -> Vector:
        """Real and imaginary parts of the poles, in turn."""
        return self.poles.view(np.float64)

    @property
    def rate(self) -> float:
        """A rate between its modes, but on none of a single oscillation [rad/s]."""
        sizes = np.abs(self.poles)
        sizes = sizes[sizes > 0.0]
        return float(np.sqrt(2.0) * np.exp(np.log(sizes).mean())) if len(sizes) else 1.0

    def response(self, rate: float) -> tuple[NDArray[np.complex128], Matrix] | None:
        """Return D + C (j rate - A)^-1 B, shape (n_y, n_u), and the absolute sums of its terms.

        Rounding is relative to these. None where ports are missing, or where the inverse, with A
        known up to its error, may be singular.
        """
        A, B, C, D = (self.system.A, self.system.B, self.system.C, self.system.D)
        dynamics = 1j * rate * np.eye(len(A)) - A
        if not self.has_ports or is_singular(dynamics, error=self.system.error):
            return None
        states = np.linalg.solve(dynamics, B)
        values = np.asarray(D + C @ states, np.complex128)
        return values, np.abs(D) + np.abs(C) @ np.abs(states)


@dataclass(frozen=True, slots=True)
class ComparedComponent:
    """What is known of a component before it runs.

    Parameters
    ----------
    interface : Interface
    capabilities : ComponentCapabilities
    start : mapping of input name to Vector
        Values of inputs that nothing drives; unknown where not named.
    initial : mapping of output name to Vector
        Initial outputs for the scenario's inputs; unknown where not named.
    nominal : mapping of port to Vector
        Typical sizes that an FMU declares (FMI: nominal); unknown where not named.
    linear : LinearBehavior or None
        None: it cannot be linearized.
    """

    interface: Interface
    capabilities: ComponentCapabilities
    start: Mapping[str, Vector] = field(default_factory=dict)
    initial: Mapping[str, Vector] = field(default_factory=dict)
    nominal: Mapping[str, Vector] = field(default_factory=dict)
    linear: LinearBehavior | None = None

    def port(self, name: str) -> ComparedPort | None:
        """Return a port; None: there is none."""
        signal = self.interface.by_name.get(name)
        if signal is None:
            return None
        is_input = name in self.interface.input_names
        return ComparedPort(self, signal, "input" if is_input else "output")

    @property
    def ports(self) -> list[str]:
        """Names of the inputs, then of the outputs."""
        return [signal.name for signal in self.interface.signals]


@dataclass(frozen=True, slots=True)
class ComparedPort:
    """A port of a compared component, or one element of it."""

    component: ComparedComponent
    signal: Signal
    causality: Causality
    element: int | None = None

    @property
    def size(self) -> int:
        """Number of elements."""
        return self.signal.size if self.element is None else 1

    @property
    def units(self) -> tuple[Unit, ...]:
        """The units of its elements."""
        units = self.signal.measures
        return units if self.element is None else units[self.element : self.element + 1]

    def units_for(self, size: int) -> tuple[Unit, ...]:
        """Return the units of its elements; of another number of them, the first for all."""
        units = self.units
        return units if len(units) == size else units[:1] * size

    @property
    def start(self) -> list[float] | None:
        """Value of an input that nothing drives; None: unknown."""
        values = self.component.start.get(self.signal.name)
        return self._elements_of(values)

    @property
    def initial(self) -> list[float] | None:
        """Initial value of an output; None: unknown."""
        values = self.component.initial.get(self.signal.name)
        return self._elements_of(values)

    @property
    def nominal(self) -> list[float] | None:
        """Typical size; None: unknown."""
        values = self.component.nominal.get(self.signal.name)
        return self._elements_of(values)

    @property
    def feedthrough(self) -> tuple[str, ...] | None:
        """Inputs with direct feedthrough to an output, or outputs of an input; None: unknown."""
        interface = self.component.interface
        if self.causality == "output":
            known = interface.knows(self.signal.name)
            return interface.feeds(self.signal.name) if known else None
        outputs = [output.name for output in interface.outputs]
        if not all(interface.knows(name) for name in outputs):
            return None
        own_name = self.signal.name
        return tuple(name for name in outputs if own_name in interface.feeds(name))

    @property
    def gains(self) -> list[float] | None:
        """Static gains to or from it, in rising order; None: unknown."""
        linear = self.component.linear
        response = None if linear is None else linear.response(0.0)
        if response is None:
            return None
        gain = response[0].real
        interface = self.component.interface
        if self.causality == "output":
            columns = interface.output_columns()[self.signal.name]
        else:
            columns = interface.input_columns()[self.signal.name]
            gain = gain.T
        rows = gain[columns]
        if self.element is not None:
            rows = rows[self.element]
        return sorted(rows.ravel().tolist())

    def responses(self, rate: float, units_of: ComparedComponent) -> dict[str, Entry] | None:
        """Return the responses of an output to each input, in the units of another component.

        By input and output element, as ``u[0] -> y``. None: unknown.
        """
        linear = self.component.linear
        response = None if linear is None else linear.response(rate)
        if response is None:
            return None
        interface = self.component.interface
        from_inputs = 1.0 / _factors(interface.inputs, units_of)
        factors = _factors(interface.outputs, units_of)[:, np.newaxis] * from_inputs
        values = factors * response[0]
        terms = np.abs(factors) * response[1]
        first = interface.output_columns()[self.signal.name].start
        inputs = [name for signal in interface.inputs for name in signal.elements]
        entries = {}
        for i, output in enumerate(self.signal.elements, start=first):
            for j, name in enumerate(inputs):
                entries[f"{name} -> {output}"] = Entry(complex(values[i, j]), float(terms[i, j]))
        return entries

    def _elements_of(self, values: Vector | None) -> list[float] | None:
        if values is None:
            return None
        numbers: list[float] = values.tolist()
        return numbers if self.element is None else [numbers[self.element]]


class Entry(NamedTuple):
    """One entry of a response, and the absolute sum of the terms that it is computed from."""

    value: complex
    terms: float


def _factors(signals: Sequence[Signal], other: ComparedComponent) -> Vector:
    """Return the factor of each element from its unit to that of the port of its name."""
    factors: list[float] = []
    for signal in signals:
        port = other.port(signal.name)
        units = signal.measures if port is None else port.units_for(signal.size)
        for convert in conversions_between(signal.measures, units):
            factors.append(1.0 if convert is None else convert.factor)
    return np.array(factors)


def compare_components(
    before: ComparedComponent,
    after: ComparedComponent,
    *,
    names: Mapping[str, str] | None = None,
    connected: Collection[str] = (),
    refused: Collection[str] = (),
) -> tuple[ComparedAspect, ...]:
    """Compare ``after`` with ``before``.

    Parameters
    ----------
    before, after : ComparedComponent
    names : mapping of port to str, optional
        What ports of ``after`` stand for in the new component, where that is no port of its name.
    connected : collection of str
        Ports that the scenario names.
    refused : collection of str
        Those of them whose connection stops the run: only they can be errors.
    """
    rows: list[ComparedAspect] = []
    sources = {} if names is None else names
    for port in dict.fromkeys([*before.ports, *after.ports]):
        severity: PortVerdict = "error" if port in refused else "differs"
        old = before.port(port)
        new = after.port(port)
        for aspect in _port_aspects(old, new, severity):
            source = sources.get(port)
            rows.append(replace(aspect, port=port, connected=port in connected, source=source))
    return (*rows, *_whole_aspects(before, after))


def _port_aspects(
    old: ComparedPort | None, new: ComparedPort | None, severity: PortVerdict
) -> Iterator[ComparedAspect]:
    """Yield the aspects of a port; ``severity`` is the verdict where a connection cannot hold."""
    if old is None or new is None:
        old_causality = None if old is None else old.causality
        new_causality = None if new is None else new.causality
        yield ComparedAspect("", "causality", old_causality, new_causality, severity)
        return
    yield _equal("causality", old.causality, new.causality, severity)
    yield _equal("type", old.signal.type, new.signal.type)
    yield _equal("size", old.size, new.size, severity)
    unit_verdict = _unit(old, new, severity)
    yield ComparedAspect(
        "", "unit", units_text(old.units) or None, units_text(new.units) or None, unit_verdict
    )
    yield _equal("variability", old.signal.variability, new.signal.variability)
    nominal = _in_unit_of(old, new, new.nominal)
    ratio = _ratio(old.nominal, nominal)
    row = ComparedAspect("", "nominal", old.nominal, new.nominal, "ok", ratio=ratio)
    yield replace(row, verdict="differs") if row.of_another_size else row
    if old.causality != new.causality:
        return
    if old.causality == "input":
        start = _in_unit_of(old, new, new.start)
        yield _numbers("start value", old.start, new.start, start)
    else:
        yield from _output_aspects(old, new)


def _output_aspects(old: ComparedPort, new: ComparedPort) -> Iterator[ComparedAspect]:
    yield _equal("feedthrough", _inputs_of(old), _inputs_of(new))
    initial = _in_unit_of(old, new, new.initial)
    yield _numbers("initial output", old.initial, new.initial, initial)
    yield from _response_aspects(old, new)


def _response_aspects(old: ComparedPort, new: ComparedPort) -> Iterator[ComparedAspect]:
    """Compare static gains; where they and the poles do not differ, responses at a rate too."""
    linear = old.component.linear or new.component.linear
    if linear is None:
        return
    error = _error(old.component, new.component)
    rates = {"static gain": 0.0}
    if all(aspect.verdict != "differs" for aspect in _poles(old.component, new.component)):
        rates[f"response at {linear.rate:.3g} rad/s"] = linear.rate
    for aspect, rate in rates.items():
        before = old.responses(rate, old.component)
        after = new.responses(rate, old.component)
        if before is not None or after is not None:
            row = _compared_responses(aspect, before, after, error)
            yield row
            if row.verdict == "differs":
                return


def _compared_responses(
    aspect: str, before: dict[str, Entry] | None, after: dict[str, Entry] | None, error: float
) -> ComparedAspect:
    """Compare element by element where both have it; show those that differ, or all."""
    if before is None or after is None:
        return ComparedAspect("", aspect, _plain(before), _plain(after), "unknown")
    both = [name for name in before if name in after]
    different = []
    for name in both:
        tolerance = error * max(before[name].terms, after[name].terms)
        if abs(after[name].value - before[name].value) > tolerance:
            different.append(name)
    ratio = _ratio(
        [abs(before[name].value) for name in both], [abs(after[name].value) for name in both]
    )
    shown_names = different or both
    return ComparedAspect(
        "",
        aspect,
        _plain({name: before[name] for name in shown_names}),
        _plain({name: after[name] for name in shown_names}),
        "differs" if different else "ok",
        ratio=ratio,
    )


def _plain(entries: Mapping[str, Entry] | None) -> dict[str, Any] | None:
    """Return values for a row: numbers, or real and imaginary parts."""
    if entries is None:
        return None
    values = {name: entry.value for name, entry in entries.items()}
    return {n: v.real if v.imag == 0.0 else [v.real, v.imag] for n, v in values.items()}


def _numbers(
    aspect: str,
    before: Sequence[float] | None,
    after: Sequence[float] | None,
    converted: Sequence[float] | Vector | None,
) -> ComparedAspect:
    """Compare numbers; ``converted`` are those after in the unit of those before."""
    verdict = _same_values(before, converted, least=ROUNDING)
    return ComparedAspect("", aspect, before, after, verdict, ratio=_ratio(before, converted))


def _ratio(
    before: Sequence[float] | None, converted: Sequence[float] | Vector | None
) -> float | None:
    """Return the ratio of the largest numbers; None: one of them is zero, or not known."""
    if before is None or converted is None:
        return None
    old = _largest(before)
    new = _largest(converted)
    return new / old if old > 0.0 and new > 0.0 else None


def _largest(values: Sequence[float] | Vector) -> float:
    """Return the largest finite absolute value; 0: there is none."""
    sizes = np.abs(np.array(values))
    return float(np.max(sizes, initial=0.0, where=np.isfinite(sizes)))


def _inputs_of(output: ComparedPort) -> str | list[str]:
    """Return the inputs with direct feedthrough to an output, as a row has them."""
    return "unknown" if output.feedthrough is None else sorted(output.feedthrough)


def _whole_aspects(before: ComparedComponent, after: ComparedComponent) -> Iterator[ComparedAspect]:
    new_capabilities = dict(after.capabilities.items())
    for aspect, old in before.capabilities.items():
        new = new_capabilities[aspect]
        unknown = old is not new and (old is None or new is None)
        if aspect == "kind" and before.capabilities.of_fmu and after.capabilities.of_fmu:
            aspect = "interface type"
        yield _equal(aspect, old, new, "unknown" if unknown else "differs")
    yield from _poles(before, after)


def _poles(before: ComparedComponent, after: ComparedComponent) -> Iterator[ComparedAspect]:
    if before.linear is None and after.linear is None:
        return
    old_poles = None if before.linear is None else before.linear.pairs
    new_poles = None if after.linear is None else after.linear.pairs
    verdict = _same_values(old_poles, new_poles, _error(before, after))
    yield ComparedAspect("", "poles", _complex_pairs(old_poles), _complex_pairs(new_poles), verdict)


def _equal(aspect: str, old: Any, new: Any, severity: PortVerdict = "differs") -> ComparedAspect:
    return ComparedAspect("", aspect, old, new, "ok" if old == new else severity)


def _error(*components: ComparedComponent) -> float:
    """Return how far numbers may be apart: ten times the error of the derivatives."""
    errors = []
    for component in components:
        if component.linear is not None:
            errors.append(10.0 * component.linear.system.error)
    return max([SAME, *errors])


def _complex_pairs(poles: Vector | None) -> list[list[float]] | None:
    return None if poles is None else poles.reshape(-1, 2).tolist()


def _unit(old: ComparedPort, new: ComparedPort, severity: PortVerdict) -> PortVerdict:
    """Return the worst verdict of an element; of ports of other sizes, of the first elements."""
    verdicts: set[PortVerdict] = set()
    for before, after in set(zip(old.units, new.units, strict=False)):
        converted = conversion(after, before)
        if before.name is None and after.name is None:
            verdicts.add("ok")
        elif not comparable(before, after):
            verdicts.add("unknown")
        elif converted is None:
            verdicts.add(severity)
        else:
            verdicts.add("ok" if converted.copies else "differs")
    return next(verdict for verdict in _WORST_FIRST if verdict in verdicts)


def _conversions(old: ComparedPort, new: ComparedPort) -> list[Conversion | None]:
    """Return the conversions of elements of ``new`` to the units of ``old``, where there are."""
    return conversions_between(new.units, old.units_for(new.size))


def _in_unit_of(
    old: ComparedPort, new: ComparedPort, values: Sequence[float] | None
) -> Vector | None:
    """Return values of ``new`` in the unit of ``old``, where they can be converted."""
    if values is None:
        return None
    converted = []
    for value, convert in zip(values, _conversions(old, new), strict=True):
        converted.append(value if convert is None else convert(value))
    return np.array(converted)


def _same_values(
    old: Sequence[float] | Vector | None,
    new: Sequence[float] | Vector | None,
    error: float = SAME,
    *,
    least: float = 1.0,
) -> PortVerdict:
    if old is None or new is None:
        return "ok" if old is new else "unknown"
    return "ok" if _close(old, new, error, least) else "differs"


def _close(
    old: Sequence[float] | Vector, new: Sequence[float] | Vector, error: float, least: float = 1.0
) -> bool:
    if len(old) != len(new):
        return False
    old_values = np.array(old)
    new_values = np.array(new)
    largest = np.nanmax(np.abs(old_values), initial=0.0)
    tolerance = error * max(least, largest)
    return bool(np.allclose(old_values, new_values, rtol=0.0, atol=tolerance, equal_nan=True))


# --- ports of other names ---


@dataclass(frozen=True, slots=True)
class Proposal:
    """A port that may be the one that is missing, with the reasons."""

    port: str
    name: str
    reasons: tuple[str, ...]


def propose(
    before: ComparedComponent, after: ComparedComponent, missing: Collection[str]
) -> tuple[Proposal, ...]:
    """Propose ports of ``after`` alone for those of ``before`` that are ``missing`` there.

    A candidate has the causality, size and type of the missing port and a unit that converts to
    its own. The likeliest agree in most of: declared unit, number of direct dependencies, initial
    output, static gains; several where they are equally likely.
    """
    free = [name for name in after.ports if name not in before.ports]
    proposals: list[Proposal] = []
    for name in missing:
        old = before.port(name)
        if old is None:
            continue
        reasons = {}
        for candidate, port in _candidates(after, free, old):
            if _fits(old, port):
                reasons[candidate] = _reasons(old, port)
        most = max(map(len, reasons.values()), default=0)
        for candidate, its_reasons in reasons.items():
            if len(its_reasons) == most:
                proposals.append(Proposal(name, candidate, its_reasons))
    return tuple(proposals)


def _candidates(
    after: ComparedComponent, free: Sequence[str], old: ComparedPort
) -> Iterator[tuple[str, ComparedPort]]:
    """Yield ports, and for a missing scalar the elements of vectors too."""
    for name in free:
        port = after.port(name)
        if port is None:
            continue
        yield name, port
        if port.causality == "output" and old.size == 1 < port.size:
            for i in range(port.size):
                yield f"{name}[{i}]", ComparedPort(after, port.signal, "output", i)


def _fits(old: ComparedPort, new: ComparedPort) -> bool:
    same_causality = old.causality == new.causality
    same_size = old.size == new.size
    same_type = old.signal.type == new.signal.type
    converts = None not in _conversions(old, new)
    return same_causality and same_size and same_type and converts


def _reasons(old: ComparedPort, new: ComparedPort) -> tuple[str, ...]:
    signal = new.signal
    reasons = [f"{new.causality} of size {new.size}, {signal.type}"]
    if old.signal.unit is not None and signal.unit is not None:
        reasons.append(f"unit {units_text(new.units)!r}")
    if _same_count(old.feedthrough, new.feedthrough):
        reasons.append(feedthrough_text(new.causality, new.feedthrough or ()))
    initial = new.initial
    converted = _in_unit_of(old, new, initial)
    same_initial = _same_values(old.initial, converted) == "ok"
    if initial is not None and same_initial:
        reasons.append(f"initial output {shown(initial)}")
    gains = new.gains
    error = _error(old.component, new.component)
    if old.gains and gains and _close(old.gains, gains, error):
        reasons.append(f"static gains {shown(gains)}")
    return tuple(reasons)


def _same_count(old: Sequence[str] | None, new: Sequence[str] | None) -> bool:
    return old is not None and new is not None and len(old) == len(new)


# --- values as people read them ---


def feedthrough_text(causality: Causality, ports: str | Sequence[str]) -> str:
    """Return a sentence on the direct feedthrough from inputs to an output, or back."""
    if not ports:
        return "no direct feedthrough"
    preposition = "from" if causality == "output" else "to"
    names = ports if isinstance(ports, str) else ", ".join(ports)
    return f"direct feedthrough {preposition} {names}"


def shown(value: Any, digits: int = 6) -> str:
    """Return a value of a row as people read it."""
    match value:
        case None:
            return "-"
        case bool():
            return "yes" if value else "no"
        case float():
            return f"{value:.{digits}g}"
        case Mapping():
            entries = [f"{name} {_entry_text(entry, digits)}" for name, entry in value.items()]
            return ", ".join(entries)
        case [[_, _], *_]:
            return ", ".join(pole_text(complex(real, imag), digits) for real, imag in value)
        case [*values]:
            return " ".join(shown(one, digits) for one in values)
        case _:
            return str(value)


def _entry_text(entry: float | list[float], digits: int) -> str:
    """Return a gain, or amplitude and phase."""
    if isinstance(entry, float):
        return shown(entry, digits)
    value = complex(*entry)
    phase = math.degrees(cmath.phase(value))
    return f"{abs(value):.{digits}g} at {phase:.{digits}g} deg"


def different_texts(before: Any, after: Any) -> tuple[str, str]:
    """Return two values with as many digits as it takes to tell them apart, at least six."""
    for digits in (6, 9, 12, 17):
        texts = (shown(before, digits), shown(after, digits))
        if texts[0] != texts[1]:
            break
    return texts
