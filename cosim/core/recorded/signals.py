"""Recorded signals by name, in memory and from file alike."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Nanoseconds, Vector, as_columns
from cosim.core.port import Port
from cosim.core.recorded.partial import PartialRecord, partial_of
from cosim.core.recording import MessageLevel, SignalNames
from cosim.core.signals import Channel, Signal
from cosim.errors import GraphError, LogError, UnknownSignalError, nearest, quoted
from cosim.units import Unit

WARNINGS: Final = "warnings"  # among the results of a run
MOST_WARNINGS: Final = 1000  # that are kept of a run beside its messages
MOST_SHOWN: Final = 20  # of one component


class RecordedPort(NamedTuple):
    """A recorded signal, or elements of it.

    Parameters
    ----------
    channel : Channel
        Of its component.
    signal : Signal
    columns : slice
        Of the elements, in the rows of the component.
    """

    channel: Channel
    signal: Signal
    columns: slice

    @property
    def described(self) -> Signal:
        """The signal, with the role that it has for a reader."""
        return self.channel.described(self.signal.name)

    @property
    def size(self) -> int:
        """Number of elements."""
        return int(self.columns.stop - self.columns.start)

    @property
    def measures(self) -> tuple[Unit, ...]:
        """The units of the elements."""
        start = self.channel.start + self.columns.start
        first = start - self.channel.signal_columns[self.signal.name].start
        return self.signal.measures_of(slice(first, first + self.size))


class RunMessage(NamedTuple):
    """A message of a run, or of a component in it."""

    time_ns: int
    level: MessageLevel
    source: str  # "run", or the component's name
    text: str

    @property
    def is_warning(self) -> bool:
        """Whether it is a warning: of the run, or what a component warns of or calls an error."""
        if self.source == "run":  # whose error is how it ended
            return self.level == "warning"
        return self.level in ("warning", "error", "fatal")


class DistinctWarnings:
    """The first message of each text of a source that is a warning; ``MOST_WARNINGS`` of them."""

    def __init__(self, messages: Iterable[RunMessage] = ()) -> None:
        self._by_text: dict[tuple[str, str], RunMessage] = {}
        for message in messages:
            self.add(message)

    def __iter__(self) -> Iterator[RunMessage]:
        return iter(self._by_text.values())

    def add(self, message: RunMessage) -> None:
        """Keep a message, where it is a new warning."""
        if message.is_warning and len(self._by_text) < MOST_WARNINGS:
            self._by_text.setdefault((message.source, message.text), message)


def warning_texts(warnings: Iterable[RunMessage]) -> list[str]:
    """Return warnings as lines to be shown, ``source: text``; the first ones of each source."""
    of_source: dict[str, list[str]] = {}
    for warning in warnings:
        of_source.setdefault(warning.source, []).append(f"{warning.source}: {warning.text}")
    texts = []
    for source, own in of_source.items():
        texts += own[:MOST_SHOWN]
        if len(own) > MOST_SHOWN:
            texts.append(f"{source}: {len(own) - MOST_SHOWN} more warnings")
    return texts


def html_table(caption: str, header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table as notebooks show it; its texts are escaped."""
    from html import escape  # only notebooks need it

    lines = []
    for row in rows:
        cells = "".join(f"<td>{escape(cell)}</td>" for cell in row)
        lines.append(f"<tr>{cells}</tr>")
    names = "".join(f"<th>{escape(name)}</th>" for name in header)
    return (
        f"<table><caption>{escape(caption)}</caption><thead><tr>{names}</tr></thead>"
        f"<tbody>{''.join(lines)}</tbody></table>"
    )


def find_signal(
    channels: Mapping[str, Channel], signal: str | Port, *, source: str
) -> RecordedPort:
    """Return a recorded signal, or elements of it.

    Parameters
    ----------
    channels : mapping of component name to Channel
    signal : str or Port
        ``component.signal``, ``component.signal[1]`` or ``component.signal[0:2]``.
    source : str
        What was recorded to, for the message.

    Raises
    ------
    UnknownSignalError
        If there is no such component, signal or element; names the nearest.
    """
    try:
        port = signal if isinstance(signal, Port) else Port.parse(signal)
        channel = find_channel(channels, port.component, source=source)
        match = port.find(channel.by_name)
    except GraphError as error:
        raise UnknownSignalError(f"{source}: {error}") from error
    if match is None:
        partial = partial_of(channels)
        if partial is not None and port.find(partial.declared[port.component].by_name) is not None:
            raise UnknownSignalError(f"{source} has no '{port}': {partial.reason(channels)}")
        suggestion = nearest(port.signal, [known.name for known in channel.signals])
        raise UnknownSignalError(
            f"{source} has no '{port}': {port.component!r} has no signal {port.signal!r}; "
            f"{suggestion}"
        )
    meant, elements = match
    begin = channel.signal_columns[meant.name].start - channel.start
    columns = slice(begin + elements.start, begin + elements.stop)
    return RecordedPort(channel, meant, columns)


def _read_warning(time_ns: int, level: MessageLevel, source: str, text: str) -> RunMessage:
    """Return a warning as it was recorded; raise TypeError if it is none."""
    if not isinstance(time_ns, int) or not all(isinstance(t, str) for t in (level, source, text)):
        raise TypeError
    return RunMessage(time_ns, level, source, text)


def find_channel(channels: Mapping[str, Channel], component: str, *, source: str) -> Channel:
    """Return a recorded component.

    Raises
    ------
    UnknownSignalError
        If there is none of that name; names the nearest.
    """
    if not isinstance(component, str):
        raise UnknownSignalError(f"{source}: expected a component name, got {component!r}")
    if component not in channels:
        partial = partial_of(channels)
        if partial is not None and component in partial.declared:
            reason = partial.reason(channels)
            raise UnknownSignalError(f"{source} has no signal of {component!r}: {reason}")
        suggestion = nearest(component, channels)
        raise UnknownSignalError(f"{source} has no component {component!r}; {suggestion}")
    return channels[component]


def _component_of(signal: str | Port) -> str:
    port = signal if isinstance(signal, Port) else Port.parse(signal)
    return port.component


class RecordedSignals(Mapping[str, NDArray[np.float64]]):
    """The signals of a finished run by name, ``component.signal``; arrays are read-only.

    Iteration, length, ``keys``, ``values`` and ``items`` are of whole signals; elements of one, or
    several side by side, can be asked for too: ``run["plant.x_a[1]"]``, ``run[["u.y", "y.y"]]``.
    """

    @property
    @abstractmethod
    def label(self) -> str:
        """What was recorded to, for messages."""

    @property
    @abstractmethod
    def channels(self) -> Mapping[str, Channel]:
        """The recorded components by name, in the order of the row."""

    @property
    def partial(self) -> PartialRecord | None:
        """What was recorded of what the run computed; None: all signals at all of their steps.

        Rows of a span of time may be missing all the same: that says ``status``.
        """
        return partial_of(self.channels)

    @property
    @abstractmethod
    def status(self) -> str:
        """How the run ended."""

    @property
    @abstractmethod
    def reason(self) -> str:
        """The stop reason; empty where the run came to its end."""

    @property
    @abstractmethod
    def results(self) -> Mapping[str, Any]:
        """What was recorded of the end of the run."""

    @abstractmethod
    def messages(self) -> list[RunMessage]:
        """Return the messages of the run and its components, in the order of time."""

    @property
    def warnings(self) -> list[RunMessage]:
        """What the run warned of, in the order of time: each text of a component once.

        >>> import cosim
        >>> for warning in cosim.run("pair").warnings:
        ...     print(warning.time_ns, warning.source, warning.text)

        They are messages of level ``warning``, and of components also ``error``; at most 1000,
        :meth:`messages` has all of them.

        Raises
        ------
        LogError
            If they cannot be read.
        """
        entries = self.results.get(WARNINGS)
        if entries is None:  # the run has not come to its end, or an earlier version recorded it
            return list(DistinctWarnings(self.messages()))
        try:
            return [_read_warning(*entry) for entry in entries]
        except TypeError as error:
            raise LogError(
                f"{self.label}: {WARNINGS} of the results cannot be read: expected a list of "
                f"[time_ns, level, source, text], got {quoted(entries)}"
            ) from error

    @property
    @abstractmethod
    def steps(self) -> int:
        """Number of the last recorded communication step."""

    @property
    @abstractmethod
    def end_ns(self) -> int:
        """The last recorded instant [ns]."""

    @abstractmethod
    def rows(self, component: str) -> Matrix:
        """Return all rows of a component: applied inputs, then outputs; shape (N, width)."""

    def columns(self, component: str, columns: slice) -> Matrix:
        """Return some columns of :meth:`rows`."""
        return self.rows(component)[:, columns]

    @abstractmethod
    def time_ns(self, component: str) -> Nanoseconds:
        """Return the instants of a component's rows, shape (N,) [ns]."""

    def __getitem__(self, signal: SignalNames) -> NDArray[np.float64]:
        """Return a signal at every recorded row: shape (N,) for one element, else (N, size).

        Several signals of the same instants are stacked: shape (N, sum of their sizes).

        Raises
        ------
        UnknownSignalError
            If there is no such component, signal or element; names the nearest.
        """
        if not isinstance(signal, str | Port):
            return self._stacked(signal)
        port = find_signal(self.channels, signal, source=self.label)
        values = self.columns(port.channel.name, port.columns)
        return values[:, 0] if port.size == 1 else values

    def _stacked(self, signals: Sequence[str | Port]) -> Matrix:
        """Return several signals of the same instants side by side.

        Raises
        ------
        LogError
            If there is none, if one is unknown, or if they have different instants.
        """
        is_list = isinstance(signals, Sequence) and len(signals) > 0
        if not is_list or not all(isinstance(signal, str | Port) for signal in signals):
            raise LogError(
                f"{self.label}: expected a signal name, or a list of names, got {signals!r}"
            )
        columns = [as_columns(self[signal]) for signal in signals]
        first = signals[0]
        times = self.time_ns(_component_of(first))
        for signal in signals[1:]:
            other_times = self.time_ns(_component_of(signal))
            if not np.array_equal(times, other_times):
                raise LogError(
                    f"{self.label}: expected signals with the same instants, got '{first}' with "
                    f"{len(times)} rows and '{signal}' with {len(other_times)}; read each with "
                    "its own time()"
                )
        values = np.hstack(columns)
        values.flags.writeable = False
        return values

    def __iter__(self) -> Iterator[str]:
        return iter(self.signals)

    def __len__(self) -> int:
        return sum(len(channel.signals) for channel in self.channels.values())

    def __contains__(self, signal: object) -> bool:
        if not isinstance(signal, str | Port):
            return False
        try:
            find_signal(self.channels, signal, source=self.label)
        except UnknownSignalError:
            return False
        return True

    # as for arrays, equality of all values is asked for by name: cosim.diff
    __eq__ = object.__eq__
    __hash__ = object.__hash__

    @property
    def signals(self) -> Mapping[str, Signal]:
        """What is known of every signal, by its name ``component.signal``: size, unit, role, ..."""
        declared = {}
        for component, channel in self.channels.items():
            for signal in channel.signals:
                declared[f"{component}.{signal.name}"] = channel.described(signal.name)
        return MappingProxyType(declared)

    def time(self, name: str) -> Vector:
        """Return the instants of a signal's or component's rows, shape (N,) [s].

        Raises
        ------
        UnknownSignalError
            If there is no such component, signal or element; names the nearest.
        """
        if isinstance(name, str) and "." in name:
            port = find_signal(self.channels, name, source=self.label)
            return self.time_ns(port.channel.name) / 1e9
        return self.time_ns(name) / 1e9

    def __repr__(self) -> str:
        return f"<{self.label}: {self._overview()}>"

    def _repr_html_(self) -> str:
        """Return a table of the signals for notebooks."""
        names = ("signal", "size", "unit", "role", "variability", "description")
        rows = [
            (
                name,
                str(signal.size),
                signal.unit_text,
                signal.role,
                signal.variability,
                signal.description,
            )
            for name, signal in self.signals.items()
        ]
        return html_table(f"{self.label}: {self._overview()}", names, rows)

    def _overview(self) -> str:
        end = self.end_ns / 1e9
        overview = f"{self.status}, {self.steps} steps to {end:g} s"
        try:
            count = len(self.warnings)
            warned = f", {count} warning{'' if count == 1 else 's'}" if count else ""
        except LogError:  # a debugger shows the run all the same
            warned = ", warnings that cannot be read"
        partial = self.partial
        if partial is not None:
            return f"{overview}, partial: {partial.text(self.channels)}{warned}"
        return f"{overview}, {len(self)} signals of {len(self.channels)} components{warned}"
