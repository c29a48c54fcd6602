"""From written names to a map of ports: renamings are resolved and checked.

A shown port may be given element by element, ``plant.x[1] <- plant.speed``: elements from 0 on make
the port. They do not overlap, and are all of it where its size is known. Where it is not, an
element without those before it is a signal of that name (:mod:`cosim.core.port`).

Every input element of the component is shown once. An output that no renaming covers keeps its own
name, so that every output stays visible; where that name is taken, ``_`` is appended to it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from cosim.blocks.port_map import PortElement, PortMap, ShownPort, names_of
from cosim.core.port import Port
from cosim.core.signals import Causality, Interface, Need, Signal
from cosim.errors import GraphError, nearest
from cosim.units import Conversion, Unit, comparable, conversion, conversions_between


@dataclass(frozen=True, slots=True)
class Renaming:
    """A name under which ports of a component are shown.

    Parameters
    ----------
    port : Port
        As it is shown.
    sources : tuple of Port
        Ports of the component, or elements of them, in the order of the shown elements.
    causality : {"input", "output"} or None
        What they must be; None: that of the port in the component that has the shown names.
    """

    port: Port
    sources: tuple[Port, ...]
    causality: Causality | None = None


def map_ports(
    interface: Interface, renamings: Iterable[Renaming], replaced: Interface | None = None
) -> PortMap:
    """Return the map of ports for renamings, parameters as of :func:`resolve`.

    Raises
    ------
    GraphError
        With every problem of the renamings.
    """
    ports, problems = resolve(interface, renamings, replaced)
    if problems:
        raise GraphError("\n".join(problems.values()))
    return ports


def resolve(
    interface: Interface, renamings: Iterable[Renaming], replaced: Interface | None = None
) -> tuple[PortMap, dict[Port, str]]:
    """Return the map of ports for the renamings that hold, and the problems of the others.

    Parameters
    ----------
    interface : Interface
        Of the component.
    renamings : iterable of Renaming
        Each port once; ports that are not named keep their own names.
    replaced : Interface or None
        Of the component that has the shown names. A port that is given in parts has the size of
        its port there; a vector made of elements of different units is shown in the units of that
        port, where they are declared and can be converted to.

    Returns
    -------
    PortMap
    dict of Port to str
        Problems, by the port of a renaming.
    """
    resolver = _Resolver(interface, replaced)
    for port, parts in _by_port(renamings, replaced).items():
        resolver.show(port, parts)
    resolver.check_inputs()
    return resolver.port_map(), resolver.problems


def _by_port(
    renamings: Iterable[Renaming], replaced: Interface | None
) -> dict[Port, list[Renaming]]:
    """Return the renamings of every port: of all of it, or of its elements in rising order."""
    # a port whose own name looks like that of an element, such as x[1], is no part of another
    names = {} if replaced is None else replaced.by_name
    by_port: dict[Port, list[Renaming]] = {}
    for renaming in renamings:
        port = renaming.port
        whole = port if port.name in names else port.whole
        by_port.setdefault(whole, []).append(renaming)
    for parts in by_port.values():
        parts.sort(key=lambda part: _positions(part.port).start)
    return by_port


def _positions(port: Port) -> range:
    """Return the positions of the elements that a port names; none where it is the whole."""
    match port.element:
        case None:
            return range(0)
        case int(index):
            return range(index, index + 1)
        case positions:
            return positions


class _Resolver:
    """The shown ports, and the problems of renamings, both by port."""

    def __init__(self, interface: Interface, replaced: Interface | None) -> None:
        self.problems: dict[Port, str] = {}
        self._interface = interface
        self._replaced: Mapping[str, Signal] = {}
        self._replaced_causalities: dict[str, Causality] = {}
        if replaced is not None:
            self._replaced = replaced.by_name
            self._replaced_causalities |= {signal.name: "input" for signal in replaced.inputs}
            self._replaced_causalities |= {signal.name: "output" for signal in replaced.outputs}
        inputs = _elements(interface.inputs, "input")
        outputs = _elements(interface.outputs, "output")
        self._elements = {**inputs, **outputs}
        self._shown: dict[Port, ShownPort] = {}

    def show(self, port: Port, parts: Sequence[Renaming]) -> None:
        """Show elements of the component as a port, which is given as a whole or in parts."""
        problems = self._check_parts(port, parts)
        if problems:
            self.problems |= problems
            return
        positions: list[int] = []
        for part in parts:
            positions += _positions(part.port)
        if positions == list(range(len(positions))):
            self._show(port, parts)
        else:  # elements of a port of unknown size: each is a signal of its name
            for part in parts:
                self._show(part.port, [part])

    def _check_parts(self, port: Port, parts: Sequence[Renaming]) -> dict[Port, str]:
        """Return why parts do not make a port, by part: they overlap, or some are missing."""
        if parts[0].port == port and len(parts) == 1:
            return {}
        problems: dict[Port, str] = {}
        covered: dict[int, Renaming] = {}
        whole = [part for part in parts if part.port == port]
        for part in parts:
            overlapped = [covered[i] for i in _positions(part.port) if i in covered]
            if part.port != port:
                overlapped += whole
            if overlapped:
                first = _given(overlapped[0])
                problems[part.port] = (
                    f"{_given(part)} overlaps {first}; expected '{port}' as a whole, or each of "
                    "its elements once"
                )
            covered |= dict.fromkeys(_positions(part.port), part)
        replaced = self._replaced.get(port.signal)
        if problems or replaced is None:
            return problems
        return _check_complete(parts, covered, replaced)

    def _show(self, port: Port, parts: Sequence[Renaming]) -> None:
        elements: list[PortElement] = []
        failed = False
        for part in parts:
            try:
                elements += self._part(part)
            except GraphError as error:
                self.problems[part.port] = str(error)
                failed = True
        if failed:
            return
        try:
            _check_alike(port, elements)
            units = self._units(port, elements)
        except GraphError as error:
            self.problems[port] = str(error)
            return
        signal = _shown_signal(port.name, elements, units)
        self._shown[port] = ShownPort(signal, tuple(elements))

    def _part(self, part: Renaming) -> list[PortElement]:
        """Return the elements of the component that a renaming names.

        Raises
        ------
        GraphError
            If one of them is not there, or their number is not that of the part.
        """
        port = part.port
        causalities = self._replaced_causalities
        of_replaced = causalities.get(port.name) or causalities.get(port.signal)
        elements: list[PortElement] = []
        for source in part.sources:
            elements += self._find(source, part.causality or of_replaced)
        _check_size(part.port, elements)
        return elements

    def _find(self, source: Port, causality: Causality | None) -> list[PortElement]:
        """Return the elements of a port of the component.

        Raises
        ------
        GraphError
            If there is no such port of this causality, or no such element.
        """
        match = source.find(self._interface.by_name)
        if match is None:
            needed = causality or "input or output"
            nearest_name = nearest(source.signal, self._names(causality))
            raise GraphError(
                f"'{source}': {source.component!r} has no {needed} {source.signal!r}; "
                f"{nearest_name}"
            )
        signal, part = match
        elements = self._elements[signal.name]
        if not self._is(signal.name, causality):
            other = elements[0].causality
            listed = ", ".join(self._names(causality)) or "none"
            raise GraphError(
                f"'{source}': expected an {causality} of {source.component!r}, got an {other}; "
                f"available: {listed}"
            )
        return elements[part]

    def _names(self, causality: Causality | None) -> list[str]:
        return [name for name in self._elements if self._is(name, causality)]

    def _is(self, name: str, causality: Causality | None) -> bool:
        first = self._elements[name][0]
        return causality in (None, first.causality)

    def _units(self, port: Port, elements: Sequence[PortElement]) -> Sequence[Unit]:
        """Return the unit in which each element is shown: all in one, or each in its own.

        Raises
        ------
        GraphError
            If some elements declare a unit, and others do not.
        """
        own = [element.measure for element in elements]
        if len(set(own)) == 1:
            return own
        undeclared = [element.name for element in elements if element.measure.name is None]
        if undeclared:
            names = ", ".join(names_of(elements))
            declared = next(element for element in elements if element.measure.name is not None)
            raise GraphError(
                f"'{port}' cannot be made of {names}: {declared.name!r} has unit "
                f"{declared.measure.name!r}, {undeclared[0]!r} has none; "
                f"{_way_out(port, elements)}"
            )
        shown = (own[0],) * len(own)
        replaced = self._replaced.get(port.signal)
        if replaced is not None and replaced.unit is not None:
            shown = replaced.measures
            if not isinstance(replaced.unit, tuple):
                shown = shown[:1] * len(own)
        if len(shown) != len(own):
            return own
        pairs = set(zip(own, shown, strict=True))
        is_shown = all(comparable(*pair) and conversion(*pair) is not None for pair in pairs)
        return shown if is_shown else own

    def check_inputs(self) -> None:
        """Check that the component's input elements are shown once, all of an input or none."""
        driven: dict[int, Port] = {}
        shown_ports = self._shown.items()
        inputs = {port: shown for port, shown in shown_ports if shown.causality == "input"}
        for port, shown in inputs.items():
            for element in shown.elements:
                column = element.column
                if column in driven:
                    first = driven[column]
                    name = f"{port.component}.{element.name}"
                    self._drop(port, f"{name!r} is given twice, for '{first}' and '{port}'")
                driven[column] = port
        missing: dict[str, list[str]] = {}
        for port, shown in inputs.items():
            for name in shown.sources:
                if name not in missing:
                    elements = self._elements[name]
                    undriven = [part.name for part in elements if part.column not in driven]
                    missing[name] = undriven
                if missing[name]:
                    listed = ", ".join(missing[name])
                    self._drop(
                        port,
                        f"'{port}' is a part of the input {name!r}; expected ports for the rest "
                        f"too: {listed}",
                    )

    def _drop(self, port: Port, problem: str) -> None:
        self.problems.setdefault(port, problem)
        self._shown.pop(port, None)

    def port_map(self) -> PortMap:
        """Return the map: the shown ports, and those of the component that none of them covers."""
        ports = list(self._shown.values())
        taken = {port.signal.name for port in ports}
        # an element that is a signal beside its vector would be found in the vector's place
        taken |= {port.signal for port in self._shown}
        covered: set[PortElement] = set()
        for port in ports:
            covered.update(port.elements)
        for own_name, elements in self._elements.items():
            if not covered.issuperset(elements):
                name = own_name
                while name in taken:
                    name += "_"
                taken.add(name)
                signal = replace(elements[0].signal, name=name)
                port = ShownPort(signal, tuple(elements))
                ports.append(port)
        ports.sort(key=lambda port: port.elements[0].column)
        inputs = tuple(port for port in ports if port.causality == "input")
        outputs = tuple(port for port in ports if port.causality == "output")
        return PortMap(self._interface, inputs, outputs)


def _elements(signals: Iterable[Signal], causality: Causality) -> dict[str, list[PortElement]]:
    """Return the elements of every signal by its name, columns counted from 0."""
    elements: dict[str, list[PortElement]] = {}
    column = 0
    for signal in signals:
        own = []
        for index in range(signal.size):
            own.append(PortElement(signal, causality, index, column))
            column += 1
        elements[signal.name] = own
    return elements


def _shown_signal(name: str, elements: Sequence[PortElement], units: Sequence[Unit]) -> Signal:
    """Return the signal that is shown for elements of one kind, variability and causality."""
    first = elements[0].signal
    roles = {element.signal.role for element in elements}
    role = first.role if len(roles) == 1 else "output"
    signal = replace(
        first,
        name=name,
        size=len(elements),
        unit=None,
        base=None,
        role=role,
        start=_start(elements, units),
        nominal=_nominal(elements, units),
        connection=_need(elements),
    )
    return signal.in_units(units)


def _need(elements: Sequence[PortElement]) -> Need:
    """Return whether something must drive a shown input: the strictest of its elements."""
    needs = {element.signal.connection for element in elements}
    strictest: tuple[Need, ...] = ("forbidden", "required", "optional")
    return next(need for need in strictest if need in needs)


def _start(elements: Sequence[PortElement], units: Sequence[Unit]) -> tuple[float, ...]:
    """Return the values of a shown input that nothing drives yet; empty: zeros."""
    if not any(element.signal.start for element in elements):
        return ()
    values = []
    for element, to_shown in zip(elements, _to_shown(elements, units), strict=True):
        value = float(to_shown(element.start))
        values.append(value)
    return tuple(values)


def _nominal(elements: Sequence[PortElement], units: Sequence[Unit]) -> tuple[float, ...]:
    """Return what size shown elements usually have; empty: that of none is known."""
    if not any(element.signal.nominal for element in elements):
        return ()
    values = []
    for element, to_shown in zip(elements, _to_shown(elements, units), strict=True):
        nominal = element.signal.nominal_values[element.index]
        values.append(nominal if to_shown.copies else nominal * abs(to_shown.factor))
    return tuple(values)


def _to_shown(elements: Sequence[PortElement], units: Sequence[Unit]) -> list[Conversion]:
    """Return the conversions of elements to the units in which they are shown."""
    own = [element.measure for element in elements]
    return [convert for convert in conversions_between(own, units) if convert is not None]


def _check_size(port: Port, elements: Sequence[PortElement]) -> None:
    needed = len(_positions(port))
    size = len(elements)
    if needed and size != needed:
        names = ", ".join(names_of(elements))
        raise GraphError(f"'{port}': expected size {needed}, got {size}: {names}")


def _check_complete(
    parts: Sequence[Renaming], covered: Collection[int], replaced: Signal
) -> dict[Port, str]:
    """Return why parts are not the whole of a port of known size, by part."""
    size = replaced.size
    count = "1 element" if size == 1 else f"{size} elements"
    problems: dict[Port, str] = {}
    for part in parts:
        port = part.port
        if _positions(port).stop > size:
            problems[port] = f"{_given(part)}: '{port.whole}' has {count}, numbered from 0"
    part = parts[0]
    uncovered = [i for i in range(size) if i not in covered]
    missing = [str(replace(part.port, element=i)) for i in uncovered]
    if missing and not problems:
        port = part.port.whole
        names = ", ".join(["NAME"] * size)
        problems[part.port] = (
            f"{_given(part)} is a part of '{port}', which has {count}; expected entries for the "
            f"rest too: {', '.join(missing)}, or one for the whole: {port}=[{names}]"
        )
    return problems


def _given(renaming: Renaming) -> str:
    """Return a renaming as its problems name it."""
    names = ", ".join(source.name for source in renaming.sources)
    return f"'{renaming.port}' (as {names})"


def _check_alike(port: Port, elements: Sequence[PortElement]) -> None:
    """Check that elements can be one signal: of one causality, type and variability.

    Raises
    ------
    GraphError
        If they differ, with the way out.
    """
    first = elements[0]
    for element in elements:
        natures = zip(_nature(first), _nature(element), strict=True)
        for own, other in natures:
            if own != other:
                names = ", ".join(names_of(elements))
                way_out = _way_out(port, elements)
                raise GraphError(
                    f"'{port}' cannot be made of {names}: {first.name!r} is {own}, "
                    f"{element.name!r} is {other}, and all of a signal is one or the other; "
                    f"{way_out}"
                )


def _nature(element: PortElement) -> tuple[str, ...]:
    """Return what all elements of a signal have in common, in words."""
    signal = element.signal
    value = "optional (may be NaN)" if signal.optional else "never NaN"
    return element.causality, signal.type, signal.variability, value


def _way_out(port: Port, elements: Sequence[PortElement]) -> str:
    """Return how elements reach what the port drives, each as a port of its own."""
    names = names_of(elements)
    sources = ", ".join(f'"{port.component}.{name}"' for name in names)
    if elements[0].causality == "input":
        return f"leave '{port}' out of the map and connect each of them: {sources}"
    return f"leave '{port}' out of the map and list them in the connection: [{sources}]"
