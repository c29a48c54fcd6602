"""A log played to viewers at the pace of the wall clock.

The log is read in windows of about 10 ms of wall time. When the end of a window has come, its rows
and messages are sent. Ends are counted from the start, in whole nanoseconds, so that no error adds
up; where sending takes too long, the next windows are due already.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final, final

import numpy as np

from cosim.arrays import Matrix, Nanoseconds
from cosim.errors import LogError
from cosim.instants import NANOSECONDS
from cosim.live.publisher import Publisher
from cosim.live.server import LiveServer
from cosim.log import Log
from cosim.log.contents.messages import encode_event, encode_log, encode_substep
from cosim.log.contents.preamble import EVENT_TOPIC, LOG_TOPIC, STEP_TOPIC
from cosim.scenario.recorded_tables import Lateness
from cosim.scenario.running.real_time import BLOCK, RealTimePace, pace_of

_LONGEST_SLEEP: Final = 0.05  # s, until it is looked whether playback is to end


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
        If the speed is no number above 0, or a signal to publish is not in the log.
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
        factor = pace_of(speed, "speed")
        self._window_ns = max(1, round(BLOCK * factor * NANOSECONDS))
        self._publisher = Publisher(
            self._connection,
            log.channels,
            kinds=log.kinds,
            step_ns=log.step_ns,
            names=server.signals,
            source=str(log.path),
        )
        self._messages = _messages(log)
        for topic in dict.fromkeys([LOG_TOPIC, *(topic for topic, _, _ in self._messages)]):
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
        length_ns = self._log.end_ns - self._start_ns + self._log.step_ns
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
        first = 0  # of the messages
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
            while first < len(self._messages) and self._messages[first][1] <= end_ns:
                self._publisher.add_message(*self._messages[first])
                first += 1
            self._publisher.send()
            left = [cursor.next_ns for cursor in cursors]
            following = [instant for instant in left if instant is not None]
            following += [instant for _, instant, _ in self._messages[first : first + 1]]
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


def _messages(log: Log) -> list[tuple[str, int, bytes]]:
    """Return topic, time [ns] and data of all messages beside the rows, in the order of time."""
    messages: list[tuple[str, int, bytes]] = []
    for message in log.messages():
        data = encode_log(message.time_ns, message.level, message.source, message.text)
        messages.append((LOG_TOPIC, message.time_ns, data))
    for event in log.events():
        messages.append((EVENT_TOPIC, event.time_ns, encode_event(event)))
    for substep in log.substeps():
        messages.append((STEP_TOPIC, substep.begin_ns, encode_substep(substep)))
    return sorted(messages, key=lambda message: message[1])
