"""A log file as arrays: a component's rows are read when first asked for, chunk by chunk, with every CRC checked."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, final

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from cosim.arrays import Mask, Matrix, Nanoseconds, Vector
from cosim.core.contracts import Design, MessageLevel
from cosim.core.recorders import find_channel, find_signal
from cosim.core.signals import Channel
from cosim.errors import GraphError, LogError, nearest
from cosim.log.columns import SignalRows
from cosim.log.container import MALFORMED, Container
from cosim.log.content import combine, hashable
from cosim.log.layout import Part, read_part, record_dtype, signals_json
from cosim.log.metadata import decode_design, unseal
from cosim.log.preamble import LOG_TOPIC
from cosim.log.result import RESULT, RESULT_FILE
from cosim.log.scan import Loose, scan
from cosim.log.schema import decode_log

_TIME = slice(6, 14)  # of a message record's content


@dataclass(frozen=True, slots=True)
class LogMessage:
    """A message of the run or of a component."""

    time_ns: int
    level: MessageLevel
    name: str
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
class Log:
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
        self._parts = self._read_parts()
        self._channels = self._read_channels()
        self._metadata = self._read_metadata()
        self._attachments = self._file.attachments()
        self._rows: dict[str, tuple[Nanoseconds, Matrix]] = {}

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
        """How the run ended: ``complete``, ``failed`` or ``interrupted``; ``unknown`` if another tool left that out."""
        return self._metadata.get(RESULT, {}).get("status", "unknown")

    @property
    def reason(self) -> str:
        """Why it ended so; empty where it came to its end."""
        return self._metadata.get(RESULT, {}).get("reason", "")

    @property
    def end_ns(self) -> int:
        """The last recorded instant [ns], as the result tells it; 0 if there are no rows."""
        return self._told("end_ns")

    @property
    def steps(self) -> int:
        """Number of the last recorded communication step, as the result tells it."""
        return self._told("steps")

    @property
    def result(self) -> Mapping[str, Any]:
        """What ``result.json`` says; empty if there is none."""
        if RESULT_FILE not in self._attachments:
            return {}
        try:
            return dict(json.loads(self.attachment(RESULT_FILE)))
        except ValueError as error:
            raise LogError(f"{self.path}: {RESULT_FILE} cannot be read: {error}") from error

    @property
    def designs(self) -> Mapping[str, Design]:
        """The design-time arrays of every component, bit for bit."""
        return {
            name: self._component_metadata(name, "cosim.design", {}, decode_design)
            for name in self._channels
        }

    @property
    def held(self) -> Mapping[str, Mask]:
        """Which input elements of every component held their value over a step."""
        free = {
            name: np.zeros(channel.interface.n_u, dtype=np.bool_)
            for name, channel in self._channels.items()
        }
        return {
            name: self._component_metadata(name, "cosim.held", mask, _mask)
            for name, mask in free.items()
        }

    def signals(self) -> list[str]:
        """Names of all signals, ``component.signal``."""
        return [
            f"{name}.{signal.name}"
            for name, channel in self._channels.items()
            for signal in channel.signals
        ]

    def __getitem__(self, signal: str) -> NDArray[np.float64]:
        """Give ``component.signal`` at every recorded row: shape (N,) for size 1, else (N, size); read-only."""
        channel, columns = find_signal(self._channels, signal, source=str(self.path))
        values = self.rows(channel.name)[
            :, columns.start - channel.start : columns.stop - channel.start
        ]
        return values[:, 0] if values.shape[1] == 1 else values

    def rows(self, component: str) -> Matrix:
        """Give all rows of a component, applied inputs, then outputs, shape (N, width); read-only."""
        return self._loaded(component)[1]

    def time_ns(self, component: str) -> Nanoseconds:
        """Give the instants of a component's rows, shape (N,) [ns]; read-only."""
        return self._loaded(component)[0]

    def time(self, name: str) -> Vector:
        """Give the instants of a signal's or component's rows, shape (N,) [s]."""
        channel = (
            find_signal(self._channels, name, source=str(self.path))[0] if "." in name else None
        )
        return self.time_ns(channel.name if channel else name) / 1e9

    def load(self, *components: str) -> None:
        """Read several components in one pass over the file; none named: all."""
        wanted = [name for name in components or self._channels if name not in self._rows]
        self._rows.update(self._gather(wanted))

    def attachment(self, name: str) -> bytes:
        """Give the content of an attachment."""
        if name not in self._attachments:
            raise LogError(
                f"{self.path} has no attachment {name!r}; {nearest(name, self._attachments)}"
            )
        return self._file.attachment(self._attachments[name])

    def messages(self) -> list[LogMessage]:
        """Give what the run and its components said, in the order of time."""
        spoken = {
            number for number, channel in self._declared.items() if channel.topic == LOG_TOPIC
        }
        found = []
        try:
            for block in self._file.blocks():
                for record in scan(block, self._dtypes()):
                    if (
                        isinstance(record, Loose)
                        and record.opcode == Opcode.MESSAGE
                        and record.channel_id in spoken
                    ):
                        time_ns = int.from_bytes(record.content[_TIME], "little")
                        found.append(LogMessage(time_ns, *decode_log(record.content[22:])))
        except MALFORMED as error:
            raise LogError(f"{self.path} is damaged: {error}") from error
        return sorted(found, key=lambda message: message.time_ns)

    def content_hash(self) -> str:
        """Compute the hash of every bit of every signal from the data, one component at a time."""
        digests = []
        for name, channel in self._channels.items():
            time_ns, rows = self._rows.get(name) or self._gather([name])[name]
            digest = hashlib.sha256()
            for start in range(0, len(rows), 2**16):
                digest.update(hashable(time_ns[start : start + 2**16], rows[start : start + 2**16]))
            digests.append((name, signals_json(channel.interface), digest.hexdigest()))
        return combine(digests)

    def _loaded(self, component: str) -> tuple[Nanoseconds, Matrix]:
        find_channel(self._channels, component, source=str(self.path))
        self.load(component)
        return self._rows[component]

    def _gather(self, components: list[str]) -> dict[str, tuple[Nanoseconds, Matrix]]:
        """Read the rows of some components in one pass."""
        if not components:
            return {}
        dtypes = self._dtypes()
        wanted = {
            number: part for number, part in self._parts.items() if part.channel.name in components
        }
        rows = {
            number: SignalRows(part, self._file.expected(number, dtypes[number].itemsize))
            for number, part in wanted.items()
        }
        try:
            for block in self._file.blocks():
                for found in scan(block, dtypes):
                    if isinstance(found, Loose):
                        self._check_declared(found)
                    elif found[0] in rows:
                        rows[found[0]].append(found[1])
            self._check_counts(rows)
            return {
                name: _joined([part for part in rows.values() if part.component == name])
                for name in components
            }
        except MALFORMED as error:
            raise LogError(f"{self.path} is damaged: {error}") from error

    def _check_declared(self, found: Loose) -> None:
        if found.opcode == Opcode.MESSAGE and found.channel_id not in self._declared:
            raise ValueError(f"a message of channel {found.channel_id}, which is declared nowhere")

    def _check_counts(self, rows: Mapping[int, SignalRows]) -> None:
        told = self._file.summary.statistics
        for number, found in rows.items():
            needed = told.channel_message_counts.get(number, 0) if told else found.count
            if found.count != needed:
                raise ValueError(
                    f"{found.count} rows of {found.component!r} found, its summary says {needed}"
                )

    def _dtypes(self) -> dict[int, np.dtype[np.void]]:
        return {number: record_dtype(part.size) for number, part in self._parts.items()}

    def _read_parts(self) -> dict[int, Part]:
        ours = {
            number: channel
            for number, channel in self._declared.items()
            if "cosim.component" in channel.metadata
        }
        if not ours:
            topics = (
                ", ".join(channel.topic for channel in self._declared.values())
                or "no channels at all"
            )
            raise LogError(
                f"{self.path} has no channels of cosim, which carry 'cosim.component'; found: {topics}"
            )
        parts = {}
        for number, channel in ours.items():
            try:
                parts[number] = read_part(channel.metadata)
            except (*MALFORMED, GraphError) as error:
                raise LogError(
                    f"{self.path}: channel {channel.topic!r} cannot be understood: {error}"
                ) from error
        return parts

    def _read_channels(self) -> dict[str, Channel]:
        channels = {}
        for part in sorted(
            self._parts.values(), key=lambda part: (part.channel.start, part.channel.name)
        ):
            channels[part.channel.name] = part.channel
        for name, channel in channels.items():
            spans = sorted(
                (part.columns.start, part.columns.stop)
                for part in self._parts.values()
                if part.channel.name == name
            )
            edges = [0, *(stop for _, stop in spans)]
            if [start for start, _ in spans] != edges[:-1] or edges[
                -1
            ] != channel.columns.stop - channel.start:
                raise LogError(
                    f"{self.path}: component {name!r} is not there once and whole; its channels hold columns {spans}"
                )
        return channels

    def _read_metadata(self) -> dict[str, Mapping[str, str]]:
        try:
            return {
                record.name: unseal(record.name, record.metadata)
                for record in self._file.metadata()
            }
        except ValueError as error:
            raise LogError(f"{self.path}: {error}") from error

    def _told(self, key: str) -> int:
        try:
            return int(self._metadata[RESULT][key])
        except MALFORMED as error:
            raise LogError(
                f"{self.path} does not tell {key!r}: needed a {RESULT} record, which cosim writes"
            ) from error

    def _component_metadata(self, component: str, key: str, default: Any, parse: Any) -> Any:
        text = self._metadata.get(f"cosim.component.{component}", {}).get(key)
        try:
            return default if text is None else parse(text)
        except MALFORMED as error:
            raise LogError(
                f"{self.path}: {key} of {component!r} cannot be understood: {error}"
            ) from error


def _joined(parts: list[SignalRows]) -> tuple[Nanoseconds, Matrix]:
    """Put the parts of a component side by side."""
    ordered = [rows.sorted() for rows in sorted(parts, key=lambda rows: rows.part.columns.start)]
    time_ns, values = ordered[0]
    if len(ordered) > 1:
        if not all(np.array_equal(time_ns, other) for other, _ in ordered):
            raise ValueError(f"the channels of {parts[0].component!r} have rows at different times")
        values = np.hstack([part for _, part in ordered])
    for array in (time_ns, values):
        array.setflags(write=False)
    return time_ns, values


def _mask(text: str) -> Mask:
    mask = np.array(json.loads(text), dtype=np.bool_)
    mask.setflags(write=False)
    return mask
