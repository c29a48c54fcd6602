"""A log file as arrays.

A component's rows are read when first asked for, chunk by chunk, with every CRC checked.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from operator import attrgetter, itemgetter
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar, final

import numpy as np
from mcap.opcode import Opcode

from cosim.arguments import log_argument
from cosim.arrays import Mask, Matrix, Nanoseconds
from cosim.core.contracts import Design
from cosim.core.recorded.partial import PartialChannels, declared_channels
from cosim.core.recorded.run import RecordedRun
from cosim.core.recorded.selection import select_signals
from cosim.core.recorded.signals import RunMessage, find_channel
from cosim.core.recorders import Memory
from cosim.core.recording import SignalEvent, Substep, TimedRows
from cosim.core.signals import Channel
from cosim.errors import GraphError, LogError, UsageError, nearest, quoted
from cosim.instants import Grid, StepNs
from cosim.log.container import Container
from cosim.log.files import OwnFile, log_path
from cosim.log.layout import read_channels, read_number, read_partial, read_parts
from cosim.log.messages import decode_event, decode_log, decode_substep
from cosim.log.metadata import (
    combine_hashes,
    decode_design,
    hash_input,
    hash_signals,
    json_table,
    json_texts,
    read_json,
    recorded_start_ns,
    verify_checksum,
)
from cosim.log.places import MALFORMED
from cosim.log.preamble import (
    EVENT_TOPIC,
    FORMAT,
    LOG_TOPIC,
    PARTIAL_STATUS,
    RESULT,
    RESULT_FILE,
    STEP_TOPIC,
)
from cosim.log.rows import LogRows

_LOG_TIME = slice(6, 14)  # of a message record's content
_DATA = slice(22, None)
_TOPICS = (LOG_TOPIC, EVENT_TOPIC, STEP_TOPIC)  # of messages beside the rows
_Parsed = TypeVar("_Parsed")
_Text = TypeVar("_Text")


def open_log(path: Path | str) -> Log:
    """Open a log file.

    Raises
    ------
    UsageError
        If it is a run in memory instead of a path, or the path of a scenario or an FMU.
    LogError
        If the file is not MCAP, truncated or damaged, or was not written by cosim.
    """
    if isinstance(path, Memory):
        raise UsageError(
            f"log: expected the path of a log, got {path!r}, which was kept in memory; a run "
            "writes a log with out='x.mcap'"
        )
    return Log(log_argument(log_path(path)))


@final
class Log(RecordedRun):
    """A recorded run in an MCAP file.

    Parameters
    ----------
    path : Path or str
    own : OwnFile, optional
        The file itself, held open by the run that wrote it.

    Raises
    ------
    LogError
        From every method: if the file is damaged, has changed, or lacks what is asked for.
    """

    def __init__(self, path: Path | str, own: OwnFile | None = None) -> None:
        self._file = Container(log_path(path), own)
        self.path = self._file.path
        self._declared = self._file.channels()
        self._metadata = self._read_metadata()
        self._check_format()
        self._parts = read_parts(self.path, self._declared)
        channels = read_channels(self.path, self._parts.values())
        self._channels: Mapping[str, Channel] = MappingProxyType(channels)
        self._kinds = {part.channel.name: part.kind for part in self._parts.values()}
        self._recognize_partial()
        self._attachments = self._file.attachments()
        self._rows = LogRows(self._file, self._declared, self._parts, self._channels)
        self._check_rows_of_run()

    @property
    def label(self) -> str:
        """The path."""
        return str(self.path)

    @property
    def is_at_its_path(self) -> bool:
        """Whether the path leads to this log; not where a run's own was replaced or removed."""
        own = self._file.own
        return self.path.exists() if own is None else own.is_at_its_path

    @property
    def channels(self) -> Mapping[str, Channel]:
        """The recorded components by name, in the order of the row."""
        return self._channels

    @property
    def kinds(self) -> Mapping[str, str]:
        """The kinds of the components, as the scenario calls them."""
        return MappingProxyType(self._kinds)

    @property
    def metadata(self) -> Mapping[str, Mapping[str, str]]:
        """The metadata records by name."""
        return MappingProxyType(self._metadata)

    @property
    def attachments(self) -> tuple[str, ...]:
        """Names of the attachments."""
        return tuple(self._attachments)

    @property
    def step_ns(self) -> StepNs:
        """Communication step [ns]."""
        return next(part.step_ns for part in self._parts.values())

    @property
    def status(self) -> str:
        """How the run ended: ``complete``, ``failed`` or ``interrupted``.

        ``unfinished`` if the run still goes on, or its process was killed; ``partial`` if this is
        a part of its log, see :mod:`cosim.log.spans`; ``unknown`` if another tool left that out.
        """
        otherwise = "unfinished" if self._is_unfinished else "unknown"
        return self._metadata.get(RESULT, {}).get("status", otherwise)

    @property
    def _is_unfinished(self) -> bool:
        """Whether the run has recorded no end; on a full disk only the file may have none."""
        return self._file.places.is_unfinished and RESULT not in self._metadata

    @property
    def reason(self) -> str:
        """Stop reason; empty where the run came to its end."""
        return self._metadata.get(RESULT, {}).get("reason", "")

    @property
    def end_ns(self) -> int:
        """The last recorded instant [ns]; 0 if there are no rows.

        From the result, or, of an unfinished log, from the numbers of its rows.
        """
        if self._is_unfinished:
            return self._grid.stamp(self.steps) if self.steps else 0
        return self._result_number("end_ns")

    @property
    def steps(self) -> int:
        """Number of the last recorded communication step.

        From the result, or, of an unfinished log, from the numbers of its rows.
        """
        if self._is_unfinished:
            return self._last_step(self._first_steps)
        return self._result_number("steps")

    def _last_step(self, first_steps: Mapping[str, int]) -> int:
        """Return the last step that a component has a row of, by the steps of first rows."""
        last = 0
        for number, part in self._parts.items():
            count = self._file.expected_messages(number, 1)
            first = first_steps.get(part.channel.name)
            if count and first is not None:
                last = max(last, first + (count - 1) * part.channel.period)
        return last

    @cached_property
    def _first_steps(self) -> dict[str, int]:
        """The steps of the first rows, of the components that show which one is the last of all.

        Where the last instant of the file is that of the last row of a file that begins with its
        run, it does. Else there are messages behind that row, or the rows begin later: they are
        read.
        """
        at_start = dict.fromkeys(self._channels, 0)
        end_ns = self._grid.stamp(self._last_step(at_start))
        statistics = self._file.summary.statistics
        if statistics is None or end_ns == int(statistics.message_end_time):
            return at_start
        try:
            return self._read_first_steps()
        except LogError:
            # The run may write these rows anew just now. A message from the start of the run hardly
            # ever stands in a later file.
            if self._message_start_ns > self._run_start_ns:
                raise
            return at_start

    def _read_first_steps(self) -> dict[str, int]:
        """Read the steps of the first rows, of one component that has a row at every step or all.

        Raises
        ------
        LogError
            If the file is damaged, or the run has written to it.
        """
        steps = {}
        every_step = [name for name, own in self._channels.items() if own.period == 1]
        for name in every_step[:1] or self._channels:
            blocks = (time_ns for time_ns, _ in self.blocks(name, first_ns=0) if len(time_ns))
            first = next(blocks, None)
            if first is not None:
                steps[name] = self._grid.number(int(first[0]))
        return steps

    @property
    def _message_start_ns(self) -> int:
        statistics = self._file.summary.statistics
        return 0 if statistics is None else int(statistics.message_start_time)

    @property
    def _run_start_ns(self) -> int:
        """When the run began [ns]; where that is not recorded, the first instant of the file."""
        start_ns = recorded_start_ns(self._metadata)
        return self._message_start_ns if start_ns is None else start_ns

    @property
    def _grid(self) -> Grid:
        return Grid(self._run_start_ns, self.step_ns)

    @property
    def begins_late(self) -> bool:
        """Whether the file begins later than its run: others have the rows before."""
        return any(self._first_steps.values())

    @property
    def recorded_hash(self) -> str | None:
        """The content hash that the run recorded; :meth:`content_hash` computes that of the rows.

        None: the log is unfinished, and had not come to its result.

        Raises
        ------
        LogError
            If there is none.
        """
        if self._is_unfinished:
            return None
        if "content_hash" not in self._metadata.get(RESULT, {}):
            raise self._missing("content_hash")
        return self._metadata[RESULT]["content_hash"]

    @property
    def schedule(self) -> list[str]:
        """The stages of the run in their order; empty if another tool left them out.

        Raises
        ------
        LogError
            If they are not a list of strings.
        """
        text = self._metadata.get("cosim.schedule", {}).get("stages", "[]")
        return self._parsed("stages", json_texts, text)

    @property
    def results(self) -> Mapping[str, Any]:
        """What was recorded of the end of the run, with how it ended and the content hash.

        It is the content of ``result.json``; empty if there is none.

        Raises
        ------
        LogError
            If it is not a JSON object, or damaged.
        """
        if RESULT_FILE not in self._attachments:
            return {}
        return self._parsed(RESULT_FILE, json_table, self.attachment(RESULT_FILE))

    @cached_property
    def designs(self) -> Mapping[str, Design]:
        """The design-time arrays of every component, bit for bit."""
        designs: dict[str, Design] = {}
        for name in declared_channels(self._channels):
            designs[name] = self._component_metadata(name, "cosim.design", decode_design, {})
        return MappingProxyType(designs)

    @cached_property
    def held(self) -> Mapping[str, Mask]:
        """Which input elements of every component had a zero-order hold."""
        held: dict[str, Mask] = {}
        for name, channel in declared_channels(self._channels).items():
            none_held = np.zeros(channel.interface.n_u, dtype=np.bool_)
            mask = self._component_metadata(name, "cosim.held", _read_mask, none_held)
            if len(mask) != len(none_held):
                raise LogError(
                    f"{self.path}: cosim.held of {name!r}: expected {len(none_held)} elements, got "
                    f"{len(mask)}"
                )
            held[name] = mask
        return MappingProxyType(held)

    def _timed_rows(self, channel: Channel) -> TimedRows:
        return self._rows.of(channel.name)

    def _instants(self, channel: Channel) -> Nanoseconds:
        return self._rows.of(channel.name, slice(0, 0))[0]

    def columns(self, component: str, columns: slice) -> Matrix:
        """Return some columns of a component's rows, shape (N, columns); read-only."""
        return self._rows.of(component, columns)[1]

    def blocks_of(
        self,
        components: Sequence[str],
        *,
        first_ns: int | None = None,
        last_ns: int | None = None,
    ) -> Iterator[tuple[str, Nanoseconds, Matrix]]:
        """Yield names, times and rows of components as they come, each in order of time.

        It takes one pass over their chunks, and of a long log keeps nothing.

        Raises
        ------
        UnknownSignalError
            If there is no such component; names the nearest.
        LogError
            If the file is damaged.
        """
        self._check_known(*components)
        yield from self._rows.blocks(components, first_ns, last_ns)

    def _check_known(self, *components: str) -> None:
        for name in components:
            find_channel(self._channels, name, source=str(self.path))

    @property
    def row_bytes(self) -> int:
        """The memory that the rows of all components take, as doubles [bytes]."""
        return self._rows.row_bytes

    def shares_chunks(self, component: str) -> bool:
        """Return whether rows of other components are in most of the chunks of a component.

        Raises
        ------
        UnknownSignalError
            If there is no such component; names the nearest.
        """
        self._check_known(component)
        return self._rows.shares_chunks(component)

    def load(self, *components: str) -> None:
        """Read several components in one pass over the file; none named: all.

        Raises
        ------
        UnknownSignalError
            If there is no such component; names the nearest.
        LogError
            If the file is damaged.
        """
        self._check_known(*components)
        self._rows.load(components)

    def attachment(self, name: str) -> bytes:
        """Return the content of an attachment.

        Raises
        ------
        LogError
            If there is none of that name, or it is damaged.
        """
        if not isinstance(name, str) or name not in self._attachments:
            nearest_names = nearest(str(name), self._attachments)
            raise LogError(f"{self.path} has no attachment {name!r}; {nearest_names}")
        return bytes(self._file.attachment(self._attachments[name]).data)

    def messages(self) -> list[RunMessage]:
        """Return the messages of the run and its components, in the order of time."""
        return sorted(self.each_message(), key=lambda message: message.time_ns)

    def each_message(self) -> Iterator[RunMessage]:
        """Yield the messages in the order of the file."""
        return self._messages_of(
            LOG_TOPIC, lambda time_ns, data: RunMessage(time_ns, *decode_log(data))
        )

    def events(self) -> list[SignalEvent]:
        """Return the jumps of signals, in the order of time."""
        events = self._messages_of(EVENT_TOPIC, decode_event)
        return sorted(events, key=lambda event: event.time_ns)

    def substeps(self) -> list[Substep]:
        """Return the substeps of loops, in the order of where they begin."""
        substeps = self._messages_of(STEP_TOPIC, lambda _, data: decode_substep(data))
        return sorted(substeps, key=attrgetter("begin"))

    def message_counts(self) -> dict[str, int]:
        """Return how many messages there are beside the rows, by topic, where there are any."""
        counts = {}
        statistics = self._file.summary.statistics
        for topic in _TOPICS:
            if statistics is None:
                count = sum(1 for _ in self._messages_of(topic, lambda *_: None))
            else:
                numbers = statistics.channel_message_counts
                count = sum(numbers.get(number, 0) for number in self._channels_of(topic))
            if count:
                counts[topic] = count
        return counts

    def messages_between(
        self, first_ns: int | None, last_ns: int | None
    ) -> list[tuple[str, int, bytes]]:
        """Return topic, time [ns] and content of messages beside the rows, in the order of time.

        Parameters
        ----------
        first_ns, last_ns : int or None
            Those in ``first_ns <= time <= last_ns`` [ns]; None: without that bound.
        """
        messages = []
        for topic in _TOPICS:
            own = self._messages_of(topic, lambda *message: message, first_ns, last_ns)
            messages += [(topic, *message) for message in own]
        return sorted(messages, key=itemgetter(1))

    def _channels_of(self, topic: str) -> set[int]:
        return {number for number, channel in self._declared.items() if channel.topic == topic}

    def _messages_of(
        self,
        topic: str,
        decode: Callable[[int, bytes], _Parsed],
        first_ns: int | None = None,
        last_ns: int | None = None,
    ) -> Iterator[_Parsed]:
        """Yield the messages of a topic, decoded with their times, in the order of the file.

        Only those in ``first_ns <= time <= last_ns``; other chunks are not read.
        """
        channel_ids = self._channels_of(topic)
        if not channel_ids:
            return
        try:
            for record in self._rows.other_records(channel_ids, first_ns, last_ns):
                if record.opcode == Opcode.MESSAGE and record.channel_id in channel_ids:
                    time_ns = int.from_bytes(record.content[_LOG_TIME], "little")
                    is_late = first_ns is None or time_ns >= first_ns
                    if is_late and (last_ns is None or time_ns <= last_ns):
                        yield decode(time_ns, record.content[_DATA])
        except MALFORMED as error:
            raise LogError(f"{self.path} is damaged: {error}") from error

    def content_hash(self) -> str:
        """Compute the hash of every bit of every signal from the rows, in one pass over the file.

        Rows that are not in order of time, as another tool may write them, are sorted in memory.

        Raises
        ------
        LogError
            If the file is damaged, or has too many rows to be sorted.
        """
        digests = {name: hashlib.sha256() for name in self._channels}
        for name, time_ns, rows in self._rows.blocks(list(digests), None, None):
            digests[name].update(hash_input(time_ns, rows))
        components = []
        for number, part in self._parts.items():
            if part.columns.start == 0:
                # as it was recorded: written anew, it would have what a later version adds to it
                signals = self._declared[number].metadata["cosim.signals"]
                name = part.channel.name
                components.append((name, signals, digests[name].hexdigest()))
        return combine_hashes(components)

    def signal_hashes(self, signals: Iterable[str] | str | None = None) -> dict[str, str]:
        """Compute a hash of the times and bits of each signal, in one pass over each component.

        Signals that have the same bits at the same times have the same hash, in one log or in two.

        Parameters
        ----------
        signals : iterable of str, or str, optional
            Names and patterns, such as ``plant.*``; None: all.

        Raises
        ------
        UnknownSignalError
            If one of them chooses nothing; names the nearest.
        LogError
            If the file is damaged.
        """
        return hash_signals(self, select_signals(self._channels, signals, source=self.label))

    def _check_rows_of_run(self) -> None:
        """Check that the summary counts the rows of as many steps as the run has recorded.

        Raises
        ------
        LogError
            If rows of a component are missing, or there are too many.
        """
        statistics = self._file.summary.statistics
        text = self._metadata.get(RESULT, {}).get("steps", "")
        if self.status == PARTIAL_STATUS:
            return
        if statistics is None or not text.isdecimal():
            return  # what is not a number is refused where it is asked for
        steps = self.steps
        for number, part in self._parts.items():
            count = statistics.channel_message_counts.get(number, 0)
            expected = steps // part.channel.period + 1
            if count != expected and (count or steps):  # a run may end before its first row
                raise LogError(
                    f"{self.path} is damaged: expected {expected} rows of {part.channel.name!r} "
                    f"for {steps} steps, got {count}"
                )

    def _check_format(self) -> None:
        log_format = self._metadata.get("cosim.run", {}).get("format", FORMAT)
        if log_format != FORMAT:
            raise LogError(
                f"{self.path}: expected log format {FORMAT!r}, got {log_format!r} of another "
                "version of cosim: run its scenario again"
            )

    def _recognize_partial(self) -> None:
        """Read what the log is a part of, and the kinds of what it has not, where it is partial.

        Raises
        ------
        LogError
            If that cannot be parsed.
        """
        found = self._parsed(
            "the record of the run",
            lambda items: read_partial(items, self._channels),
            self._metadata,
        )
        if found is not None:
            partial, self._kinds = found
            self._channels = PartialChannels(self._channels, partial)

    def _read_metadata(self) -> dict[str, Mapping[str, str]]:
        metadata: dict[str, Mapping[str, str]] = {}
        try:
            for record in self._file.metadata():
                metadata[record.name] = verify_checksum(record.name, record.metadata)
        except ValueError as error:
            raise LogError(f"{self.path}: {error}") from error
        return metadata

    def _result_number(self, key: str) -> int:
        if key not in self._metadata.get(RESULT, {}):
            raise self._missing(key)
        return self._parsed(key, read_number, self._metadata[RESULT][key])

    def _missing(self, key: str) -> LogError:
        return LogError(
            f"{self.path} has no {key!r}: the {RESULT} record, which cosim writes, is missing"
        )

    def _component_metadata(
        self, component: str, key: str, parse: Callable[[str], _Parsed], default: _Parsed
    ) -> _Parsed:
        """Parse a component's metadata; ``default`` where another tool left them out."""
        items = self._metadata.get(f"cosim.component.{component}", {})
        text = items.get(key)
        if text is None:
            return default
        return self._parsed(f"{key} of {component!r}", parse, text)

    def _parsed(self, what: str, parse: Callable[[_Text], _Parsed], text: _Text) -> _Parsed:
        try:
            return parse(text)
        except (*MALFORMED, GraphError) as error:
            raise LogError(f"{self.path}: {what} cannot be parsed: {error}") from error


def _read_mask(text: str) -> Mask:
    values = read_json(text)
    if not isinstance(values, list) or not all(isinstance(value, bool) for value in values):
        raise ValueError(f"expected a list of truth values, got {quoted(values)}")
    mask = np.array(values, dtype=np.bool_)
    mask.setflags(write=False)
    return mask
