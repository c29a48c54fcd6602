"""Runs at the pace of the wall clock: block by block, each passed on when its time has come.

A run that is faster waits after every block; one that is slower is late, which is measured. Only
the wall time changes: the rows have the same bits.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Final, final

from cosim.core.clock import Clock
from cosim.core.contracts import Block
from cosim.core.recorders import Watched, close
from cosim.core.recording import Recorder
from cosim.documents import plain
from cosim.scenario.building.experiment import Experiment
from cosim.scenario.record import REAL_TIME, Lateness
from cosim.scenario.recordings.recording import Beside

BLOCK: Final = 0.01  # s of wall time between two waits, about


@final
class RealTimePace:
    """Waits after blocks until their time has come.

    Parameters
    ----------
    factor : float
        Simulated time by wall time.
    start_time : float
        Of the run [s].
    now : callable, optional
        Returns the wall time [s].
    sleep : callable, optional
        Waits for some seconds.

    Attributes
    ----------
    lateness : Lateness
        How late it was so far.
    """

    def __init__(
        self,
        factor: float,
        start_time: float,
        *,
        now: Callable[[], float] = time.perf_counter,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._factor = factor
        self._start_time = start_time
        self._now = now
        self._sleep = sleep
        self._began = 0.0
        self.lateness = Lateness(factor, 0, 0, 0.0, start_time)

    def begin(self) -> None:
        """Take the wall time of now as that of the start."""
        self._began = self._now()

    def wait(self, block: Block) -> None:
        """Wait until the time of the end of a block has come; or note that it has passed."""
        # the first row is there at the start
        self.reach(float(block.time[-1]), counts=bool(block.steps))

    def reach(self, reached: float, *, later: float = 0.0, counts: bool = True) -> None:
        """Wait until a time has come; or note that it has passed.

        Parameters
        ----------
        reached : float
            [s].
        later : float
            How much simulated time has been passed through before the start [s].
        counts : bool
            Whether one can be late.
        """
        due = self._began + (reached + later - self._start_time) / self._factor
        early = due - self._now()
        if early > 0.0:
            self._sleep(early)
        before = self.lateness
        late = max(0.0, -early) if counts else 0.0
        is_latest = late > before.largest
        self.lateness = Lateness(
            before.factor,
            before.blocks + counts,
            before.late + (late > 0.0),
            late if is_latest else before.largest,
            reached if is_latest else before.time,
        )

    def end(self, recorder: Recorder, error: BaseException | None) -> None:
        """Record how late the run was, and close the recorder."""
        values = plain(self.lateness)
        try:
            recorder.result({REAL_TIME: values})
        finally:
            close(recorder, error)


def block_steps(clock: Clock, factor: float) -> int:
    """Return the communication steps of a block, as many as last about ``BLOCK``."""
    return max(1, round(BLOCK * factor / clock.h))


def paced(experiment: Experiment, factor: float, beside: Beside | None) -> Beside:
    """Have an experiment run in short blocks; return what keeps their pace before a recorder.

    Parameters
    ----------
    experiment : Experiment
    factor : float
        Simulated time by wall time.
    beside : callable or None
        What else is before the recorder.
    """
    clock = experiment.clock
    if clock.block is None:
        experiment.clock = replace(clock, block=block_steps(clock, factor))
    pace = RealTimePace(factor, clock.start_time)

    def before(recorder: Recorder) -> Recorder:
        return Watched(
            recorder if beside is None else beside(recorder),
            lambda block, _: pace.wait(block),
            began=pace.begin,
            ended=pace.end,
        )

    return before
