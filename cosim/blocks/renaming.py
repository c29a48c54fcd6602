"""From written names to a map of ports: renamings are resolved and checked.

A shown port may be given element by element, ``plant.x[1] <- plant.speed``: elements from 0 on make
the port. They do not overlap, and are all of it where its size is known. Where it is not, an
element without those before it is a signal of that name (:mod:`cosim.core.port`).

Every input element of the component is shown once. An output that no renaming covers keeps its own
name, so that every output stays visible; where that name is taken, ``_`` is appended to it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import count, pairwise

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
        With the first problem of every port.
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
        The first problem of each shown port, by the port of a renaming.
    """
    resolver = _Resolver(interface, Interface() if replaced is None else replaced)
    return resolver.port_map(renamings), resolver.problems


class _WrongRenaming(GraphError):
    """A renaming cannot be followed.

    Parameters
    ----------
    port : Port
        Of the renaming.
    text : str
    """

    def __init__(self, port: Port, text: str) -> None:
        super().__init__(text)
        self.port = port


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

    def __init__(self, interface: Interface, replaced: Interface) -> None:
        self.problems: dict[Port, str] = {}
        self._interface = interface
        self._replaced = replaced
        inputs = _elements(interface.inputs, "input")
        outputs = _elements(interface.outputs, "output")
        self._elements = {**inputs, **outputs}
        self._shown: dict[Port, ShownPort] = {}

    def port_map(self, renamings: Iterable[Renaming]) -> PortMap:
        """Return the map: the shown ports, and those of the component that none of them covers."""
        by_port: dict[Port, list[Renaming]] = {}
        for renaming in renamings:
            # a port whose own name looks like that of an element, such as x[1], is no part
            port = renaming.port
            whole = port if port.name in self._replaced.by_name else port.whole
            by_port.setdefault(whole, []).append(renaming)
        for whole, parts in by_port.items():
            parts.sort(key=lambda part: (_positions(part.port).start, _positions(part.port).stop))
            try:
                self._show(whole, parts)
            except _WrongRenaming as error:
                self.problems[error.port] = str(error)
        self._check_inputs()
        ports = [*self._shown.values(), *self._uncovered()]
        ports.sort(key=lambda port: port.elements[0].column)
        inputs = tuple(port for port in ports if port.causality == "input")
        outputs = tuple(port for port in ports if port.causality == "output")
        return PortMap(self._interface, inputs, outputs)

    def _show(self, port: Port, parts: Sequence[Renaming]) -> None:
        """Show elements of the component as a port, which is given as a whole or in parts.

        Raises
        ------
        _WrongRenaming
            If the parts do not make the port, or no such elements a signal.
        """
        if parts[0].port != port or len(parts) > 1:
            self._check_parts(port, parts)
        positions: list[int] = []
        for part in parts:
            positions += _positions(part.port)
        groups = [(port, parts)]
        if positions != list(range(len(positions))):
            # elements of a port of unknown size: each is a signal of its name
            groups = [(part.port, [part]) for part in parts]
        for shown, own in groups:
            elements: list[PortElement] = []
            for part in own:
                elements += self._part(part)
            try:
                _check_alike(shown, elements)
                signal = _shown_signal(shown.name, elements, self._units(shown, elements))
            except GraphError as error:
                raise _WrongRenaming(shown, str(error)) from error
            self._shown[shown] = ShownPort(signal, tuple(elements))

    def _check_parts(self, port: Port, parts: Sequence[Renaming]) -> None:
        """Check that parts, in rising order, neither overlap nor leave out an element.

        Raises
        ------
        _WrongRenaming
            If they do.
        """
        for first, part in pairwise(parts):
            if first.port == port or _positions(part.port).start < _positions(first.port).stop:
                raise _WrongRenaming(
                    part.port,
                    f"{_given(part)} overlaps {_given(first)}; expected '{port}' as a whole, or "
                    "each of its elements once",
                )
        replaced = self._replaced.by_name.get(port.signal)
        if replaced is None:
            return
        size = replaced.size
        has = "1 element" if size == 1 else f"{size} elements"
        covered: set[int] = set()
        for part in parts:
            covered.update(_positions(part.port))
            if _positions(part.port).stop > size:
                raise _WrongRenaming(
                    part.port, f"{_given(part)}: '{port}' has {has}, numbered from 0"
                )
        missing = [str(replace(port, element=i)) for i in range(size) if i not in covered]
        if missing:
            names = ", ".join(["NAME"] * size)
            raise _WrongRenaming(
                parts[0].port,
                f"{_given(parts[0])} is a part of '{port}', which has {has}; expected entries "
                f"for the rest too: {', '.join(missing)}, or one for the whole: {port}=[{names}]",
            )

    def _part(self, part: Renaming) -> list[PortElement]:
        """Return the elements of the component that a renaming names.

        Raises
        ------
        _WrongRenaming
            If one of them is not there, or their number is not that of the part.
        """
        port = part.port
        causality = part.causality
        for name in (port.signal, port.name):
            if part.causality is None and name in self._replaced.by_name:
                causality = "input" if name in self._replaced.input_names else "output"
        elements: list[PortElement] = []
        try:
            for source in part.sources:
                elements += self._find(source, causality)
        except GraphError as error:
            raise _WrongRenaming(port, str(error)) from error
        needed = len(_positions(port))
        if needed not in (0, len(elements)):
            names = ", ".join(names_of(elements))
            text = f"'{port}': expected size {needed}, got {len(elements)}: {names}"
            raise _WrongRenaming(port, text)
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
        replaced = self._replaced.by_name.get(port.signal)
        if replaced is not None and replaced.unit is not None:
            shown = replaced.measures
            if not isinstance(replaced.unit, tuple):
                shown = shown[:1] * len(own)
        if len(shown) != len(own):
            return own
        pairs = set(zip(own, shown, strict=True))
        is_shown = all(comparable(*pair) and conversion(*pair) is not None for pair in pairs)
        return shown if is_shown else own

    def _check_inputs(self) -> None:
        """Check that the component's input elements are shown once, all of an input or none."""
        driven: dict[int, Port] = {}
        inputs = {port: own for port, own in self._shown.items() if own.causality == "input"}
        for port, shown in inputs.items():
            for element in shown.elements:
                first = driven.get(element.column)
                if first is not None:
                    name = f"{port.component}.{element.name}"
                    self._drop(port, f"{name!r} is given twice, for '{first}' and '{port}'")
                driven[element.column] = port
        missing: dict[str, list[str]] = {}
        for port, shown in inputs.items():
            for name in shown.sources:
                if name not in missing:
                    elements = self._elements[name]
                    missing[name] = [one.name for one in elements if one.column not in driven]
                if missing[name]:
                    self._drop(
                        port,
                        f"'{port}' is a part of the input {name!r}; expected ports for the rest "
                        f"too: {', '.join(missing[name])}",
                    )

    def _drop(self, port: Port, problem: str) -> None:
        self.problems.setdefault(port, problem)
        self._shown.pop(port, None)

    def _uncovered(self) -> Iterator[ShownPort]:
        """Yield the ports of the component that none covers, under names that are not taken."""
        taken = {port.signal.name for port in self._shown.values()}
        # an element that is a signal beside its vector would be found in the vector's place
        taken |= {port.signal for port in self._shown}
        covered: set[PortElement] = set()
        for port in self._shown.values():
            covered.update(port.elements)
        for own_name, elements in self._elements.items():
            if not covered.issuperset(elements):
                name = own_name
                while name in taken:
                    name += "_"
                taken.add(name)
                yield ShownPort(replace(elements[0].signal, name=name), tuple(elements))


def _elements(signals: Iterable[Signal], causality: Causality) -> dict[str, list[PortElement]]:
    """Return the elements of every signal by its name, columns counted from 0."""
    columns = count()
    elements: dict[str, list[PortElement]] = {}
    for signal in signals:
        indices = range(signal.size)
        elements[signal.name] = [
            PortElement(signal, causality, index, next(columns)) for index in indices
        ]
    return elements


def _shown_signal(name: str, elements: Sequence[PortElement], units: Sequence[Unit]) -> Signal:
    """Return the signal that is shown for elements of one kind, variability and causality."""
    own = [element.measure for element in elements]
    to_shown = [convert or Conversion() for convert in conversions_between(own, units)]
    start: list[float] = []  # empty: zeros
    nominal: list[float] = []  # empty: that of none is known
    for element, convert in zip(elements, to_shown, strict=True):
        size = element.signal.nominal_values[element.index]
        start.append(float(convert(element.start)))
        nominal.append(size if convert.copies else size * abs(convert.factor))
    signals = [element.signal for element in elements]
    needs = {signal.connection for signal in signals}
    strictest: tuple[Need, ...] = ("forbidden", "required", "optional")
    is_one_role = len({signal.role for signal in signals}) == 1
    signal = replace(
        signals[0],
        name=name,
        size=len(elements),
        unit=None,
        base=None,
        role=signals[0].role if is_one_role else "output",
        start=tuple(start) if any(signal.start for signal in signals) else (),
        nominal=tuple(nominal) if any(signal.nominal for signal in signals) else (),
        connection=next(need for need in strictest if need in needs),
    )
    return signal.in_units(units)


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
