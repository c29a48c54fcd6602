"""The rows of a component, gathered from message records chunk by chunk."""

from __future__ import annotations

from typing import final

import numpy as np

from cosim.arrays import Matrix, Nanoseconds
from cosim.log.contents.layout import Part, Records, copy_values
from cosim.log.reading.stream import check_grid, record_times

_FIRST_ROWS = 1024


@final
class SignalRows:
    """The rows of one part of a component; grows as they are appended.

    Parameters
    ----------
    part : Part
    expected : int
        Number of rows to make room for at once.
    """

    def __init__(self, part: Part, expected: int) -> None:
        self.part = part
        self.count = 0
        self._time_ns = np.empty(expected, dtype=np.int64)
        self._values = np.empty((expected, part.size))

    @property
    def component(self) -> str:
        """Name of the component."""
        return self.part.channel.name

    def append(self, records: Records) -> None:
        """Append the rows of message records.

        Raises
        ------
        ValueError
            If they have other fields than the part, or a time beyond 2**63 - 1 ns.
        """
        stop = self.count + len(records)
        if stop > len(self._time_ns):
            self._grow(stop)
        self._time_ns[self.count : stop] = record_times(records)
        copy_values(records, self._values[self.count : stop])
        self.count = stop

    def in_time_order(self) -> tuple[Nanoseconds, Matrix]:
        """Return times (n,) and values (n, size) in the order of time.

        Raises
        ------
        ValueError
            If a time is off the grid.
        """
        time_ns = self._time_ns[: self.count]
        values = self._values[: self.count]
        if self.count:
            check_grid(time_ns, int(time_ns[0]), self.part)
        if (time_ns[1:] >= time_ns[:-1]).all():
            return time_ns, values
        # Stable: rows of one instant are the limits of a jump, told apart by their order.
        order = np.argsort(time_ns, kind="stable")
        return time_ns[order], values[order]

    def _grow(self, needed: int) -> None:
        """Make room for ``needed`` rows, and at least twice as many as before."""
        room = len(self._time_ns)
        new_room = max(needed, 2 * room, _FIRST_ROWS)
        added = new_room - room
        new_times = np.empty(added, dtype=np.int64)
        new_values = np.empty((added, self.part.size))
        self._time_ns = np.concatenate([self._time_ns, new_times])
        self._values = np.concatenate([self._values, new_values])
