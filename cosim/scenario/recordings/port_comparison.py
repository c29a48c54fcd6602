"""Compare two components, before one takes the other's place: port by port, then as a whole.

A row has one aspect of one port in both components; there is none where neither says anything. Its
verdict is "error" where the difference stops the run, "differs" where it does not, "unknown" where
one of them does not declare it, and "ok". Numbers are compared in the unit of the component before;
where one of the units is not declared or not known, as they are. Where they are then more than ten
times as large, or less than a tenth, the units are probably not what they seem. For ports that are
missing, ports of other names are proposed.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from cosim.arrays import Vector
from cosim.core.signals import Causality, Interface
from cosim.fmi.description import INTERFACE_TYPE_NAMES
from cosim.fmi.linearizing.linearization import is_singular, pole_text, poles
from cosim.scenario.kinds.values import LinearSystem
from cosim.scenario.record import ComparedAspect, PortVerdict
from cosim.units import Conversion, Unit, comparable, conversion, conversions_between, units_text

# of what a component can do for the master, beside its kind
CAPABILITIES: Final = ("rollback", "variable step", "interpolation", "directional derivatives")
START: Final = "start value"
INITIAL: Final = "initial output"
NOMINAL: Final = "nominal"
_WORST_FIRST: Final[tuple[PortVerdict, ...]] = ("error", "differs", "unknown", "ok")
_NOTHING: Final = (None, "unknown")  # in the place of a value that is not known
_SAME: Final = 1e-9  # relative difference up to which two numbers are the same
_ROUNDING: Final = 1e-6  # smaller numbers are compared as if they were as large

# by elements of input and output: the value, and the absolute sum of its terms
Responses: TypeAlias = Mapping[tuple[str, str], tuple[complex, float]]
_NewRow: TypeAlias = Callable[..., ComparedAspect]  # of (aspect, before, after, verdict)


@dataclass(frozen=True, slots=True)
class DescribedPort:
    """What is known of a port, or of one element of it.

    Parameters
    ----------
    causality : {"input", "output"}
    type, variability : str
    units : tuple of Unit
        Of its elements.
    elements : list of str
        Their names.
    feedthrough : list of str or None
        Inputs with direct feedthrough to an output, or outputs of an input; None: unknown.
    numbers : mapping of aspect to list of float
        Start values, initial outputs, nominal sizes; unknown where not named.
    """

    causality: Causality
    type: str
    variability: str
    units: tuple[Unit, ...]
    elements: list[str]
    feedthrough: list[str] | None
    numbers: Mapping[str, list[float]]

    def element(self, index: int) -> DescribedPort:
        """Return one of its elements as a port."""
        own = slice(index, index + 1)
        numbers = {aspect: values[own] for aspect, values in self.numbers.items()}
        return replace(self, units=self.units[own], elements=self.elements[own], numbers=numbers)


@dataclass(frozen=True, slots=True)
class DescribedComponent:
    """What is known of a component before it runs.

    Parameters
    ----------
    ports : mapping of name to DescribedPort
        Inputs, then outputs.
    capabilities : mapping of str to plain value
        Its ``"kind"``: ``"model exchange"``, ``"co-simulation"``, ``"recording"``, or that of a
        component of ours; and whether it has each of ``CAPABILITIES``, where that is known.
    system : LinearSystem or None
        Near its initial state; its inputs and outputs are all those of the component, or some are
        missing. None: it cannot be linearized.
    """

    ports: Mapping[str, DescribedPort]
    capabilities: Mapping[str, Any]
    system: LinearSystem | None = None


def describe(
    interface: Interface,
    capabilities: Mapping[str, Any],
    numbers: Mapping[str, Mapping[str, Vector]] | None = None,
    system: LinearSystem | None = None,
) -> DescribedComponent:
    """Return what is known of a component; ``numbers`` by aspect and port."""
    ports = {}
    outputs = [output.name for output in interface.outputs]
    for signal in interface.signals:
        name = signal.name
        own = {NOMINAL: list(signal.nominal)} if signal.nominal else {}
        for aspect, values in (numbers or {}).items():
            if name in values:
                own[aspect] = values[name].tolist()
        feedthrough = None
        causality: Causality = "input" if name in interface.input_names else "output"
        if causality == "output" and interface.knows(name):
            feedthrough = sorted(interface.feeds(name))
        elif causality == "input" and all(map(interface.knows, outputs)):
            feedthrough = [output for output in outputs if name in interface.feeds(output)]
        ports[name] = DescribedPort(
            causality,
            signal.type,
            signal.variability,
            signal.measures,
            signal.elements,
            feedthrough,
            own,
        )
    return DescribedComponent(ports, capabilities, system)


def compare(
    before: DescribedComponent,
    after: DescribedComponent,
    *,
    names: Mapping[str, str] | None = None,
    connected: Collection[str] = (),
    refused: Collection[str] = (),
) -> tuple[ComparedAspect, ...]:
    """Compare ``after`` with ``before``.

    Parameters
    ----------
    before, after : DescribedComponent
    names : mapping of port to str, optional
        What ports of ``after`` stand for in the new component, where that is no port of its name.
    connected : collection of str
        Ports that the scenario names.
    refused : collection of str
        Those of them whose connection stops the run: only they can be errors.
    """
    error = _error(before, after)
    whole = list(_whole_rows(before, after, error))
    rates = {"static gain": 0.0}
    system = before.system or after.system
    if system is not None and whole[-1].verdict != "differs":  # the poles
        rate = rate_between(system)
        rates[f"response at {rate:.3g} rad/s"] = rate
    responses = {
        aspect: [responses_at(rate, one, units_of=before) for one in (before, after)]
        for aspect, rate in rates.items()
    }
    rows: list[ComparedAspect] = []
    for name in dict.fromkeys([*before.ports, *after.ports]):
        source = None if names is None else names.get(name)
        row = partial(ComparedAspect, name, connected=name in connected, source=source)
        severity: PortVerdict = "error" if name in refused else "differs"
        old, new = before.ports.get(name), after.ports.get(name)
        if old is None or new is None:
            there, here = (None if port is None else port.causality for port in (old, new))
            rows.append(row("causality", there, here, severity))
            continue
        rows += _port_rows(row, old, new, severity)
        if old.causality == new.causality == "output":
            rows += _response_rows(row, old, new, responses, error)
    rows += whole
    return tuple(row for row in rows if row.before not in _NOTHING or row.after not in _NOTHING)


def _error(*components: DescribedComponent) -> float:
    """Return how far numbers may be apart: ten times the error of the derivatives."""
    systems = [component.system for component in components]
    return max([_SAME, *(10.0 * system.error for system in systems if system is not None)])


def _port_rows(
    row: _NewRow, old: DescribedPort, new: DescribedPort, severity: PortVerdict
) -> Iterator[ComparedAspect]:
    """Yield the aspects of a port; ``severity`` is the verdict where a connection cannot hold."""
    yield _equal(row, "causality", old.causality, new.causality, severity)
    yield _equal(row, "type", old.type, new.type)
    yield _equal(row, "size", len(old.units), len(new.units), severity)
    units = [units_text(port.units) or None for port in (old, new)]
    yield row("unit", *units, _unit_verdict(old.units, new.units, severity))
    yield _equal(row, "variability", old.variability, new.variability)
    yield _number_row(row, NOMINAL, old, new)
    if old.causality != new.causality:
        return
    if old.causality == "input":
        yield _number_row(row, START, old, new)
        return
    ways = ["unknown" if port.feedthrough is None else port.feedthrough for port in (old, new)]
    yield _equal(row, "feedthrough", ways[0], ways[1])
    yield _number_row(row, INITIAL, old, new)


def _equal(
    row: _NewRow, aspect: str, old: Any, new: Any, severity: PortVerdict = "differs"
) -> ComparedAspect:
    return row(aspect, old, new, "ok" if old == new else severity)


def _unit_verdict(
    before: Sequence[Unit], after: Sequence[Unit], severity: PortVerdict
) -> PortVerdict:
    """Return the worst verdict of an element; of ports of other sizes, of the first elements."""
    verdicts: set[PortVerdict] = set()
    for old, new in set(zip(before, after, strict=False)):
        converted = conversion(new, old)
        if not comparable(old, new):
            verdicts.add("unknown")
        elif converted is None:
            verdicts.add(severity)
        else:
            verdicts.add("ok" if converted.copies else "differs")
    return next(verdict for verdict in _WORST_FIRST if verdict in verdicts)


def _number_row(
    row: _NewRow, aspect: str, old: DescribedPort, new: DescribedPort
) -> ComparedAspect:
    """Compare numbers, those after in the unit of those before; nominal ones by their size."""
    before, converted = old.numbers.get(aspect), _in_unit_of(old, new, aspect)
    verdict = _same_values(before, converted, least=_ROUNDING)
    compared = row(
        aspect, before, new.numbers.get(aspect), verdict, ratio=_ratio(before, converted)
    )
    if aspect != NOMINAL or verdict == "unknown":
        return compared
    return replace(compared, verdict="differs" if compared.of_another_size else "ok")


def _in_unit_of(old: DescribedPort, new: DescribedPort, aspect: str) -> list[float] | None:
    """Return numbers of ``new`` in the unit of ``old``, where they can be converted."""
    values = new.numbers.get(aspect)
    if values is None:
        return None
    conversions = _conversions(new.units, old.units)
    return [convert(value) for value, convert in zip(values, conversions, strict=True)]


def _conversions(own: tuple[Unit, ...], units: tuple[Unit, ...]) -> list[Conversion]:
    """Return what converts elements to other units, of another number of these to the first one.

    A copy where nothing does.
    """
    if len(own) != len(units):
        units = units[:1] * len(own)
    return [convert or Conversion() for convert in conversions_between(own, units)]


def _same_values(
    old: ArrayLike | None, new: ArrayLike | None, error: float = _SAME, *, least: float = 1.0
) -> PortVerdict:
    """Compare numbers relative to the largest, but at least to ``least``."""
    if old is None or new is None:
        return "unknown"
    before, after = np.array(old), np.array(new)
    tolerance = error * max(least, np.nanmax(np.abs(before), initial=0.0))
    is_same = before.shape == after.shape and np.allclose(
        before, after, rtol=0.0, atol=tolerance, equal_nan=True
    )
    return "ok" if is_same else "differs"


def _ratio(before: ArrayLike | None, converted: ArrayLike | None) -> float | None:
    """Return the ratio of the largest numbers; None: one of them is zero, or not known."""
    if before is None or converted is None:
        return None
    sizes = [np.abs(np.array(values, np.float64)) for values in (before, converted)]
    old, new = (float(np.max(size, initial=0.0, where=np.isfinite(size))) for size in sizes)
    return new / old if old > 0.0 and new > 0.0 else None


def _whole_rows(
    before: DescribedComponent, after: DescribedComponent, error: float
) -> Iterator[ComparedAspect]:
    """Yield the aspects of the components as a whole; the poles are the last one."""
    row = partial(ComparedAspect, "")
    fmu_kinds = INTERFACE_TYPE_NAMES.values()
    of_fmus = all(one.capabilities["kind"] in fmu_kinds for one in (before, after))
    for key in ("kind", *CAPABILITIES):
        old, new = before.capabilities.get(key), after.capabilities.get(key)
        aspect = "interface type" if key == "kind" and of_fmus else key
        yield _equal(row, aspect, old, new, "unknown" if None in (old, new) else "differs")
    old, new = (None if one.system is None else _pole_pairs(one.system) for one in (before, after))
    yield row("poles", old, new, _same_values(old, new, error, least=_ROUNDING))


def _pole_pairs(system: LinearSystem) -> list[list[float]]:
    """Return real and imaginary part of every pole."""
    pairs: list[list[float]] = poles(system.A).view(np.float64).reshape(-1, 2).tolist()
    return pairs


# --- responses ---


def rate_between(system: LinearSystem) -> float:
    """Return a rate between the modes, but on none of a single oscillation [rad/s]."""
    sizes = np.abs(poles(system.A))
    sizes = sizes[sizes > 0.0]
    return float(np.sqrt(2.0) * np.exp(np.log(sizes).mean())) if len(sizes) else 1.0


def responses_at(
    rate: float, component: DescribedComponent, *, units_of: DescribedComponent
) -> Responses | None:
    """Return D + C (j rate - A)^-1 B [rad/s], in the units of another component.

    None where it is unknown, or where the inverse, with A known up to its error, may be singular.
    Rounding is relative to the terms.
    """
    system = component.system
    inputs, from_inputs = _elements(component, "input", units_of)
    outputs, to_outputs = _elements(component, "output", units_of)
    if system is None or system.D.shape != (len(outputs), len(inputs)):
        return None
    dynamics = 1j * rate * np.eye(len(system.A)) - system.A
    if is_singular(dynamics, error=system.error):
        return None
    states = np.linalg.solve(dynamics, system.B)
    factors = to_outputs[:, np.newaxis] * (1.0 / from_inputs)
    values = factors * (system.D + system.C @ states)
    terms = np.abs(factors) * (np.abs(system.D) + np.abs(system.C) @ np.abs(states))
    responses = {}
    for (row, column), value in np.ndenumerate(values):
        responses[inputs[column], outputs[row]] = (complex(value), float(terms[row, column]))
    return responses


def _elements(
    component: DescribedComponent, causality: Causality, other: DescribedComponent
) -> tuple[list[str], Vector]:
    """Return the elements of all inputs or outputs, and their factors.

    From the unit of each to that of the port of its name in another component.
    """
    names: list[str] = []
    factors: list[float] = []
    for name, port in component.ports.items():
        if port.causality == causality:
            names += port.elements
            conversions = _conversions(port.units, other.ports.get(name, port).units)
            factors += [convert.factor for convert in conversions]
    return names, np.array(factors)


def _response_rows(
    row: _NewRow,
    old: DescribedPort,
    new: DescribedPort,
    responses: Mapping[str, Sequence[Responses | None]],
    error: float,
) -> Iterator[ComparedAspect]:
    """Compare the responses of an output element by element, up to the first that differs.

    Of elements that both have those are shown that differ, or all; where they have none in common,
    nothing can be compared.
    """
    for aspect, of_both in responses.items():
        before, after = (
            own and {ends: own[ends] for ends in own if ends[1] in port.elements}
            for own, port in zip(of_both, (old, new), strict=True)
        )
        if before is None or after is None:
            yield row(aspect, _plain(before), _plain(after), "unknown")
            continue
        both = [ends for ends in before if ends in after]
        if not both:
            continue
        different = []
        for ends in both:
            (there, there_terms), (here, here_terms) = before[ends], after[ends]
            if abs(here - there) > error * max(there_terms, here_terms):
                different.append(ends)
        ratio = _ratio(*([abs(one[ends][0]) for ends in both] for one in (before, after)))
        values = [
            _plain({ends: one[ends] for ends in different or both}) for one in (before, after)
        ]
        yield row(aspect, *values, "differs" if different else "ok", ratio=ratio)
        if different:
            return


def _plain(entries: Responses | None) -> dict[str, Any] | None:
    """Return values for a row: numbers, or real and imaginary parts."""
    if entries is None:
        return None
    plain = {}
    for (u, y), (value, _) in entries.items():
        plain[f"{u} -> {y}"] = value.real if value.imag == 0.0 else [value.real, value.imag]
    return plain


# --- ports of other names ---


@dataclass(frozen=True, slots=True)
class Proposal:
    """A port that may be the one that is missing, with the reasons."""

    port: str
    name: str
    reasons: tuple[str, ...]


def propose(
    before: DescribedComponent, after: DescribedComponent, missing: Collection[str]
) -> tuple[Proposal, ...]:
    """Propose ports of ``after`` alone for those of ``before`` that are ``missing`` there.

    A candidate has the causality, size and type of the missing port and a unit that converts to
    its own; for a scalar output, elements of vectors are candidates too. The likeliest agree in
    most of: declared unit, number of direct dependencies, initial output, static gains; several
    where they are equally likely.
    """
    if not missing:
        return ()
    candidates = {}
    for name, port in after.ports.items():
        if name not in before.ports:
            candidates[name] = port
            if port.causality == "output" and len(port.elements) > 1:
                candidates |= {one: port.element(i) for i, one in enumerate(port.elements)}
    error = _error(before, after)
    static = [responses_at(0.0, one, units_of=one) for one in (before, after)]
    proposals: list[Proposal] = []
    for name in missing:
        fitting = []
        for candidate, port in candidates.items():
            pair = (before.ports[name], port)
            reasons = _reasons(*pair)
            old, new = (_gains(own, one) for own, one in zip(static, pair, strict=True))
            if reasons and old and new and _same_values(old, new, error) == "ok":
                reasons.append(f"static gains {shown(new)}")
            fitting.append(Proposal(name, candidate, tuple(reasons)))
        most = max((len(proposal.reasons) for proposal in fitting), default=0)
        proposals += [one for one in fitting if one.reasons and len(one.reasons) == most]
    return tuple(proposals)


def _reasons(old: DescribedPort, new: DescribedPort) -> list[str]:
    """Return what a port has in common with a missing one; nothing where it cannot be that."""
    rows = {row.aspect: row for row in _port_rows(partial(ComparedAspect, ""), old, new, "error")}
    agreed = {aspect for aspect, row in rows.items() if row.verdict == "ok"}
    unit = rows["unit"]
    if not {"causality", "type", "size"} <= agreed or unit.verdict == "error":
        return []
    reasons = [f"{new.causality} of size {len(new.units)}, {new.type}"]
    if unit.verdict != "unknown":
        reasons.append(f"unit {unit.after!r}")
    # by number: the ports at the other end may have other names, too
    ways = (old.feedthrough, new.feedthrough)
    if ways[0] is not None and ways[1] is not None and len(ways[0]) == len(ways[1]):
        reasons.append(feedthrough_text(new.causality, ways[1]))
    if INITIAL in agreed:
        reasons.append(f"{INITIAL} {shown(rows[INITIAL].after)}")
    return reasons


def _gains(static: Responses | None, port: DescribedPort) -> list[float]:
    """Return the static gains to or from a port, in rising order; none where they are unknown."""
    names = set(port.elements)
    own = [value for ends, (value, _) in (static or {}).items() if not names.isdisjoint(ends)]
    return sorted(value.real for value in own)


# --- values as people read them ---


def feedthrough_text(causality: Causality, ports: Sequence[str]) -> str:
    """Return a sentence on the direct feedthrough from inputs to an output, or back."""
    if not ports:
        return "no direct feedthrough"
    return f"direct feedthrough {'from' if causality == 'output' else 'to'} {', '.join(ports)}"


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
        case []:
            return "none"
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
