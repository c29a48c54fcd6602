"""Recorders: one that keeps everything in memory and is the recording afterwards, one that keeps nothing, one that watches.

And what a recorder learns of the end of a run.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from types import TracebackType
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Nanoseconds
from cosim.core.contracts import Block, Plan, Recorder, Stopped
from cosim.core.signals import Channel
from cosim.errors import Interrupted, LogError, nearest


def find_signal(
    channels: Mapping[str, Channel], signal: str, *, source: str
) -> tuple[Channel, slice]:
    """Find a recorded ``component.signal``: its channel and its columns in the row.

    Parameters
    ----------
    channels : mapping of component name to Channel
    signal : str
        The first dot ends the component's name; the signal's own may have more.
    source : str
        What was recorded to, for the message.

    Raises
    ------
    LogError
        If there is no such component or signal; names the nearest.
    """
    name, _, wanted = signal.partition(".")
    channel = find_channel(channels, name, source=source)
    for found, columns in channel.signal_columns():
        if found.name == wanted:
            return channel, columns
    known = nearest(wanted, [found.name for found in channel.signals])
    raise LogError(f"{source} has no {signal!r}: {name!r} has no signal {wanted!r}; {known}")


def find_channel(channels: Mapping[str, Channel], component: str, *, source: str) -> Channel:
    """Find a recorded component.

    Raises
    ------
    LogError
        If there is none of that name; names the nearest.
    """
    if component not in channels:
        raise LogError(f"{source} has no component {component!r}; {nearest(component, channels)}")
    return channels[component]


@dataclass(frozen=True, slots=True)
class EndOfRun:
    """How a run ended, and why; a reason without an error is that of a component that asked for the end."""

    status: Literal["complete", "failed", "interrupted"] = "complete"
    reason: str = ""


def end_of_run(error: BaseException | None) -> EndOfRun:
    """Name how a run ended by what it ended with."""
    match error:
        case None:
            return EndOfRun()
        case Stopped(failed=False):
            return EndOfRun("complete", str(error))
        case KeyboardInterrupt() | Interrupted():
            return EndOfRun("interrupted", str(error) or "interrupted by the user")
        case _:
            return EndOfRun("failed", str(error) or type(error).__name__)


class Memory:
    """Keeps every row of a run in memory; implements Recorder and Recording."""

    def __init__(self, metadata: Mapping[str, Any] | None = None) -> None:
        self.metadata: Mapping[str, Any] = metadata or {}
        self._rows: list[Matrix] = []
        self._times: list[Nanoseconds] = []
        self._steps: list[NDArray[np.int64]] = []
        self._outcome = EndOfRun()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._outcome = end_of_run(error)

    def begin(self, plan: Plan) -> None:
        """Learn the layout."""
        self.plan = plan

    def write(self, block: Block, signals: Matrix) -> None:
        """Copy the new rows."""
        first = 0 if block.index == 0 and not self._rows else 1
        if first > block.steps:
            return
        self.__dict__.pop("_table", None)  # what was read while the run went on
        self._rows.append(signals[first:].copy())
        self._times.append(block.time_ns[first:].copy())
        self._steps.append(np.arange(block.index + first, block.index + block.steps + 1))

    @property
    def status(self) -> str:
        """How the run ended: ``complete``, ``failed`` or ``interrupted``."""
        return self._outcome.status

    @property
    def reason(self) -> str:
        """Why it ended so; empty where it came to its end."""
        return self._outcome.reason

    @property
    def channels(self) -> Mapping[str, Channel]:
        """The recorded components by name."""
        return {channel.name: channel for channel in self.plan.layout.channels}

    @cached_property
    def _table(self) -> tuple[Matrix, Nanoseconds, NDArray[np.int64]]:
        none = np.empty(0, np.int64)
        rows = np.concatenate([np.empty((0, self.plan.layout.width)), *self._rows])
        return rows, np.concatenate([none, *self._times]), np.concatenate([none, *self._steps])

    def _kept(self, channel: Channel) -> NDArray[np.bool_]:
        kept: NDArray[np.bool_] = self._table[2] % channel.period == 0
        return kept

    def __getitem__(self, signal: str) -> NDArray[np.float64]:
        """Give ``component.signal`` at every recorded row: shape (N,) for size 1, else (N, size)."""
        channel, columns = find_signal(self.channels, signal, source="the run")
        values = self._table[0][self._kept(channel), columns]
        return values[:, 0] if values.shape[1] == 1 else values

    def time_ns(self, component: str) -> Nanoseconds:
        """Give the instants of a component's rows, shape (N,) [ns]."""
        return self._table[1][self._kept(find_channel(self.channels, component, source="the run"))]

    def time(self, name: str) -> NDArray[np.float64]:
        """Give the instants of a signal's or component's rows, shape (N,) [s]."""
        channel = find_signal(self.channels, name, source="the run")[0] if "." in name else None
        return self.time_ns(channel.name if channel else name) / 1e9

    @property
    def end_ns(self) -> int:
        """The last recorded instant [ns]; 0 if there is none."""
        return int(self._times[-1][-1]) if self._times else 0

    @property
    def steps(self) -> int:
        """Number of the last recorded communication step."""
        return int(self._steps[-1][-1]) if self._steps else 0


class Nothing:
    """Keeps nothing."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None: ...

    def begin(self, plan: Plan) -> None:
        """Do nothing."""

    def write(self, block: Block, signals: Matrix) -> None:
        """Do nothing."""


class Watched:
    """Hands everything on to another recorder, then says how far the run is.

    Parameters
    ----------
    recorder : Recorder
    reached : callable
        Called with every block after it has been recorded; what it raises ends the run, cleanly.
    """

    def __init__(self, recorder: Recorder, reached: Callable[[Block], None]) -> None:
        self._recorder, self._reached = recorder, reached

    def __enter__(self) -> Self:
        self._recorder.__enter__()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._recorder.__exit__(kind, error, trace)

    def begin(self, plan: Plan) -> None:
        """Hand on."""
        self._recorder.begin(plan)

    def write(self, block: Block, signals: Matrix) -> None:
        """Hand on, then tell."""
        self._recorder.write(block, signals)
        self._reached(block)
