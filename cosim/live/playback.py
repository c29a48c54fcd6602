"""A log played to viewers at the pace of the wall clock.

The log is read in windows of about 10 ms of wall time. The rows and messages of a window are sent
when its end is due. Ends are counted from the start in whole nanoseconds, so that errors do not add
up; if sending takes too long, the next windows are sent at once.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from math import ceil
from typing import Final, final

import numpy as np

from cosim.arguments import positive_argument
from cosim.arrays import Matrix, Nanoseconds
from cosim.errors import LogError
from cosim.instants import NANOSECONDS
from cosim.live.publisher import Publisher
from cosim.live.server import LiveServer
from cosim.log import Log
from cosim.log.preamble import LOG_TOPIC
from cosim.scenario.record import Lateness
from cosim.scenario.running.real_time import BLOCK, RealTimePace

_LONGEST_SLEEP: Final = 0.05  # s, until it is looked whether playback is to end
_TOGETHER: Final = 10_000  # messages that are read at once


def play(log: Log, server: LiveServer, *, speed: float = 1.0, loop: bool = False) -> Lateness:
    """Play a log to the viewers of a server.

    Parameters
    ----------
    log : Log
    server : LiveServer
        Inside its ``with`` block.
    speed : float
        Simulated time by wall time.
    loop : bool
        Begin again at the end, until somebody interrupts.

    Returns
    -------
    Lateness
        How late it was.

    Raises
    ------
    UsageError
        If the speed is not a number > 0, or a signal to publish is not in the log.
    LogError
        If the log has no rows, or is damaged.
    """
    playback = Playback(log, server, speed=speed)
    playback.run(loop=loop)
    return playback.lateness


@final
class Playback:
    """Plays a log; see :func:`play`.

    Parameters
    ----------
    log : Log
    server : LiveServer
    speed : float
    check : callable
        Called again and again; what it raises ends playback.
    now : callable
        Returns the wall time [s]; it never goes back.
    sleep : callable
        Waits for some seconds.
    """

    def __init__(
        self,
        log: Log,
        server: LiveServer,
        *,
        speed: float = 1.0,
        check: Callable[[], None] = lambda: None,
        now: Callable[[], float] = time.perf_counter,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._log = log
        self._connection = server.free_connection()
        self._check = check
        self._now = now
        self._sleep = sleep
        factor = positive_argument("speed", speed)
        self._window_ns = max(1, round(BLOCK * factor * NANOSECONDS))
        self._publisher = Publisher(
            self._connection,
            log.channels,
            kinds=log.kinds,
            step_ns=log.step_ns,
            names=server.signals,
            source=str(log.path),
        )
        self._message_counts = log.message_counts()
        for topic in dict.fromkeys([LOG_TOPIC, *self._message_counts]):
            self._publisher.advertise(topic)
        starts = [cursor.next_ns for cursor in self._cursors()]
        known = [start for start in starts if start is not None]
        if not known:
            raise LogError(f"{log.path} has no rows to play")
        self._start_ns = min(known)
        start = self._start_ns / NANOSECONDS
        self._pace = RealTimePace(factor, start, now=now, sleep=self._sleep_watched)
        server.listen()

    @property
    def lateness(self) -> Lateness:
        """How late it was so far."""
        return self._pace.lateness

    def run(self, *, loop: bool = False) -> None:
        """Play from the start to the end, and again where ``loop`` says so.

        Raises
        ------
        LogError
            If the log is damaged.
        """
        self._pace.begin()
        length_ns = self._log.end_ns - self._start_ns + ceil(self._log.step_ns)
        shift_ns = 0
        while True:
            self._play_once(shift_ns)
            if not loop:
                return
            shift_ns += length_ns
            self._connection.turn_back()

    def _play_once(self, shift_ns: int) -> None:
        """Play all windows, ``shift_ns`` later than when the first round began."""
        cursors = self._cursors()
        messages = _MessageCursor(self._log, sum(self._message_counts.values()), self._start_ns)
        end_ns = self._start_ns
        while True:
            self._check()
            # The first row is there at the start.
            counts = shift_ns > 0 or end_ns > self._start_ns
            later = shift_ns / NANOSECONDS
            self._pace.reach(end_ns / NANOSECONDS, later=later, counts=counts)
            for cursor in cursors:
                for time_ns, rows in cursor.take(end_ns):
                    self._publisher.add_rows(cursor.component, time_ns, rows)
            for message in messages.take(end_ns):
                self._publisher.add_message(*message)
            self._publisher.send()
            left = [messages.next_ns, *(cursor.next_ns for cursor in cursors)]
            following = [instant for instant in left if instant is not None]
            if not following:
                return
            windows = -((self._start_ns - min(following)) // self._window_ns)
            end_ns = self._start_ns + windows * self._window_ns

    def _cursors(self) -> list[_Cursor]:
        return [_Cursor(self._log, name) for name in self._publisher.components]

    def _sleep_watched(self, seconds: float) -> None:
        """Wait, but end at once where playback is to end."""
        until = self._now() + seconds
        while (left := until - self._now()) > 0.0:
            self._sleep(min(left, _LONGEST_SLEEP))
            self._check()


@final
class _Cursor:
    """The rows of a component, taken up to one instant after the other."""

    def __init__(self, log: Log, component: str) -> None:
        self.component = component
        self._blocks = log.blocks(component)
        self._time_ns: Nanoseconds = np.empty(0, np.int64)
        self._rows: Matrix = np.empty((0, 0))
        self._first = 0
        self._advance()

    @property
    def next_ns(self) -> int | None:
        """Instant of the next row [ns]; None: there is none."""
        if self._first < len(self._time_ns):
            return int(self._time_ns[self._first])
        return None

    def take(self, until_ns: int) -> list[tuple[Nanoseconds, Matrix]]:
        """Return the rows up to an instant that were not taken yet, in pieces."""
        pieces = []
        while self.next_ns is not None and self.next_ns <= until_ns:
            stop = int(np.searchsorted(self._time_ns, until_ns, side="right"))
            taken = slice(self._first, stop)
            pieces.append((self._time_ns[taken], self._rows[taken]))
            self._first = stop
            self._advance()
        return pieces

    def _advance(self) -> None:
        """Go on to the next block that has rows, where this one has no more."""
        while self._first >= len(self._time_ns):
            block = next(self._blocks, None)
            if block is None:
                return
            self._time_ns, self._rows = block
            self._first = 0


@final
class _MessageCursor:
    """The messages of a log beside its rows, read for some time at once, as if evenly spread.

    Parameters
    ----------
    log : Log
    count : int
        How many there are.
    start_ns : int
        When the rows begin [ns].
    """

    def __init__(self, log: Log, count: int, start_ns: int) -> None:
        self._log = log
        self._last_ns: int | None = start_ns
        parts = max(1, count // _TOGETHER)
        self._span_ns = max(1, (log.end_ns - start_ns) // parts)
        self._waiting: deque[tuple[str, int, bytes]] = deque()
        if count:
            self._read(None)
        else:
            self._last_ns = None

    @property
    def next_ns(self) -> int | None:
        """Time of the next message [ns]; None: there is none."""
        return self._waiting[0][1] if self._waiting else None

    def take(self, until_ns: int) -> Iterator[tuple[str, int, bytes]]:
        """Yield topic, time [ns] and data of the next messages up to a time."""
        while self._waiting and self._waiting[0][1] <= until_ns:
            message = self._waiting.popleft()
            if not self._waiting and self._last_ns is not None:
                self._read(self._last_ns + 1)
            yield message

    def _read(self, first_ns: int | None) -> None:
        """Read the next messages, from a time on; all that are left in the last part."""
        while not self._waiting and self._last_ns is not None:
            self._last_ns += self._span_ns
            if self._last_ns >= self._log.end_ns:
                self._last_ns = None
            self._waiting.extend(self._log.messages_between(first_ns, self._last_ns))
            first_ns = None if self._last_ns is None else self._last_ns + 1
