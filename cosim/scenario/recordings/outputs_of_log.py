"""The outputs that a partial log has at each step: recorded themselves, or as inputs they drive."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Mask, Matrix, Nanoseconds, as_columns
from cosim.core.recorded.partial import PartialChannels, PartialRecord, reduced_interface
from cosim.core.recorded.run import blocks_within
from cosim.core.recorded.signals import find_channel, find_signal
from cosim.core.recording import Recording, SignalEvent, SignalNames, Substep
from cosim.core.signals import Channel
from cosim.errors import LogError, quoted
from cosim.instants import StepNs


@dataclass(frozen=True, slots=True)
class RecordedColumns:
    """Where a log has the values of a signal.

    Parameters
    ----------
    component, signal : str
        Itself, or an input that it drives as it is.
    stride : int
        Of its rows every so many are those of the signal.
    """

    component: str
    signal: str
    stride: int

    def values(self, run: Recording) -> Matrix:
        """Return the values, shape (N, size)."""
        return as_columns(run[f"{self.component}.{self.signal}"])[:: self.stride]

    def time_ns(self, run: Recording) -> Nanoseconds:
        """Return the instants, shape (N,) [ns]."""
        return run.time_ns(self.component)[:: self.stride]


@final
class OutputsOfLog:
    """A partial log as a replay takes components from it: with the signals that it has of them.

    Parameters
    ----------
    run : Recording
    partial : PartialRecord
        What it is a part of.
    columns : mapping of component name to mapping of signal to RecordedColumns
        Of the components that are taken from it; not every input needs to have some.
    inputs : mapping of component name to names of its inputs
    """

    def __init__(
        self,
        run: Recording,
        partial: PartialRecord,
        columns: Mapping[str, Mapping[str, RecordedColumns]],
        inputs: Mapping[str, frozenset[str]],
    ) -> None:
        self._run = run
        self._columns = columns
        self._whole: dict[str, tuple[Nanoseconds, Matrix]] = {}
        channels = {}
        for name, own in columns.items():
            declared = partial.declared[name]
            shown = reduced_interface(declared.interface, {*own, *inputs[name]})
            channels[name] = Channel(name, shown, 0, declared.period)
        self._channels = PartialChannels(channels, partial)

    @property
    def label(self) -> str:
        """That of the log."""
        return self._run.label

    @property
    def channels(self) -> Mapping[str, Channel]:
        """The components that are taken from the log."""
        return self._channels

    @property
    def status(self) -> str:
        """How the run ended."""
        return self._run.status

    @property
    def reason(self) -> str:
        """The stop reason."""
        return self._run.reason

    @property
    def results(self) -> Mapping[str, Any]:
        """What was recorded of the end of the run."""
        return self._run.results

    @property
    def metadata(self) -> Mapping[str, Any]:
        """What was recorded beside the signals."""
        return self._run.metadata

    @property
    def held(self) -> Mapping[str, Mask]:
        """Which input elements of every component had a zero-order hold."""
        return self._run.held

    @property
    def step_ns(self) -> StepNs:
        """Communication step [ns]."""
        return self._run.step_ns

    @property
    def steps(self) -> int:
        """Number of the last recorded communication step."""
        return self._run.steps

    @property
    def end_ns(self) -> int:
        """The last recorded instant [ns]."""
        return self._run.end_ns

    def events(self) -> list[SignalEvent]:
        """Return the jumps of signals that are here, in the order of time."""
        return [event for event in self._run.events() if self._has(event.signal)]

    def _has(self, signal: str) -> bool:
        name, _, rest = signal.partition(".")
        own = self._channels.get(name)
        return own is not None and rest.partition("[")[0] in own.by_name

    def substeps(self) -> list[Substep]:
        """Return the substeps of loops."""
        return self._run.substeps()

    def __getitem__(self, signal: SignalNames) -> NDArray[np.float64]:
        """Return a signal, or elements of it, shape (N, size).

        Raises
        ------
        UnknownSignalError
            If it is not here.
        """
        if not isinstance(signal, str):
            raise LogError(f"{self.label}: expected the name of a signal, got {quoted(signal)}")
        port = find_signal(self._channels, signal, source=self.label)
        return self._rows(port.channel)[:, port.columns]

    def time_ns(self, component: str) -> Nanoseconds:
        """Return the instants of a component's rows, shape (N,) [ns]."""
        find_channel(self._channels, component, source=self.label)
        first = next(iter(self._columns[component].values()))
        return first.time_ns(self._run)

    def blocks(
        self, component: str, *, first_ns: int | None = None, last_ns: int | None = None
    ) -> Iterator[tuple[Nanoseconds, Matrix]]:
        """Yield times and rows of a component, all at once; NaN where an input is not recorded."""
        channel = find_channel(self._channels, component, source=self.label)
        if component not in self._whole:
            self._whole[component] = self.time_ns(component), self._rows(channel)
        yield from blocks_within(iter([self._whole[component]]), first_ns, last_ns)

    def _rows(self, channel: Channel) -> Matrix:
        count = len(self.time_ns(channel.name))
        parts = [np.empty((count, 0))]
        for signal in channel.signals:
            own = self._columns[channel.name].get(signal.name)
            missing = np.full((count, signal.size), np.nan)
            parts.append(missing if own is None else own.values(self._run))
        return np.hstack(parts)
