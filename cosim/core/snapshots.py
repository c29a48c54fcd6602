"""What a simulation hands out: the rows of steps by the names of signals, and its states."""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, final

import numpy as np

from cosim.arrays import Matrix, Nanoseconds, Vector
from cosim.core.clock import Clock
from cosim.core.contracts import Plan
from cosim.core.graph import Graph
from cosim.core.port import Port
from cosim.core.recorded import find_signal
from cosim.core.signals import Layout
from cosim.errors import UsageError


@final
class SignalColumns:
    """The columns of the row by the names of signals, or of their elements.

    Parameters
    ----------
    layout : Layout
    step_ns : int
        Communication step [ns].

    Attributes
    ----------
    signals : tuple of str
        All signals: ``component.signal``.
    """

    def __init__(self, layout: Layout, step_ns: int) -> None:
        self.step_ns = step_ns
        self._channels = {channel.name: channel for channel in layout.channels}
        self._known: dict[str | Port, slice] = {}
        for channel in layout.channels:
            for name, columns in channel.signal_columns.items():
                self._known[f"{channel.name}.{name}"] = columns
        self.signals = tuple(map(str, self._known))

    def __getitem__(self, signal: str | Port) -> slice:
        """Return the columns of a signal, or of elements of it.

        Raises
        ------
        UnknownSignalError
            If there is no such component, signal or element; names the nearest.
        """
        try:
            return self._known[signal]
        except (KeyError, TypeError):  # elements of a signal, or nothing that there is
            found = find_signal(self._channels, signal, source="the simulation")
        start = found.channel.start
        columns = slice(start + found.columns.start, start + found.columns.stop)
        self._known[signal] = columns
        return columns


@final
class StepRows(Mapping[str, Matrix]):
    """What signals were at the ends of some communication steps, by name; yours to keep.

    An array has shape (steps, size), and cannot be written to. Where a signal jumps at the end of
    a step, it is the value before. Elements can be asked for too: ``rows["plant.x_a[1]"]``.

    Parameters
    ----------
    columns : SignalColumns
    signals : Matrix, shape (steps + 1, width)
        Row 0 is the start of the first step.
    begin_ns : int
        Time of that [ns].
    """

    __slots__ = ("_begin_ns", "_columns", "_signals")

    def __init__(self, columns: SignalColumns, signals: Matrix, begin_ns: int) -> None:
        self._columns = columns
        self._signals = signals
        self._begin_ns = begin_ns

    def __getitem__(self, signal: str) -> Matrix:
        """Return a signal, or elements of it, shape (steps, size).

        Raises
        ------
        UnknownSignalError
            If there is no such component, signal or element; names the nearest.
        """
        return self._signals[1:, self._columns[signal]]

    def __iter__(self) -> Iterator[str]:
        return iter(self._columns.signals)

    def __len__(self) -> int:
        return len(self._columns.signals)

    def __repr__(self) -> str:
        return f"<{self.steps} communication steps of {len(self)} signals>"

    @property
    def steps(self) -> int:
        """Number of communication steps."""
        return len(self._signals) - 1

    @property
    def time_ns(self) -> Nanoseconds:
        """The instants of the rows [ns], shape (steps,)."""
        numbers = np.arange(1, len(self._signals), dtype=np.int64)
        return self._begin_ns + numbers * self._columns.step_ns


@dataclass(frozen=True, eq=False)
class SimulationState:
    """The state of a simulation at a communication point; it can be pickled.

    Parameters
    ----------
    graph : str
        Hash of the graph that it is a state of.
    index : int
        Number of the communication point.
    row : Vector, shape (width,)
        All signals there, behind the jumps.
    overrides : mapping of column to float
        Of inputs.
    components : mapping of component name to its state
        What delays and filters hold, the states of random generators, and so on.
    origin : object
        The simulation in whose memory component states may lie; not pickled.
    """

    graph: str
    index: int
    row: Vector
    overrides: Mapping[int, float]
    components: Mapping[str, Any]
    origin: object = field(default=None, repr=False)

    def __reduce__(self) -> tuple[Any, ...]:
        self.check_portable()
        values = (self.graph, self.index, self.row, self.overrides, self.components)
        return SimulationState, values

    def check_portable(self) -> None:
        """Check that every component's state can leave the simulation that it was taken of.

        Raises
        ------
        UsageError
            If one lies in the memory of its component, as that of an FMU does.
        """
        for name, state in self.components.items():
            try:
                pickle.dumps(state)
            except Exception as error:  # a state is the component's own, and may raise anything
                raise UsageError(
                    f"state: that of {name!r} cannot leave its simulation: {error}; needed "
                    "components whose states can be pickled"
                ) from error


def graph_hash(graph: Graph, clock: Clock, plan: Plan, identity: str | None) -> str:
    """Return the hash of a graph on a clock.

    It covers the structure, and ``identity``, which stands for the values; None: the designs do.
    """
    digest = hashlib.sha256()
    structure = (graph.layout, graph.input_interpolation, plan.schedule)
    times = (clock.start_ns, clock.step_ns)
    digest.update(repr((structure, times, identity)).encode())
    for to, connection in graph.connections.items():
        digest.update(repr((to, connection.sources, connection.offset, connection.unit)).encode())
        digest.update(connection.matrix.tobytes())
    if identity is None:
        for name, design in plan.designs.items():
            for key, array in design.items():
                digest.update(repr((name, key, array.shape)).encode())
                digest.update(array.tobytes())
    return digest.hexdigest()
