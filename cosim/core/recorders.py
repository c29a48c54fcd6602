"""Recorders: one that keeps everything in memory and is the recording afterwards, one that keeps nothing, one that watches."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Nanoseconds
from cosim.core.contracts import Block, Plan, Recorder
from cosim.core.signals import Channel
from cosim.errors import LogError, nearest


class Memory:
    """Keeps every row of a run in memory; implements Recorder and Recording."""

    def __init__(self, metadata: Mapping[str, Any] | None = None) -> None:
        self.metadata: Mapping[str, Any] = metadata or {}
        self._rows: list[Matrix] = []
        self._times: list[Nanoseconds] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None: ...

    def begin(self, plan: Plan) -> None:
        """Learn the layout."""
        self.plan = plan

    def write(self, block: Block, signals: Matrix) -> None:
        """Copy the new rows."""
        first = 0 if block.index == 0 else 1
        self._rows.append(signals[first:].copy())
        self._times.append(block.time_ns[first:])

    @property
    def channels(self) -> Mapping[str, Channel]:
        """The recorded components by name."""
        return {channel.name: channel for channel in self.plan.layout.channels}

    @cached_property
    def _table(self) -> tuple[Matrix, Nanoseconds]:
        rows, times = [np.empty((0, self.plan.layout.width)), *self._rows], [np.empty(0, np.int64), *self._times]
        return np.concatenate(rows), np.concatenate(times)

    def _kept(self, channel: Channel) -> NDArray[np.bool_]:
        kept: NDArray[np.bool_] = self._table[1] % (channel.period * self.plan.step_ns) == 0
        return kept

    def __getitem__(self, signal: str) -> NDArray[np.float64]:
        """Give ``component.signal`` at every recorded row: shape (N,) for size 1, else (N, size)."""
        name, _, wanted = signal.partition(".")
        channel = self._channel(name)
        for found, columns in channel.signal_columns():
            if found.name == wanted:
                values = self._table[0][self._kept(channel), columns]
                return values[:, 0] if found.size == 1 else values
        raise LogError(f"{signal!r}: {name!r} has no signal {wanted!r}; {nearest(wanted, [s.name for s in channel.signals])}")

    def time_ns(self, component: str) -> Nanoseconds:
        """Give the instants of a component's rows, shape (N,) [ns]."""
        return self._table[1][self._kept(self._channel(component))]

    def time(self, signal: str) -> NDArray[np.float64]:
        """Give the instants of a component's, or of a signal's, rows, shape (N,) [s]."""
        return self.time_ns(signal if signal in self.channels else signal.partition(".")[0]) / 1e9

    def _channel(self, name: str) -> Channel:
        if name not in self.channels:
            raise LogError(f"the run has no component {name!r}; {nearest(name, self.channels)}")
        return self.channels[name]


class Nothing:
    """Keeps nothing."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None: ...

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

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._recorder.__exit__(kind, error, trace)

    def begin(self, plan: Plan) -> None:
        """Hand on."""
        self._recorder.begin(plan)

    def write(self, block: Block, signals: Matrix) -> None:
        """Hand on, then tell."""
        self._recorder.write(block, signals)
        self._reached(block)
