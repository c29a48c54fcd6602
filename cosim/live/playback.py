"""A log played to viewers at the pace of the wall clock.

The log is read in windows of about 10 ms of wall time. The rows and messages of a window are sent
when its end is due. Ends are counted from the start in whole nanoseconds, so that errors do not add
up; if sending takes too long, the next windows are sent at once.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from math import ceil
from typing import Final, Generic, TypeAlias, TypeVar, final

import numpy as np

from cosim.arguments import positive_argument
from cosim.arrays import Matrix, Nanoseconds
from cosim.errors import LogError
from cosim.instants import NANOSECONDS
from cosim.live.server import LiveServer
from cosim.log import Log
from cosim.log.preamble import LOG_TOPIC
from cosim.scenario.record import Lateness
from cosim.scenario.running.real_time import BLOCK, RealTimePace

_LONGEST_SLEEP: Final = 0.05  # s, until it is looked whether playback is to end
_TOGETHER: Final = 10_000  # messages that are read at once

SentMessage: TypeAlias = tuple[str, int, bytes]  # topic, time [ns], data
_Piece = TypeVar("_Piece", Matrix, list[SentMessage])


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
        self._check = check
        self._now = now
        self._sleep = sleep
        factor = positive_argument("speed", speed)
        self._window_ns = max(1, round(BLOCK * factor * NANOSECONDS))
        counts = log.message_counts()
        self._messages = sum(counts.values())
        self._server = server
        server.advertise(
            log.channels,
            kinds=log.kinds,
            step_ns=log.step_ns,
            topics=dict.fromkeys([LOG_TOPIC, *counts]),
            source=str(log.path),
        )
        starts = [cursor.next_ns for cursor in self._rows().values()]
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
            self._server.turn_back()

    def _play_once(self, shift_ns: int) -> None:
        """Play all windows, ``shift_ns`` later than when the first round began."""
        cursors = self._rows()
        messages = _Cursor(_messages(self._log, self._messages, self._start_ns))
        end_ns = self._start_ns
        while True:
            self._check()
            # The first row is there at the start.
            counts = shift_ns > 0 or end_ns > self._start_ns
            later = shift_ns / NANOSECONDS
            self._pace.reach(end_ns / NANOSECONDS, later=later, counts=counts)
            for component, cursor in cursors.items():
                for time_ns, rows in cursor.take(end_ns):
                    self._server.add_rows(component, time_ns, rows)
            for _, found in messages.take(end_ns):
                for message in found:
                    self._server.add_message(*message)
            self._server.send()
            left = [messages.next_ns, *(cursor.next_ns for cursor in cursors.values())]
            following = [instant for instant in left if instant is not None]
            if not following:
                return
            windows = -((self._start_ns - min(following)) // self._window_ns)
            end_ns = self._start_ns + windows * self._window_ns

    def _rows(self) -> dict[str, _Cursor[Matrix]]:
        return {name: _Cursor(self._log.blocks(name)) for name in self._server.components}

    def _sleep_watched(self, seconds: float) -> None:
        """Wait, but end at once where playback is to end."""
        until = self._now() + seconds
        while (left := until - self._now()) > 0.0:
            self._sleep(min(left, _LONGEST_SLEEP))
            self._check()


@final
class _Cursor(Generic[_Piece]):
    """Rows or messages, taken up to one instant after the other.

    Parameters
    ----------
    pieces : iterator of (Nanoseconds, sequence)
        In order of time: instants, and what belongs to them.
    """

    def __init__(self, pieces: Iterator[tuple[Nanoseconds, _Piece]]) -> None:
        self._pieces: Iterator[tuple[Nanoseconds, _Piece]] = pieces
        self._piece: tuple[Nanoseconds, _Piece] | None = next(pieces, None)
        self._first = 0
        self._skip_empty()

    @property
    def next_ns(self) -> int | None:
        """The next instant [ns]; None: there is none."""
        return None if self._piece is None else int(self._piece[0][self._first])

    def take(self, until_ns: int) -> list[tuple[Nanoseconds, _Piece]]:
        """Return what was not taken yet up to an instant, in pieces."""
        taken = []
        while self._piece is not None and self._piece[0][self._first] <= until_ns:
            time_ns, content = self._piece
            stop = int(np.searchsorted(time_ns, until_ns, side="right"))
            taken.append((time_ns[self._first : stop], content[self._first : stop]))
            self._first = stop
            self._skip_empty()
        return taken

    def _skip_empty(self) -> None:
        """Go on to the next piece that has something, where this one has no more."""
        while self._piece is not None and self._first >= len(self._piece[0]):
            self._piece = next(self._pieces, None)
            self._first = 0


def _messages(
    log: Log, count: int, start_ns: int
) -> Iterator[tuple[Nanoseconds, list[SentMessage]]]:
    """Yield the messages of a log beside its rows, read for some time at once.

    Parameters
    ----------
    log : Log
    count : int
        How many there are: as if evenly spread.
    start_ns : int
        When the rows begin [ns].
    """
    span_ns = max(1, (log.end_ns - start_ns) // max(1, count // _TOGETHER))
    first_ns: int | None = None
    last_ns: int | None = start_ns
    while count and last_ns is not None:
        last_ns += span_ns
        if last_ns >= log.end_ns:
            last_ns = None  # all that are left
        found = log.messages_between(first_ns, last_ns)
        yield np.array([time_ns for _, time_ns, _ in found], np.int64), found
        first_ns = None if last_ns is None else last_ns + 1
