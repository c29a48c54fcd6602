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
from dataclasses import dataclass, field, replace
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np

from cosim.arrays import Vector
from cosim.core.signals import Causality, Interface, Signal
from cosim.fmi.description import INTERFACE_TYPE_NAMES
from cosim.fmi.linearizing.linearization import is_singular, pole_text, poles
from cosim.scenario.kinds.values import LinearSystem
from cosim.scenario.record import ComparedAspect, PortVerdict
from cosim.units import Unit, comparable, conversion, conversions_between, units_text

# of what a component can do for the master, beside its kind
CAPABILITIES: Final = ("rollback", "variable step", "interpolation", "directional derivatives")
START: Final = "start value"
INITIAL: Final = "initial output"
NOMINAL: Final = "nominal"
_WORST_FIRST: Final[tuple[PortVerdict, ...]] = ("error", "differs", "unknown", "ok")
_SAME: Final = 1e-9  # relative difference up to which two numbers are the same
_ROUNDING: Final = 1e-6  # smaller numbers are compared as if they were as large

_PortElements: TypeAlias = Sequence[float] | Vector | None  # None: unknown


class Entry(NamedTuple):
    """One entry of a response, and the absolute sum of the terms that it is computed from."""

    value: complex
    terms: float


# of an output, by elements of input and output
Response: TypeAlias = Mapping[tuple[str, str], Entry]
Responses: TypeAlias = Mapping[str, Response]  # by output


@dataclass(frozen=True, slots=True)
class ComparedComponent:
    """What is known of a component before it runs.

    Parameters
    ----------
    interface : Interface
    capabilities : mapping of str to plain value
        Its ``"kind"``: ``"model exchange"``, ``"co-simulation"``, ``"recording"``, or that of a
        component of ours; and whether it has each of ``CAPABILITIES``, where that is known.
    values : mapping of aspect to mapping of port to Vector
        Start values of inputs that nothing drives, initial outputs for the scenario's inputs,
        nominal sizes that an FMU declares; unknown where not named.
    system : LinearSystem or None
        Near its initial state; its inputs and outputs are all those of the component, or some are
        missing. None: it cannot be linearized.
    """

    interface: Interface
    capabilities: Mapping[str, Any]
    values: Mapping[str, Mapping[str, Vector]] = field(default_factory=dict)
    system: LinearSystem | None = None

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
        return list(self.interface.by_name)

    def responses(self, rate: float, units_of: ComparedComponent) -> Responses | None:
        """Return D + C (j rate - A)^-1 B [rad/s], in the units of another component.

        None where it is unknown, or where the inverse, with A known up to its error, may be
        singular. Rounding is relative to the terms.
        """
        system = self.system
        interface = self.interface
        if system is None or system.D.shape != (interface.n_y, interface.n_u):
            return None
        dynamics = 1j * rate * np.eye(len(system.A)) - system.A
        if is_singular(dynamics, error=system.error):
            return None
        states = np.linalg.solve(dynamics, system.B)
        from_inputs = 1.0 / _factors(interface.inputs, units_of)
        factors = _factors(interface.outputs, units_of)[:, np.newaxis] * from_inputs
        values = factors * (system.D + system.C @ states)
        terms = np.abs(factors) * (np.abs(system.D) + np.abs(system.C) @ np.abs(states))
        inputs = [name for signal in interface.inputs for name in signal.elements]
        responses: dict[str, dict[tuple[str, str], Entry]] = {}
        row = 0
        for signal in interface.outputs:
            entries = responses[signal.name] = {}
            for output in signal.elements:
                for column, name in enumerate(inputs):
                    entry = Entry(complex(values[row, column]), float(terms[row, column]))
                    entries[name, output] = entry
                row += 1
        return responses


def _factors(signals: Sequence[Signal], other: ComparedComponent) -> Vector:
    """Return the factor of each element from its unit to that of the port of its name."""
    factors: list[float] = []
    for signal in signals:
        port = other.port(signal.name)
        units = signal.measures if port is None else port.units_for(signal.size)
        for convert in conversions_between(signal.measures, units):
            factors.append(1.0 if convert is None else convert.factor)
    return np.array(factors)


@dataclass(frozen=True, slots=True)
class ComparedPort:
    """A port of a compared component, or one element of it."""

    component: ComparedComponent
    signal: Signal
    causality: Causality
    element: int | None = None

    @property
    def elements(self) -> slice:
        """Which elements of its signal it has."""
        return slice(None) if self.element is None else slice(self.element, self.element + 1)

    @property
    def units(self) -> tuple[Unit, ...]:
        """The units of its elements."""
        return self.signal.measures[self.elements]

    @property
    def size(self) -> int:
        """Number of elements."""
        return len(self.units)

    def units_for(self, size: int) -> tuple[Unit, ...]:
        """Return the units of its elements; of another number of them, the first for all."""
        units = self.units
        return units if len(units) == size else units[:1] * size

    def values(self, aspect: str) -> list[float] | None:
        """Return start values, initial outputs or nominal sizes; None: unknown."""
        values = self.component.values.get(aspect, {}).get(self.signal.name)
        return None if values is None else values[self.elements].tolist()

    @property
    def feedthrough(self) -> list[str] | None:
        """Inputs with direct feedthrough to an output, or outputs of an input; None: unknown."""
        interface = self.component.interface
        name = self.signal.name
        if self.causality == "output":
            return sorted(interface.feeds(name)) if interface.knows(name) else None
        outputs = [output.name for output in interface.outputs]
        if not all(map(interface.knows, outputs)):
            return None
        return [output for output in outputs if name in interface.feeds(output)]

    @property
    def gains(self) -> list[float] | None:
        """Static gains to or from it, in rising order; None: unknown."""
        responses = self.component.responses(0.0, self.component)
        if responses is None:
            return None
        names = self.signal.elements[self.elements]
        gains = []
        for entries in responses.values():
            for ends, entry in entries.items():
                if not set(names).isdisjoint(ends):
                    gains.append(entry.value.real)
        return sorted(gains)


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
    sources = names or {}
    pole_row = _poles(before, after)
    responses = _responses(before, after, same_poles=pole_row.verdict != "differs")
    for name in dict.fromkeys([*before.ports, *after.ports]):
        severity: PortVerdict = "error" if name in refused else "differs"
        for row in _port_rows(before.port(name), after.port(name), severity, responses):
            source = sources.get(name)
            rows.append(replace(row, port=name, connected=name in connected, source=source))
    fmu_kinds = INTERFACE_TYPE_NAMES.values()
    of_fmus = all(c.capabilities["kind"] in fmu_kinds for c in (before, after))
    for key in ("kind", *CAPABILITIES):
        old = before.capabilities.get(key)
        new = after.capabilities.get(key)
        is_unknown = old is not new and (old is None or new is None)
        aspect = "interface type" if key == "kind" and of_fmus else key
        rows.append(_equal(aspect, old, new, "unknown" if is_unknown else "differs"))
    if before.system is not None or after.system is not None:
        rows.append(pole_row)
    return tuple(rows)


def _port_rows(
    old: ComparedPort | None,
    new: ComparedPort | None,
    severity: PortVerdict,
    responses: Mapping[str, tuple[Responses | None, Responses | None]],
) -> Iterator[ComparedAspect]:
    """Yield the aspects of a port; ``severity`` is the verdict where a connection cannot hold."""
    if old is None or new is None:
        there, here = (None if port is None else port.causality for port in (old, new))
        yield ComparedAspect("", "causality", there, here, severity)
        return
    yield _equal("causality", old.causality, new.causality, severity)
    yield _equal("type", old.signal.type, new.signal.type)
    yield _equal("size", old.size, new.size, severity)
    old_units, new_units = (units_text(port.units) or None for port in (old, new))
    yield ComparedAspect("", "unit", old_units, new_units, _unit(old, new, severity))
    yield _equal("variability", old.signal.variability, new.signal.variability)
    nominal = _numbers(NOMINAL, old, new)
    yield replace(nominal, verdict="differs" if nominal.of_another_size else "ok")
    if old.causality != new.causality:
        return
    if old.causality == "input":
        yield _numbers(START, old, new)
        return
    ways = ["unknown" if port.feedthrough is None else port.feedthrough for port in (old, new)]
    yield _equal("feedthrough", ways[0], ways[1])
    yield _numbers(INITIAL, old, new)
    error = _error(old.component, new.component)
    for aspect, of_both in responses.items():
        before, after = (None if own is None else own[old.signal.name] for own in of_both)
        if before is not None or after is not None:
            row = _response_row(aspect, before, after, error)
            yield row
            if row.verdict == "differs":
                return


def _responses(
    before: ComparedComponent, after: ComparedComponent, *, same_poles: bool
) -> dict[str, tuple[Responses | None, Responses | None]]:
    """Return static gains; where these and the poles may be equal, responses at a rate too."""
    system = before.system or after.system
    if system is None:
        return {}
    rates = {"static gain": 0.0}
    if same_poles:
        rate = rate_between(system)
        rates[f"response at {rate:.3g} rad/s"] = rate
    return {
        aspect: (before.responses(rate, before), after.responses(rate, before))
        for aspect, rate in rates.items()
    }


def rate_between(system: LinearSystem) -> float:
    """Return a rate between the modes, but on none of a single oscillation [rad/s]."""
    sizes = np.abs(poles(system.A))
    sizes = sizes[sizes > 0.0]
    return float(np.sqrt(2.0) * np.exp(np.log(sizes).mean())) if len(sizes) else 1.0


def _response_row(
    aspect: str,
    before: Response | None,
    after: Response | None,
    error: float,
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
    old, new = ([abs(entries[name].value) for name in both] for entries in (before, after))
    old_values, new_values = (
        _plain({name: entries[name] for name in different or both}) for entries in (before, after)
    )
    verdict: PortVerdict = "differs" if different else "ok"
    return ComparedAspect("", aspect, old_values, new_values, verdict, ratio=_ratio(old, new))


def _plain(entries: Response | None) -> dict[str, Any] | None:
    """Return values for a row: numbers, or real and imaginary parts."""
    if entries is None:
        return None
    plain = {}
    for (u, y), (value, _) in entries.items():
        plain[f"{u} -> {y}"] = value.real if value.imag == 0.0 else [value.real, value.imag]
    return plain


def _poles(before: ComparedComponent, after: ComparedComponent) -> ComparedAspect:
    old, new = (
        None if system is None else poles(system.A).view(np.float64)
        for system in (before.system, after.system)
    )
    verdict = _same_values(old, new, _error(before, after))
    pairs = [None if values is None else values.reshape(-1, 2).tolist() for values in (old, new)]
    return ComparedAspect("", "poles", pairs[0], pairs[1], verdict)


def _numbers(aspect: str, old: ComparedPort, new: ComparedPort) -> ComparedAspect:
    """Compare numbers, those after in the unit of those before."""
    before = old.values(aspect)
    converted = _in_unit_of(old, new, aspect)
    verdict = _same_values(before, converted, least=_ROUNDING)
    ratio = _ratio(before, converted)
    return ComparedAspect("", aspect, before, new.values(aspect), verdict, ratio=ratio)


def _ratio(before: _PortElements, converted: _PortElements) -> float | None:
    """Return the ratio of the largest numbers; None: one of them is zero, or not known."""
    if before is None or converted is None:
        return None
    old, new = (
        float(np.max(np.abs(values), initial=0.0, where=np.isfinite(values)))
        for values in (np.array(before), np.array(converted))
    )
    return new / old if old > 0.0 and new > 0.0 else None


def _equal(aspect: str, old: Any, new: Any, severity: PortVerdict = "differs") -> ComparedAspect:
    return ComparedAspect("", aspect, old, new, "ok" if old == new else severity)


def _error(*components: ComparedComponent) -> float:
    """Return how far numbers may be apart: ten times the error of the derivatives."""
    systems = [component.system for component in components]
    return max([_SAME, *(10.0 * system.error for system in systems if system is not None)])


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


def _in_unit_of(old: ComparedPort, new: ComparedPort, aspect: str) -> Vector | None:
    """Return values of ``new`` in the unit of ``old``, where they can be converted."""
    values = new.values(aspect)
    if values is None:
        return None
    conversions = conversions_between(new.units, old.units_for(new.size))
    pairs = zip(values, conversions, strict=True)
    return np.array([value if convert is None else convert(value) for value, convert in pairs])


def _same_values(
    old: _PortElements, new: _PortElements, error: float = _SAME, *, least: float = 1.0
) -> PortVerdict:
    """Compare numbers relative to the largest, but at least to ``least``."""
    if old is None or new is None:
        return "ok" if old is new else "unknown"
    tolerance = error * max(least, np.nanmax(np.abs(np.array(old)), initial=0.0))
    is_same = len(old) == len(new) and np.allclose(
        old, new, rtol=0.0, atol=tolerance, equal_nan=True
    )
    return "ok" if is_same else "differs"


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
    proposals: list[Proposal] = []
    for name in missing:
        old = before.port(name)
        if old is None:
            continue
        fitting = []
        for candidate, port in _candidates(before, after, old):
            reasons = _reasons(old, port)
            if reasons:
                fitting.append(Proposal(name, candidate, reasons))
        most = max((len(proposal.reasons) for proposal in fitting), default=0)
        proposals += [proposal for proposal in fitting if len(proposal.reasons) == most]
    return tuple(proposals)


def _candidates(
    before: ComparedComponent, after: ComparedComponent, old: ComparedPort
) -> Iterator[tuple[str, ComparedPort]]:
    """Yield ports, and for a missing scalar the elements of vectors too."""
    for name in after.ports:
        port = after.port(name)
        if port is None or name in before.ports:
            continue
        yield name, port
        if port.causality == "output" and old.size == 1 < port.size:
            for i in range(port.size):
                yield f"{name}[{i}]", replace(port, element=i)


def _reasons(old: ComparedPort, new: ComparedPort) -> tuple[str, ...]:
    """Return what a port has in common with a missing one; nothing where it cannot be that."""
    signal = new.signal
    if (old.causality, old.size, old.signal.type) != (new.causality, new.size, signal.type):
        return ()
    if None in conversions_between(new.units, old.units):
        return ()
    reasons = [f"{new.causality} of size {new.size}, {signal.type}"]
    if old.signal.unit is not None and signal.unit is not None:
        reasons.append(f"unit {units_text(new.units)!r}")
    ways = (old.feedthrough, new.feedthrough)
    if ways[0] is not None and ways[1] is not None and len(ways[0]) == len(ways[1]):
        reasons.append(feedthrough_text(new.causality, ways[1]))
    initial = new.values(INITIAL)
    is_same = _same_values(old.values(INITIAL), _in_unit_of(old, new, INITIAL)) == "ok"
    if initial is not None and is_same:
        reasons.append(f"initial output {shown(initial)}")
    gains = (old.gains, new.gains)
    error = _error(old.component, new.component)
    if gains[0] and gains[1] and _same_values(*gains, error) == "ok":
        reasons.append(f"static gains {shown(gains[1])}")
    return tuple(reasons)


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
            return ", ".join(f"{n} {_entry_text(entry, digits)}" for n, entry in value.items())
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
