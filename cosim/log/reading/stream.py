"""The rows of a component as they come, chunk by chunk, so that a log may be larger than memory."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TypeAlias, final

import numpy as np

from cosim.arrays import Matrix, Nanoseconds
from cosim.core.clock import LARGEST_NS
from cosim.instants import NANOSECONDS, Grid
from cosim.log.contents.layout import Part, Records, copy_values

TimedRows: TypeAlias = tuple[Nanoseconds, Matrix]  # shapes (n,) and (n, width)

_ROWS = 2**15  # of a part that are converted at a time
_MOST_PENDING = 2**26  # bytes of one part's rows that wait for those of another


def record_times(records: Records) -> Nanoseconds:
    """Return the times of message records.

    Raises
    ------
    ValueError
        If one is beyond 2**63 - 1 ns.
    """
    times: Nanoseconds = records["log_time"].astype(np.int64)
    if (times < 0).any():
        raise ValueError(f"a time beyond {LARGEST_NS} ns")
    return times


def check_grid(time_ns: Nanoseconds, first_ns: int, part: Part) -> None:
    """Check that the times of rows are whole periods of their component away from one of them.

    Raises
    ------
    ValueError
        If one is not.
    """
    grid = Grid(first_ns, part.step_ns)
    period = part.channel.period
    off = grid.stamp(grid.number(time_ns) // period * period) != time_ns  # faster than a remainder
    if off.any():
        time = time_ns[int(off.argmax())] / 1e9
        raise ValueError(
            f"a row of {part.channel.name!r} at t = {time} s is off its grid: rows are "
            f"{float(period * part.step_ns / NANOSECONDS)} s apart, from {first_ns / 1e9} s on"
        )


@final
class RowStream:
    """Joins the parts of one component to its rows.

    Parameters
    ----------
    parts : mapping of channel id to Part

    Attributes
    ----------
    ordered : bool
        Whether the rows came in order of time; where not, no more are joined.
    """

    def __init__(self, parts: Mapping[int, Part]) -> None:
        self._parts = dict(sorted(parts.items(), key=lambda item: item[1].columns.start))
        self._pending: dict[int, TimedRows] = {}
        for number, part in self._parts.items():
            self._pending[number] = (np.empty(0, np.int64), np.empty((0, part.size)))
        self._first_ns: int | None = None
        self._last_ns = 0
        self.ordered = True
        self.counts = dict.fromkeys(self._parts, 0)

    def append(self, number: int, records: Records) -> Iterator[TimedRows]:
        """Add message records of a channel; yield the rows that are whole now.

        Raises
        ------
        ValueError
            If the records are damaged, the channels have rows at different times, or one is off the
            grid.
        """
        self.counts[number] += len(records)
        for start in range(0, len(records), _ROWS):
            if not self.ordered:
                return
            self._convert(number, records[start : start + _ROWS])
            time_ns, rows = self._whole()
            if not len(time_ns):
                continue
            if self._first_ns is None:
                self._first_ns = int(time_ns[0])
            check_grid(time_ns, self._first_ns, self._parts[number])
            in_order = bool((time_ns[1:] >= time_ns[:-1]).all())
            self.ordered = in_order and int(time_ns[0]) >= self._last_ns
            if self.ordered:
                self._last_ns = int(time_ns[-1])
                yield time_ns, rows

    def finish(self) -> None:
        """Check that no rows are left.

        Raises
        ------
        ValueError
            If a channel has fewer rows than another.
        """
        if self.ordered and any(len(times) for times, _ in self._pending.values()):
            raise ValueError("the channels of a component have different numbers of rows")

    def _convert(self, number: int, records: Records) -> None:
        """Add rows of a part to those that wait."""
        times, values = self._pending[number]
        new_values = np.empty((len(records), self._parts[number].size))
        copy_values(records, new_values)
        if len(times):
            new_times = np.concatenate([times, record_times(records)])
            new_values = np.concatenate([values, new_values])
        else:
            new_times = record_times(records)
        if new_values.nbytes > _MOST_PENDING and len(self._parts) > 1:
            raise ValueError("the channels of a component are too far apart to be joined")
        self._pending[number] = (new_times, new_values)

    def _whole(self) -> TimedRows:
        """Take the rows of which every part has come."""
        if len(self._pending) == 1:
            return self._whole_part()
        count = min(len(times) for times, _ in self._pending.values())
        taken_times = []
        taken_values = []
        for number, (times, values) in self._pending.items():
            taken_times.append(times[:count])
            taken_values.append(values[:count])
            self._pending[number] = (times[count:].copy(), values[count:].copy())
        for other in taken_times[1:]:
            if not np.array_equal(taken_times[0], other):
                raise ValueError("the channels of a component have rows at different times")
        return taken_times[0], np.hstack(taken_values)

    def _whole_part(self) -> TimedRows:
        """Take all rows of the only part."""
        ((number, (times, values)),) = self._pending.items()
        self._pending[number] = (times[:0].copy(), values[:0].copy())
        return times, values
