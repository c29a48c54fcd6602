"""What is found of a run by name: signals and elements of them; its messages and warnings."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Final, NamedTuple

from cosim.core.port import Port
from cosim.core.recorded.partial import partial_of
from cosim.core.recording import MessageLevel
from cosim.core.signals import Channel, Signal
from cosim.errors import GraphError, UnknownSignalError, nearest
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
        first = self.columns.start - own_columns(self.channel, self.signal).start
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
    begin = own_columns(channel, meant).start
    return RecordedPort(channel, meant, slice(begin + elements.start, begin + elements.stop))


def own_columns(channel: Channel, signal: Signal) -> slice:
    """Return the columns of a signal in the rows of its component."""
    columns = channel.signal_columns[signal.name]
    return slice(columns.start - channel.start, columns.stop - channel.start)


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
