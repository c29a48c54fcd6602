"""A log file as arrays.

A component's rows are read when first asked for, chunk by chunk, with every CRC checked.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar, final

import numpy as np
from mcap.opcode import Opcode

from cosim.arrays import Mask, Matrix, Nanoseconds
from cosim.core.contracts import Design, MessageLevel
from cosim.core.recorded import RecordedSignals, find_channel
from cosim.core.signals import Channel
from cosim.errors import GraphError, LogError, nearest
from cosim.log.columns import SignalRows
from cosim.log.container import MALFORMED, Container
from cosim.log.content import combine_hashes, hash_input
from cosim.log.layout import Part, read_part, record_dtype, signals_json
from cosim.log.metadata import decode_design, verify_checksum
from cosim.log.preamble import FORMAT, LOG_TOPIC
from cosim.log.result import RESULT, RESULT_FILE
from cosim.log.scan import OtherRecord, scan
from cosim.log.schema import decode_log

_LOG_TIME = slice(6, 14)  # of a message record's content
_DATA = slice(22, None)
_HASHED_ROWS = 2**16  # at a time

_Parsed = TypeVar("_Parsed")


@dataclass(frozen=True, slots=True)
class LogMessage:
    """A message of the run or of a component."""

    time_ns: int
    level: MessageLevel
    source: str  # "run", or the component's name
    text: str


def open_log(path: Path | str) -> Log:
    """Open a log file.

    Raises
    ------
    LogError
        If the file is no MCAP, truncated or damaged, or was not written by cosim.
    """
    return Log(Path(path))


@final
class Log(RecordedSignals):
    """A recorded run in an MCAP file.

    Parameters
    ----------
    path : Path

    Raises
    ------
    LogError
        From every method: if the file is damaged, has changed, or lacks what is asked for.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = Container(path)
        self._declared = self._file.channels()
        self._metadata = self._read_metadata()
        self._check_format()
        self._parts = self._read_parts()
        self._channels = self._read_channels()
        self._attachments = self._file.attachments()
        self._rows: dict[str, tuple[Nanoseconds, Matrix]] = {}

    @property
    def label(self) -> str:
        """The path."""
        return str(self.path)

    @property
    def channels(self) -> Mapping[str, Channel]:
        """The recorded components by name, in the order of the row."""
        return MappingProxyType(self._channels)

    @property
    def kinds(self) -> Mapping[str, str]:
        """The kinds of the components, as the scenario calls them."""
        return {part.channel.name: part.kind for part in self._parts.values()}

    @property
    def metadata(self) -> Mapping[str, Mapping[str, str]]:
        """The metadata records by name."""
        return MappingProxyType(self._metadata)

    @property
    def attachments(self) -> tuple[str, ...]:
        """Names of the attachments."""
        return tuple(self._attachments)

    @property
    def step_ns(self) -> int:
        """Communication step [ns]."""
        return next(part.step_ns for part in self._parts.values())

    @property
    def status(self) -> str:
        """How the run ended: ``complete``, ``failed`` or ``interrupted``.

        ``unknown`` if another tool left that out.
        """
        return self._metadata.get(RESULT, {}).get("status", "unknown")

    @property
    def reason(self) -> str:
        """Stop reason; empty where the run came to its end."""
        return self._metadata.get(RESULT, {}).get("reason", "")

    @property
    def end_ns(self) -> int:
        """The last recorded instant [ns], from the result; 0 if there are no rows."""
        return self._result_number("end_ns")

    @property
    def steps(self) -> int:
        """Number of the last recorded communication step, from the result."""
        return self._result_number("steps")

    @property
    def result(self) -> Mapping[str, Any]:
        """The content of ``result.json``; empty if there is none.

        Raises
        ------
        LogError
            If it is no valid JSON, or damaged.
        """
        if RESULT_FILE not in self._attachments:
            return {}
        try:
            return dict(json.loads(self.attachment(RESULT_FILE)))
        except ValueError as error:
            raise LogError(f"{self.path}: {RESULT_FILE} cannot be read: {error}") from error

    @property
    def designs(self) -> Mapping[str, Design]:
        """The design-time arrays of every component, bit for bit."""
        designs: dict[str, Design] = {}
        for name in self._channels:
            designs[name] = self._component_metadata(name, "cosim.design", decode_design, {})
        return designs

    @property
    def held(self) -> Mapping[str, Mask]:
        """Which input elements of every component had a zero-order hold."""
        held: dict[str, Mask] = {}
        for name, channel in self._channels.items():
            none_held = np.zeros(channel.interface.n_u, dtype=np.bool_)
            held[name] = self._component_metadata(name, "cosim.held", _read_mask, none_held)
        return held

    def rows(self, component: str) -> Matrix:
        """Return all rows of a component: applied inputs, then outputs.

        Shape (N, width), read-only.
        """
        return self._times_and_rows(component)[1]

    def time_ns(self, component: str) -> Nanoseconds:
        """Return the instants of a component's rows, shape (N,) [ns]; read-only."""
        return self._times_and_rows(component)[0]

    def load(self, *components: str) -> None:
        """Read several components in one pass over the file; none named: all."""
        wanted = components or tuple(self._channels)
        missing = [name for name in wanted if name not in self._rows]
        self._rows.update(self._read_rows(missing))

    def attachment(self, name: str) -> bytes:
        """Return the content of an attachment.

        Raises
        ------
        LogError
            If there is none of that name, or it is damaged.
        """
        if name not in self._attachments:
            nearest_names = nearest(name, self._attachments)
            raise LogError(f"{self.path} has no attachment {name!r}; {nearest_names}")
        return self._file.attachment(self._attachments[name])

    def messages(self) -> list[LogMessage]:
        """Return the messages of the run and its components, in the order of time.

        Raises
        ------
        LogError
            If the file is damaged.
        """
        channel_ids = set()
        for number, channel in self._declared.items():
            if channel.topic == LOG_TOPIC:
                channel_ids.add(number)
        messages = []
        try:
            for record in self._other_records():
                if record.opcode == Opcode.MESSAGE and record.channel_id in channel_ids:
                    time_ns = int.from_bytes(record.content[_LOG_TIME], "little")
                    level, source, text = decode_log(record.content[_DATA])
                    messages.append(LogMessage(time_ns, level, source, text))
        except MALFORMED as error:
            raise LogError(f"{self.path} is damaged: {error}") from error
        return sorted(messages, key=lambda message: message.time_ns)

    def content_hash(self) -> str:
        """Compute the hash of every bit of every signal from the data, one component at a time."""
        components = []
        for name, channel in self._channels.items():
            # Rows read for the hash are not kept: a log may be larger than the memory.
            if name in self._rows:
                time_ns, rows = self._rows[name]
            else:
                time_ns, rows = self._read_rows([name])[name]
            digest = hashlib.sha256()
            for start in range(0, len(rows), _HASHED_ROWS):
                stop = start + _HASHED_ROWS
                digest.update(hash_input(time_ns[start:stop], rows[start:stop]))
            declaration = signals_json(channel.interface)
            components.append((name, declaration, digest.hexdigest()))
        return combine_hashes(components)

    def _times_and_rows(self, component: str) -> tuple[Nanoseconds, Matrix]:
        find_channel(self._channels, component, source=str(self.path))
        self.load(component)
        return self._rows[component]

    def _other_records(self) -> Iterator[OtherRecord]:
        """Yield the records that are no rows of a component."""
        dtypes = self._dtypes()
        for block in self._file.blocks():
            for record in scan(block, dtypes):
                if isinstance(record, OtherRecord):
                    yield record

    def _read_rows(self, components: list[str]) -> dict[str, tuple[Nanoseconds, Matrix]]:
        """Read the rows of some components in one pass."""
        if not components:
            return {}
        try:
            parts = self._read_part_rows(components)
            self._check_counts(parts)
            rows = {}
            for name in components:
                own_parts = [part for part in parts.values() if part.component == name]
                rows[name] = _side_by_side(own_parts)
        except MALFORMED as error:
            raise LogError(f"{self.path} is damaged: {error}") from error
        return rows

    def _read_part_rows(self, components: list[str]) -> dict[int, SignalRows]:
        """Read the rows of some components by channel id."""
        dtypes = self._dtypes()
        rows: dict[int, SignalRows] = {}
        for number, part in self._parts.items():
            if part.channel.name in components:
                expected = self._file.expected_messages(number, dtypes[number].itemsize)
                rows[number] = SignalRows(part, expected)
        for block in self._file.blocks():
            for record in scan(block, dtypes):
                if isinstance(record, OtherRecord):
                    self._check_declared(record)
                    continue
                number, messages = record
                if number in rows:
                    rows[number].append(messages)
        return rows

    def _check_declared(self, record: OtherRecord) -> None:
        """Check that a message's channel exists: a flipped bit may hide a row in another channel.

        Raises
        ------
        ValueError
            If it does not.
        """
        is_declared = record.channel_id in self._declared
        if record.opcode == Opcode.MESSAGE and not is_declared:
            raise ValueError(f"a message of channel {record.channel_id}, which is declared nowhere")

    def _check_counts(self, parts: Mapping[int, SignalRows]) -> None:
        """Check the numbers of rows against the summary, if there is one.

        Raises
        ------
        ValueError
            If they differ.
        """
        statistics = self._file.summary.statistics
        if statistics is None:
            return
        for number, part in parts.items():
            needed = statistics.channel_message_counts.get(number, 0)
            if part.count != needed:
                raise ValueError(
                    f"{part.count} rows of {part.component!r} found, its summary says {needed}"
                )

    def _dtypes(self) -> dict[int, np.dtype[np.void]]:
        return {number: record_dtype(part.size) for number, part in self._parts.items()}

    def _check_format(self) -> None:
        found = self._metadata.get("cosim.run", {}).get("format", FORMAT)
        if found != FORMAT:
            raise LogError(
                f"{self.path}: written in log format {found!r}, by another version of cosim; "
                f"needed format {FORMAT!r}: run its scenario again"
            )

    def _read_parts(self) -> dict[int, Part]:
        """Read the parts of the components from their channels' metadata, by channel id."""
        parts = {}
        for number, channel in self._declared.items():
            if "cosim.component" not in channel.metadata:
                continue
            try:
                parts[number] = read_part(channel.metadata)
            except (*MALFORMED, GraphError) as error:
                raise LogError(
                    f"{self.path}: channel {channel.topic!r} cannot be understood: {error}"
                ) from error
        if not parts:
            topics = [channel.topic for channel in self._declared.values()]
            joined = ", ".join(topics) or "no channels at all"
            raise LogError(
                f"{self.path} has no channels of cosim, which carry 'cosim.component';"
                f" found: {joined}"
            )
        return parts

    def _read_channels(self) -> dict[str, Channel]:
        """Return the components in the order of the row, each checked to be whole."""
        # By name too: a component without signals starts where the next one does.
        parts = sorted(
            self._parts.values(), key=lambda part: (part.channel.start, part.channel.name)
        )
        channels = {part.channel.name: part.channel for part in parts}
        for name, channel in channels.items():
            columns = [part.columns for part in parts if part.channel.name == name]
            self._check_whole(channel, columns)
        return channels

    def _check_whole(self, channel: Channel, columns: list[slice]) -> None:
        """Check that the parts of a component tile its row.

        Raises
        ------
        LogError
            If some columns are missing, or recorded more than once.
        """
        spans = sorted((span.start, span.stop) for span in columns)
        column = 0
        is_contiguous = True
        for start, stop in spans:
            is_contiguous &= start == column
            column = stop
        width = channel.columns.stop - channel.start
        if not is_contiguous or column != width:
            raise LogError(
                f"{self.path}: component {channel.name!r} is not complete: its channels hold"
                f" columns {spans}, needed 0 to {width} once"
            )

    def _read_metadata(self) -> dict[str, Mapping[str, str]]:
        metadata: dict[str, Mapping[str, str]] = {}
        try:
            for record in self._file.metadata():
                metadata[record.name] = verify_checksum(record.name, record.metadata)
        except ValueError as error:
            raise LogError(f"{self.path}: {error}") from error
        return metadata

    def _result_number(self, key: str) -> int:
        try:
            return int(self._metadata[RESULT][key])
        except MALFORMED as error:
            raise LogError(
                f"{self.path} has no {key!r}: needed a {RESULT} record, which cosim writes"
            ) from error

    def _component_metadata(
        self, component: str, key: str, parse: Callable[[str], _Parsed], default: _Parsed
    ) -> _Parsed:
        """Parse a component's metadata; ``default`` where another tool left them out."""
        items = self._metadata.get(f"cosim.component.{component}", {})
        text = items.get(key)
        try:
            return default if text is None else parse(text)
        except MALFORMED as error:
            raise LogError(
                f"{self.path}: {key} of {component!r} cannot be understood: {error}"
            ) from error


def _side_by_side(parts: list[SignalRows]) -> tuple[Nanoseconds, Matrix]:
    """Join the parts of a component to its rows.

    Raises
    ------
    ValueError
        If they have rows at different times.
    """
    ordered = sorted(parts, key=lambda rows: rows.part.columns.start)
    time_ns, values = ordered[0].in_time_order()
    columns = [values]
    for rows in ordered[1:]:
        other_time_ns, other_values = rows.in_time_order()
        if not np.array_equal(time_ns, other_time_ns):
            raise ValueError(f"the channels of {rows.component!r} have rows at different times")
        columns.append(other_values)
    if len(columns) > 1:
        values = np.hstack(columns)
    time_ns.setflags(write=False)
    values.setflags(write=False)
    return time_ns, values


def _read_mask(text: str) -> Mask:
    mask = np.array(json.loads(text), dtype=np.bool_)
    mask.setflags(write=False)
    return mask
