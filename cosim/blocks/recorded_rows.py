"""The recorded outputs of a component by the number of their row: of many, those that are needed.

A recording may be larger than the memory. Of a long one only the rows around the last ones asked
for are kept: a run asks for them in the order of time, and goes back by few.
"""

from __future__ import annotations

from typing import Final, final

import numpy as np

from cosim.arrays import Matrix
from cosim.blocks.recorded_times import RecordedTimes, RowNumbers
from cosim.core.recording import Recording
from cosim.errors import LogError

_DOUBLE: Final = 8  # bytes
_MOST_BYTES: Final = 2**25  # of rows that are kept, if all components of a recording are replayed
_LEAST_BYTES: Final = 2**19  # of those of one component: fewer are read again and again
_BEHIND: Final = 8  # one part in so many of the rows that are kept is before the one asked for


@final
class RecordedRows:
    """The outputs of a recorded component, shape (N, n).

    Parameters
    ----------
    recording : Recording
    component : str
    times : RecordedTimes
        Of its rows. One more than it has: the last one is that of the row before it again.

    Attributes
    ----------
    begin, stop : int
        Numbers of the rows in memory.
    rows : Matrix, shape (stop - begin, n)
        These.
    """

    def __init__(self, recording: Recording, component: str, times: RecordedTimes) -> None:
        self._recording = recording
        self._component = component
        self._times = times
        interface = recording.channels[component].interface
        self._n_u = interface.n_u
        most_bytes = max(_MOST_BYTES // len(recording.channels), _LEAST_BYTES)
        size = most_bytes // (_DOUBLE * max(interface.n_y, 1))
        self._size = max(size, 2 * _BEHIND)
        self.begin = 0
        self.stop = 0
        self.rows = np.empty((0, interface.n_y))
        self._move_to(0)

    def __len__(self) -> int:
        return len(self._times)

    def at(self, numbers: RowNumbers) -> Matrix:
        """Return the rows of ascending numbers, shape (k, n)."""
        rows = np.empty((len(numbers), self.rows.shape[1]))
        done = 0
        while done < len(numbers):
            self._move_to(int(numbers[done]))
            end = int(np.searchsorted(numbers, self.stop))
            rows[done:end] = self.rows[numbers[done:end] - self.begin]
            done = end
        return rows

    def _move_to(self, number: int) -> None:
        """Have a row in memory, and others around it."""
        if self.begin <= number < self.stop:
            return
        self.begin = self.stop = 0
        self.rows = self.rows[:0].copy()  # before the next ones are read
        begin = max(number - self._size // _BEHIND, 0)
        stop = min(begin + self._size, len(self))
        if stop - begin < len(self):
            begin, stop = self._times.span(begin, stop)
        self.rows = self._read(begin, stop)
        self.begin = begin
        self.stop = stop

    def _read(self, begin: int, stop: int) -> Matrix:
        """Read some rows.

        Raises
        ------
        LogError
            If the recording has others than before.
        """
        is_whole = stop - begin == len(self)
        first_ns = None if is_whole else int(self._times.nanoseconds(begin, begin + 1)[0])
        last_ns = None if is_whole else int(self._times.nanoseconds(stop - 1, stop)[0])
        blocks = []
        for _, rows in self._recording.blocks(self._component, first_ns=first_ns, last_ns=last_ns):
            blocks.append(rows[:, self._n_u :])
        found = blocks[0] if len(blocks) == 1 else np.concatenate(blocks)
        needed = stop - begin
        if len(found) == needed - 1 and stop == len(self):
            found = np.concatenate([found, found[-1:]])
        if len(found) != needed:
            raise LogError(
                f"{self._recording.label}: expected {needed} rows of {self._component!r}, got "
                f"{len(found)}"
            )
        return found
