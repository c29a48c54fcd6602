"""Some input elements of the components of a loop, in an order: those that connections feed."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.core.stages.member import Member
from cosim.core.structure.feedthrough import Edge
from cosim.core.structure.ports import Ports

NO_ELEMENTS: Final = (np.empty(0, np.intp), slice(0, 0))


@final
class InputElements:
    """The input elements that some connections feed.

    Parameters
    ----------
    connections : collection of (input Port, source Port)
    members : sequence of Member
        The components of the loop.
    ports : Ports

    Attributes
    ----------
    columns : tuple of int
        Of the elements, in the row; ascending by component.
    members : tuple of Member
        The components that have some.
    """

    def __init__(
        self, connections: Collection[Edge], members: Sequence[Member], ports: Ports
    ) -> None:
        columns: list[int] = []
        self._own: dict[str, tuple[NDArray[np.intp], slice]] = {}
        with_some = []
        for member in members:
            own = _columns_fed(connections, member, ports)
            if not own:
                continue
            with_some.append(member)
            places = slice(len(columns), len(columns) + len(own))
            self._own[member.name] = (np.array(own), places)
            columns += own
        self.members = tuple(with_some)
        self.columns = tuple(columns)

    def __len__(self) -> int:
        return len(self.columns)

    @property
    def labels(self) -> list[str]:
        """The names of the elements."""
        labels = []
        for member in self.members:
            columns, _ = self.of(member)
            labels += [member.label(int(column) - member.columns.start) for column in columns]
        return labels

    def of(self, member: Member) -> tuple[NDArray[np.intp], slice]:
        """Return the columns of a component's elements, and their places among all."""
        return self._own.get(member.name, NO_ELEMENTS)

    def put(self, row: Vector, member: Member, values: Vector) -> None:
        """Set the elements of a component; ``values`` are those of all."""
        own = self._own.get(member.name)
        if own is not None:
            columns, places = own
            row[columns] = values[places]

    def driven(self, row: Vector, values: Vector) -> None:
        """Fill the values of all elements with what a row gives for them."""
        gathered: Matrix = row[np.newaxis].copy()
        for member in self.members:
            columns, places = self._own[member.name]
            member.gather(gathered, slice(0, 1))
            values[places] = gathered[0, columns]


def _columns_fed(connections: Collection[Edge], member: Member, ports: Ports) -> list[int]:
    """Return the columns of a component's inputs that connections feed."""
    sources: dict[str, set[int]] = {}
    for to, source in connections:
        if to.component == member.name:
            columns = ports.output(source).columns
            sources.setdefault(to.signal, set()).update(range(columns.start, columns.stop))
    fed: set[int] = set()
    for signal, own_sources in sources.items():
        of_input = member.channel.signal_columns[signal]
        for wire in member.wires:
            if of_input.start <= wire.to.start < of_input.stop:
                for column, sources_of_column in wire.sources_by_column.items():
                    if sources_of_column & own_sources:
                        fed.add(column)
    return sorted(fed)
