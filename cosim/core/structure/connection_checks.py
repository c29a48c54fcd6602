"""Checks of connections: names, sizes, units, how often each element of an input is driven."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from itertools import chain

from cosim.core.connections import AS_IS, ONE_SOURCE, Connection, ElementUnits, element_units
from cosim.core.port import Port
from cosim.core.signals import Signal
from cosim.core.structure.ports import ConnectionEnd, Ports, undriven_parts, unknown_component
from cosim.errors import GraphError
from cosim.units import BASE, BaseUnit, Unit, comparable, conversion, unknown_unit


def check_connections(
    ports: Ports,
    connections: Mapping[Port, Connection],
    missing: Collection[str] = (),
    unread: Iterable[Port] = (),
) -> dict[Port, str]:
    """Return every problem of the connections, by the input, or elements of it, it belongs to.

    Parameters
    ----------
    ports : Ports
    connections : mapping of Port to Connection
    missing : collection of component names
        Components that are meant to be there but could not be built: connections to and from them
        are not checked.
    unread : iterable of Port
        Inputs, or elements of them, whose connections could not be read.
    """
    problems: dict[Port, str] = {}
    for to, connection in connections.items():
        text = "; ".join(_problems(ports, to, connection, missing))
        if text:
            problems[to] = text
    connected, unknown = _connected_parts(ports, connections)
    unknown.update(port.whole for port in unread)
    for channel in ports.channels.values():
        for signal in channel.interface.inputs:
            port = Port(channel.name, signal.name)
            if port not in unknown:
                for to, text in _problems_of_input(port, signal, connected.get(port, ())):
                    problems[to] = f"{problems[to]}; {text}" if to in problems else text
    return problems


def _connected_parts(
    ports: Ports, connections: Iterable[Port]
) -> tuple[dict[Port, list[tuple[Port, ConnectionEnd]]], set[Port]]:
    """Return what is connected of every input, and the inputs of which an element is not there."""
    connected: dict[Port, list[tuple[Port, ConnectionEnd]]] = {}
    unknown: set[Port] = set()
    for to in connections:
        try:
            end = ports.input(to)
        except GraphError:
            unknown.add(to.whole)
        else:
            connected.setdefault(end.port, []).append((to, end))
    return connected, unknown


def _problems_of_input(
    port: Port, signal: Signal, parts: Sequence[tuple[Port, ConnectionEnd]]
) -> Iterator[tuple[Port, str]]:
    """Yield what is wrong with how often elements of an input are connected, and where."""
    driven_by: dict[int, Port] = {}
    for to, end in parts:
        driven = range(end.elements.start, end.elements.stop)
        overlapped = [driven_by[i] for i in driven if i in driven_by]
        if overlapped:
            yield to, _overlap_text(to, list(dict.fromkeys(overlapped)), port)
        driven_by |= dict.fromkeys(driven, to)
    undriven = undriven_parts(port, signal, (end for _, end in parts))
    if parts and signal.connection == "forbidden":
        yield parts[0][0], _forbidden_text(port, undriven)
    if undriven and signal.connection == "required":
        yield parts[-1][0] if parts else port, _undriven_text(port, signal, undriven)


def _undriven_text(port: Port, signal: Signal, undriven: Sequence[Port]) -> str:
    if undriven[0] == port:
        return f"'{port}' is not connected; give it a source in [connections]"
    names = ", ".join(f"'{part}'" for part in undriven)
    is_one = len(undriven) == 1 and isinstance(undriven[0].element, int)
    problem = "is not connected; give it" if is_one else "are not connected; give them"
    origin = f" (of the FMU: {signal.origin})" if signal.origin else ""
    return (
        f"{names} {problem} a source in [connections]; '{port}' has {signal.size} elements, "
        f"numbered from 0{origin}"
    )


def _overlap_text(to: Port, others: Sequence[Port], port: Port) -> str:
    names = ", ".join(f"'{other}'" for other in others)
    if names == f"'{to}'":
        return f"'{to}' is given twice; {ONE_SOURCE}"
    return (
        f"'{to}' overlaps {names}: an element has one source (add signals with a 'sum'); connect "
        f"'{port}' as a whole, or each element once"
    )


def _forbidden_text(port: Port, undriven: Sequence[Port]) -> str:
    if undriven:
        return (
            f"'{port}' is connected in part and has an explicit start value; remove one of the "
            "two, or drive its other elements with a 'constant'"
        )
    return (
        f"'{port}' is connected and has an explicit start value, which the connection would "
        "overwrite; remove one of the two"
    )


def _problems(
    ports: Ports, to: Port, connection: Connection, missing: Collection[str]
) -> Iterator[str]:
    """Yield the problems of one connection."""
    ends = (to, *connection.sources)
    absent = [port for port in ends if port.component not in ports.channels]
    for port in absent:
        if port.component not in missing:
            yield str(unknown_component(port, [*ports.channels, *sorted(missing)]))
    if absent:
        return
    try:
        target = ports.input(to)
        sources = [ports.output(port) for port in connection.sources]
    except GraphError as error:
        yield str(error)
        return
    for problem in _mismatches(connection, target, sources):
        yield f"{connection.label} -> {to}: {problem}"


def _mismatches(
    connection: Connection, end: ConnectionEnd, sources: Sequence[ConnectionEnd]
) -> Iterator[str]:
    """Yield what does not fit between the sources of a connection and its input."""
    yield from _size_mismatches(connection, end, sources)
    yield from _unit_mismatches(connection, end, sources)
    if not end.signal.optional and any(source.signal.optional for source in sources):
        yield "the source may be NaN; the input requires a value at every step"


def _size_mismatches(
    connection: Connection, target: ConnectionEnd, sources: Sequence[ConnectionEnd]
) -> Iterator[str]:
    size = sum(source.size for source in sources)
    shape = connection.matrix.shape
    if shape and shape != (target.size, size):
        yield f"gain: expected shape ({target.size}, {size}), got {shape}"
    if not shape and size != target.size:
        source_unit = _bracketed_unit(sources[0].signal)
        target_unit = _bracketed_unit(target.signal)
        yield f"size {size}{source_unit} cannot drive size {target.size}{target_unit}"


def _unit_mismatches(
    connection: Connection, end: ConnectionEnd, sources: Sequence[ConnectionEnd]
) -> Iterator[str]:
    names = connection.unit
    if isinstance(names, tuple) and len(names) != end.size:
        yield f"unit: expected one for each of {end.size} elements, got {len(names)}"
        return
    by_element = element_units(connection, sources, end)
    problems: dict[str, None] = {}  # each once, whatever elements have it
    rows = dict.fromkeys((connection.unit_of(i) == AS_IS, row) for i, row in enumerate(by_element))
    for is_as_is, row in rows:
        for units in row:
            found = _mismatches_of(connection, units, end.signal, is_as_is=is_as_is)
            problems |= dict.fromkeys(found)
        if len({units.conversion for units in row}) > 1:
            mixed = ", ".join(_unit_text(unit) for unit in dict.fromkeys(u.source for u in row))
            text = f"a gain cannot mix the units {mixed}; set the resulting unit with unit = ..."
            problems[text] = None
    yield from problems


def _mismatches_of(
    connection: Connection, units: ElementUnits, target: Signal, *, is_as_is: bool
) -> Iterator[str]:
    """Yield what is wrong with the units of an element."""
    source, reached, wanted = units
    used = connection.unit is None or is_as_is or reached.name in (source.name, wanted.name)
    if not used and reached.si is None:
        yield f"unit = {reached.name!r}: {unknown_unit(str(reached.name))}"
    elif unknown := unknown_units(reached, wanted):
        yield (
            f"{unknown}, so values in {reached.name!r} cannot be converted to {wanted.name!r}; "
            f'{{ from = {connection.label!r}, unit = "{AS_IS}" }} takes them as they are'
        )
    elif conversion(reached, wanted) is None:
        listed = list(target.unit) if isinstance(target.unit, tuple) else target.unit
        yield (
            f"unit {_unit_text(reached)} cannot drive unit {_unit_text(wanted)}; convert "
            f"with {{ from = {connection.label!r}, gain = ..., unit = {listed!r} }}"
        )
    if not is_as_is and _is_identity(connection) and not _same_unit(source, reached):
        yield (
            f"the source has unit {source.name!r}; unit = {reached.name!r} requires a gain; "
            "without unit it is converted"
        )


def _is_identity(connection: Connection) -> bool:
    gain = connection.matrix
    return gain.ndim == 0 and bool(gain == 1.0) and connection.offset == 0.0


def unit_warnings(
    ports: Ports, connections: Mapping[Port, Connection]
) -> Iterator[tuple[str, str]]:
    """Yield (component, text) for units of checked connections that cannot be compared."""
    for to, connection in connections.items():
        end = ports.input(to)
        sources = [ports.output(port) for port in connection.sources]
        units = dict.fromkeys(chain.from_iterable(element_units(connection, sources, end)))
        reached = list(dict.fromkeys(unit.reached for unit in units))
        if end.signal.unit is None and not _all_same(reached):
            names = ", ".join(_unit_text(unit) for unit in reached)
            yield (
                to.component,
                f"{connection.label} -> {to}: the input has no unit, so values in {names} are "
                "stacked as they are",
            )
        beside = [unit for unit in units if unit.reached.name is None and unit.target.name]
        if beside and not all(_same_unit(unit.reached, unit.target) for unit in units):
            taken = ", ".join(dict.fromkeys(repr(unit.target.name) for unit in beside))
            yield (
                to.component,
                f"{connection.label} -> {to}: values without a unit are taken in {taken}, as they "
                "are, beside others that are converted",
            )


def element_warnings(
    ports: Ports, connections: Mapping[Port, Connection]
) -> Iterator[tuple[str, str]]:
    """Yield (component, text) for elements whose numbers are others in the FMU they come from."""
    driven = Counter[Port]()
    for to in connections:
        end = ports.input(to)
        driven[end.port] += end.size
    for to, connection in connections.items():
        end = ports.input(to)
        named = [(port, ports.output(port).signal) for port in connection.sources]
        # Who drives every element knows that they are numbered from 0.
        if driven[end.port] < end.signal.size:
            named.append((to, end.signal))
        for port, signal in named:
            if signal.first and isinstance(port.element, int) and port.name != signal.name:
                number = port.element + signal.first
                part = f"{port.whole}[{port.element}:{port.element + 1}]"
                yield (
                    to.component,
                    f"{port} is {signal.name}[{number}] of the FMU, as elements are numbered from "
                    f"0 here; write {part} if it is meant",
                )


def unknown_units(first: Unit, second: Unit) -> str:
    """Return which of two declared units that cannot be compared are not known; empty: none."""
    if first.name is None or second.name is None or comparable(first, second):
        return ""
    unknown = [repr(unit.name) for unit in (first, second) if unit.si is None]
    return f"{' and '.join(unknown)} {'are' if len(unknown) > 1 else 'is'} not known"


def _all_same(units: Sequence[Unit]) -> bool:
    """Return whether no two units of one dimension are of different size."""
    known = [unit.si for unit in units if unit.si is not None]
    sizes: dict[tuple[int, ...], BaseUnit] = {}
    return all(sizes.setdefault(base.exponents, base) == base for base in known)


def _same_unit(first: Unit, second: Unit) -> bool:
    converted = conversion(first, second)
    return converted is not None and converted.copies


def _unit_text(unit: Unit) -> str:
    """Return the name of a unit, with its base units where a definition gives them."""
    if unit.base is None:
        return repr(unit.name)
    powers = []
    for name, exponent in zip(BASE, unit.base.exponents, strict=True):
        if exponent:
            powers.append(name if exponent == 1 else f"{name}{exponent}")
    return f"{unit.name!r} ({'.'.join(powers) or '1'})"


def _bracketed_unit(signal: Signal) -> str:
    return "" if signal.unit is None else f" [{signal.unit_text}]"
