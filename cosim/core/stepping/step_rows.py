"""The rows of communication steps by the names of signals."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import final

import numpy as np

from cosim.arrays import Matrix, Nanoseconds
from cosim.core.clock import Clock
from cosim.core.port import Port
from cosim.core.recorded.signals import find_signal
from cosim.core.signals import Layout


@final
class SignalColumns:
    """The columns of the row by the names of signals, or of their elements.

    Parameters
    ----------
    layout : Layout
    clock : Clock

    Attributes
    ----------
    clock : Clock
    signals : tuple of str
        All signals: ``component.signal``.
    """

    def __init__(self, layout: Layout, clock: Clock) -> None:
        self.clock = clock
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
            matched = find_signal(self._channels, signal, source="the simulation")
        start = matched.channel.start
        columns = slice(start + matched.columns.start, start + matched.columns.stop)
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
    index : int
        Number of the communication point of that.
    """

    __slots__ = ("_columns", "_index", "_signals")

    def __init__(self, columns: SignalColumns, signals: Matrix, index: int) -> None:
        self._columns = columns
        self._signals = signals
        self._index = index

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

    def joined(self, others: Sequence[StepRows]) -> StepRows:
        """Return these rows and those of the next steps."""
        signals = np.concatenate([self._signals, *(rows._signals[1:] for rows in others)])
        signals.flags.writeable = False
        return StepRows(self._columns, signals, self._index)

    @property
    def steps(self) -> int:
        """Number of communication steps."""
        return len(self._signals) - 1

    @property
    def time_ns(self) -> Nanoseconds:
        """The instants of the rows [ns], shape (steps,)."""
        return self._columns.clock.block_at(self._index, self.steps).time_ns[1:]


def joined_rows(parts: Iterable[StepRows | None]) -> StepRows | None:
    """Return the rows of steps that follow each other; None: there are none."""
    given = [rows for rows in parts if rows is not None]
    return given[0].joined(given[1:]) if given else None
