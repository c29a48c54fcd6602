"""The rows of a component, gathered from message records chunk by chunk."""

from __future__ import annotations

from typing import final

import numpy as np

from cosim.arrays import Matrix, Nanoseconds
from cosim.log.layout import Part, Records, copy_values

_FIRST_ROWS = 1024


@final
class SignalRows:
    """The rows of one part of a component; grows as they come.

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
        """Take message records.

        Raises
        ------
        ValueError
            If they have other fields than the part, or a time beyond 2**63 - 1 ns.
        """
        stop = self.count + len(records)
        if stop > len(self._time_ns):
            more = max(stop, 2 * len(self._time_ns), _FIRST_ROWS) - len(self._time_ns)
            self._time_ns = np.concatenate([self._time_ns, np.empty(more, dtype=np.int64)])
            self._values = np.concatenate([self._values, np.empty((more, self.part.size))])
        times = records["log_time"].astype(np.int64)
        if (times < 0).any():
            raise ValueError(f"a time beyond {np.iinfo(np.int64).max} ns")
        self._time_ns[self.count : stop] = times
        copy_values(records, self._values[self.count : stop])
        self.count = stop

    def sorted(self) -> tuple[Nanoseconds, Matrix]:
        """Give times (n,) and values (n, size) in the order of time; rows of one time keep their order."""
        time_ns, values = self._time_ns[: self.count], self._values[: self.count]
        if (time_ns[1:] < time_ns[:-1]).any():
            order = np.argsort(time_ns, kind="stable")
            return time_ns[order], values[order]
        return time_ns, values
