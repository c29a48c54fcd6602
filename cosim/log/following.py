"""Rows of a log that is still written, as they come, until the run ends.

The log is opened again for every look, and read only from the last instant that was yielded on. A
flush contains the rows of all components up to one step, so that every row is complete when it is
seen. What a run writes again with its next flush may change while it is read: then it is read once
more, from the instant that was reached. A log that is rotated is followed from file to file.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Final, final

from cosim.core.recorded.joined_rows import JoinedRows, joined_rows
from cosim.core.recorded.run import RecordedWindow, span_ns
from cosim.core.recorded.selection import SelectedColumn, split_names
from cosim.errors import LogError
from cosim.instants import Seconds
from cosim.log.files import OwnFile, is_begun, is_written, part_path, part_paths
from cosim.log.preamble import PART_REASON, PARTIAL, PARTIAL_STATUS
from cosim.log.reader import Log, open_log
from cosim.log.text import LogChoice

POLL_INTERVAL: Final = 0.2  # s of wall time between two looks
_ATTEMPTS: Final = 5  # to read a log that a run writes to, without a row more, or to find the next


@final
class FollowedLog:
    """A table of signals of a log that may still be written.

    Parameters
    ----------
    path : Path
    names : iterable of str, or None
        Names and patterns, several with commas between; None: all.
    start, stop : float, Decimal or None
        First and last time [s].
    wait : callable, optional
        Called between two looks.

    Raises
    ------
    UsageError
        If ``start`` is after ``stop``.
    LogError
        If the log is not there or cannot be read, or a signal is unknown.
    """

    def __init__(
        self,
        path: Path,
        names: Iterable[str] | None,
        start: Seconds | None = None,
        stop: Seconds | None = None,
        *,
        wait: Callable[[], None] | None = None,
    ) -> None:
        first_ns, self._last_ns = span_ns(start, stop, names=("--from", "--to"))
        self._next_ns = 0 if first_ns is None else first_ns
        log = open_log(path)
        self._path = log.path
        # Whatever is at the path later: this is the file that is followed.
        self._own = OwnFile(log.path)
        choice = LogChoice.of(log, None if names is None else split_names(",".join(names)))
        self._columns = choice.columns
        self._wait = wait or partial(time.sleep, POLL_INTERVAL)

    @property
    def columns(self) -> tuple[SelectedColumn, ...]:
        """The elements of the signals, each once."""
        return self._columns

    def joined(self) -> Iterator[JoinedRows]:
        """Yield the signals joined on time, some rows at a time, until the run has ended.

        Raises
        ------
        LogError
            If the log is damaged.
        """
        failures = 0
        while True:
            # Before the rows are read: a run that ends after that may have written more of them.
            may_grow = is_written(self._path)
            next_before = self._next_ns
            try:
                log = Log(self._path, self._own)
                yield from self._new_rows(log)
                has_ended = log.status != "unfinished" or self._is_past(log)
            except LogError:
                failures = 0 if self._next_ns > next_before else failures + 1
                if failures == _ATTEMPTS:
                    raise
                self._wait()
                continue
            failures = 0
            if not has_ended and may_grow:
                self._wait()
            elif not self._goes_on(log):
                return

    def _goes_on(self, log: Log) -> bool:
        """Turn to the next file of a log that was rotated; return whether there is one.

        It is begun before the end of the one before, and gets its name after it, unless the run is
        killed there.
        """
        is_part = log.status == PARTIAL_STATUS and log.reason.startswith(PART_REASON)
        if not is_part or PARTIAL in log.metadata or self._is_past(log):
            return False
        paths = part_paths(self._path)
        following = part_path(paths[0], len(paths) + 1)
        looks = 0
        while not following.exists():
            if looks == _ATTEMPTS:
                return False
            if not is_begun(following):
                looks += 1  # it has its name by now, or nothing tells that it is written
            self._wait()
        self._own = OwnFile(following)
        self._path = following
        return True

    def _new_rows(self, log: Log) -> Iterator[JoinedRows]:
        window = RecordedWindow(log, self._next_ns, self._last_ns)
        for part in joined_rows(window, self._columns):
            if len(part):
                self._next_ns = int(part.time_ns[-1]) + 1
                yield part

    def _is_past(self, log: Log) -> bool:
        """Return whether the log has all rows that are wanted."""
        return self._last_ns is not None and log.end_ns >= self._last_ns
