"""Connections: which outputs drive which input, with what gain, and in what unit."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import InitVar, dataclass, field
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cosim.core.arguments import check_type, kind_of
from cosim.core.port import Port
from cosim.core.structure.ports import ConnectionEnd, Ports
from cosim.errors import GraphError
from cosim.units import Conversion, Unit, conversion, conversions_between

SourceText: TypeAlias = str | Port | Sequence[str | Port]
AS_IS: Final = "as is"  # the unit of a connection that converts nothing
ONE_SOURCE: Final = "an input has one source (add signals with a 'sum')"


@dataclass(frozen=True, slots=True, eq=False)
class Connection:
    """What drives an input: ``gain source + offset``, converted from the unit reached to its unit.

    Parameters
    ----------
    source : str, Port, or a sequence of these
        ``component.output``, or elements of it: ``component.output[1]``, ``component.output[0:2]``.
        Several sources are stacked in their order.
    gain : float or matrix of shape (size of the input, size of all sources)
    offset : float
        In the unit reached.
    unit : str, sequence of str, or None
        Unit reached by gain and offset, or one for each element of the input; None: that of each
        source; ``"as is"``: that of the input, whatever the sources declare.

    Attributes
    ----------
    sources : tuple of Port

    Raises
    ------
    GraphError
        If a source is no port, or gain and offset are not finite numbers or a matrix.
    """

    source: InitVar[SourceText]
    gain: float | ArrayLike = 1.0
    offset: float = 0.0
    unit: str | Sequence[str] | None = None
    sources: tuple[Port, ...] = field(init=False)

    def __post_init__(self, source: SourceText) -> None:
        sources = _parsed(source)
        if not sources:
            raise GraphError("a connection has no source; expected at least one")
        label = _label(sources)
        gain = _number("gain", label, self.gain)
        offset = _number("offset", label, self.offset)
        if gain.ndim not in (0, 2) or offset.ndim:
            raise GraphError(
                f"'{label}': expected a number or a matrix as gain and a number as offset, got "
                f"gain {self.gain!r} and offset {self.offset!r}"
            )
        if isinstance(self.unit, list | tuple):
            object.__setattr__(self, "unit", tuple(self.unit))
        elif self.unit is not None:
            check_type(f"'{label}': unit", self.unit, str, GraphError)
        for unit in self.unit if isinstance(self.unit, tuple) else ():
            check_type(f"'{label}': unit", unit, str, GraphError)
        object.__setattr__(self, "gain", gain)
        object.__setattr__(self, "offset", float(offset))
        object.__setattr__(self, "sources", sources)

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The gain as an array, of no or of two dimensions."""
        return np.asarray(self.gain, np.float64)

    def unit_of(self, element: int) -> str | None:
        """Return the unit that an element of the input reaches, where it is given."""
        if self.unit is None or isinstance(self.unit, str):
            return self.unit
        return self.unit[element]

    @property
    def label(self) -> str:
        """The sources as they are written."""
        return _label(self.sources)


def _number(key: str, label: str, value: ArrayLike) -> NDArray[np.float64]:
    """Return finite real numbers as an array that cannot be written to."""
    try:
        array = np.asarray(value)
    except ValueError as error:
        raise GraphError(
            f"'{label}': expected a number or a matrix as {key}, got rows of different lengths: "
            f"{value!r}"
        ) from error
    is_real = array.dtype.kind in "iuf" and type(value) is not np.ma.MaskedArray
    if not is_real or not np.isfinite(array).all():
        raise GraphError(f"'{label}': expected finite numbers or a matrix as {key}, got {value!r}")
    numbers = array.astype(np.float64)
    numbers.setflags(write=False)
    return numbers


def _parsed(source: SourceText) -> tuple[Port, ...]:
    if isinstance(source, str | Port):
        source = [source]
    if not isinstance(source, Sequence):
        raise GraphError(
            "expected a port such as 'plant.y', or a list of ports, as the source of a "
            f"connection, got {kind_of(source)}"
        )
    ports = []
    for port in source:
        ports.append(port if isinstance(port, Port) else Port.parse(port))
    return tuple(ports)


def _label(sources: Iterable[Port]) -> str:
    return ", ".join(map(str, sources))


def components_driving(connections: Mapping[Port, Connection], to: Port) -> frozenset[str]:
    """Return the components that drive an input, as a whole or by its elements."""
    drivers: set[str] = set()
    for port, connection in connections.items():
        if port.component == to.component and to in (port, port.whole):
            drivers.update(source.component for source in connection.sources)
    return frozenset(drivers)


def component_driving(connections: Mapping[Port, Connection], to: Port) -> str | None:
    """Return the component that drives an input alone, as a whole or by its elements.

    None: nothing drives it, or sources of several components do.
    """
    drivers = list(components_driving(connections, to))
    return drivers[0] if len(drivers) == 1 else None


class ElementUnits(NamedTuple):
    """The units of an element of a source, after gain and offset, and of the element it drives."""

    source: Unit
    reached: Unit
    target: Unit

    @property
    def conversion(self) -> Conversion | None:
        """The conversion from the unit reached to that of the input; None: there is none."""
        return conversion(self.reached, self.target)


def element_units(
    connection: Connection, sources: Iterable[ConnectionEnd], to: ConnectionEnd
) -> list[tuple[ElementUnits, ...]]:
    """Return for each element of an input the units of what drives it, each once.

    A name that either port uses means what it does there. Elements with a gain of 0 drive nothing,
    if not all of a row are 0.
    """
    distinct: list[tuple[Unit, Mapping[str | None, Unit]]] = []
    kinds: list[int] = []  # of the elements of all sources: which of the distinct ones
    for source in sources:
        used = dict.fromkeys((*to.signal.measures, *source.signal.measures))
        known = {unit.name: unit for unit in used}
        own = source.measures
        numbers = {unit: len(distinct) + i for i, unit in enumerate(dict.fromkeys(own))}
        distinct += [(unit, known) for unit in numbers]
        kinds += [numbers[unit] for unit in own]
    found: dict[Any, tuple[ElementUnits, ...]] = {}
    by_target = []
    gain = connection.matrix
    for row, target in enumerate(to.measures):
        name = connection.unit_of(row)
        feeding = tuple(kinds[row : row + 1])
        if gain.ndim:
            driving = np.flatnonzero(gain[row, : len(kinds)]) if row < len(gain) else ()
            feeding = tuple({kinds[column]: None for column in driving} or dict.fromkeys(kinds))
        key = (feeding, name, target)
        if key not in found:
            rows = [_element_units(distinct[kind], name, target) for kind in feeding]
            found[key] = tuple(dict.fromkeys(rows))
        by_target.append(found[key])
    return by_target


def _element_units(
    source: tuple[Unit, Mapping[str | None, Unit]], name: str | None, target: Unit
) -> ElementUnits:
    """Return the units where ``name`` is given; beside that of the source those of all names."""
    own, known = source
    if name is None:
        return ElementUnits(own, own, target)
    return ElementUnits(own, target if name == AS_IS else known.get(name, Unit(name)), target)


def conversions_of(ports: Ports, to: Port, connection: Connection) -> tuple[Conversion, ...]:
    """Return the conversion at the end of a checked connection, for each element of the input."""
    sources = [ports.output(port) for port in connection.sources]
    pairs = [row[0] for row in element_units(connection, sources, ports.input(to))]
    reached = [units.reached for units in pairs]
    conversions = conversions_between(reached, [units.target for units in pairs])
    assert None not in conversions
    return tuple(filter(None, conversions))
