"""Recordings of any origin to read from: a log of cosim, a table, an MCAP file of another tool."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Final, final

import numpy as np

from cosim.arrays import Mask, read_only
from cosim.blocks.field_data import FieldSignal
from cosim.core.recorded.run import RecordedRun
from cosim.core.recording import TimedRows
from cosim.core.signals import Channel, Interface, Signal
from cosim.errors import LogError, UsageError, listing, warn
from cosim.files import expanded, file_type
from cosim.instants import NANOSECONDS
from cosim.log.foreign.fields import split_field
from cosim.log.foreign.samples import read_fields, survey
from cosim.log.foreign.topics import is_foreign
from cosim.log.reader import open_log
from cosim.scenario.data_files.field_file import field_data

TABLE: Final = "table"  # the component of columns that name none
VALUE: Final = "value"  # of messages that have no fields

_WHOLE: Final = re.compile(r"\[0:\d+\]$")  # of a field that is a vector, all of its elements
_MOST_SECONDS: Final = 2**63 / NANOSECONDS


def open_recording(path: str | Path) -> RecordedRun:
    r"""Open a recording of cosim or of another tool, to read, compare, plot or convert it.

    Parameters
    ----------
    path : str or Path
        Of a log of cosim, which is opened as by :func:`cosim.open_log`; of a table (CSV and other
        text, .parquet, .xlsx, .mat) with a column of times, as :func:`cosim.read_field_data` finds
        them; or of an MCAP file of another tool. A column ``plant.y`` is signal y of component
        plant, and ``plant.x[0]``, ``plant.x[1]``, ... are elements of one; a column without a
        component belongs to ``table``. Of messages a topic is a component, and its numeric fields
        are signals, at their log times.

    Raises
    ------
    UsageError, LogError
        If the file cannot be read, is damaged, or is no such recording.

    Examples
    --------
    >>> with open("level.csv", "w") as file:
    ...     _ = file.write("t [s],level [mm]\n0,1.5\n0.5,2.0\n")
    >>> open_recording("level.csv")["table.level"].tolist()
    [1.5, 2.0]
    """
    path = expanded(path)
    match file_type(path):
        case "table":
            return _table(path)
        case "log" if is_foreign(path):
            return _messages(path)
        case _:
            return open_log(path)


@final
class FileRun(RecordedRun):
    """Samples from a file of another tool: a run without a scenario, events or messages.

    Parameters
    ----------
    label : str
        Path of the file.
    channels : mapping of name to Channel
    samples : mapping of name to (times, rows)
        Of every component, in order of time.
    """

    def __init__(
        self, label: str, channels: Mapping[str, Channel], samples: Mapping[str, TimedRows]
    ) -> None:
        self._label = label
        self._channels = channels
        self._samples = samples
        distances = [np.diff(times).min() for times, _ in samples.values() if len(times) > 1]
        self._step_ns = int(min(distances, default=NANOSECONDS))

    @property
    def label(self) -> str:
        """Path of the file."""
        return self._label

    @property
    def status(self) -> str:
        """A file that is whole is a complete run."""
        return "complete"

    @property
    def channels(self) -> Mapping[str, Channel]:
        """The components by name, in the order of the file."""
        return self._channels

    def attachment(self, name: str) -> bytes:
        """Refuse: there is none.

        Raises
        ------
        LogError
            Always.
        """
        raise LogError(f"{self.label} has no attachment {name!r}, as it is no log of cosim")

    @property
    def held(self) -> Mapping[str, Mask]:
        """It has no inputs."""
        return {name: np.zeros(0, np.bool_) for name in self.channels}

    @property
    def step_ns(self) -> int:
        """The shortest distance of two rows of a component [ns]."""
        return self._step_ns

    @property
    def steps(self) -> int:
        """Number of the last row of the component that has most."""
        return max((len(times) - 1 for times, _ in self._samples.values()), default=0)

    @property
    def end_ns(self) -> int:
        """The last instant [ns]."""
        return max((int(times[-1]) for times, _ in self._samples.values()), default=0)

    def _timed_rows(self, channel: Channel) -> TimedRows:
        return self._samples[channel.name]


def _table(path: Path) -> FileRun:
    """Read a table; a component has rows where one of its columns has a number."""
    data = field_data(path)
    warn(data.diagnostics)
    if len(data.t) and max(abs(data.t[0]), abs(data.t[-1])) >= _MOST_SECONDS:
        raise UsageError(f"{data.source}: expected times within 292 years of 0, got {data.t[-1]} s")
    time_ns = np.array([round(t * NANOSECONDS) for t in data.t.tolist()], np.int64)
    if (np.diff(time_ns) <= 0).any():
        raise UsageError(f"{data.source}: expected times at least 1 ns apart")
    components: dict[str, list[FieldSignal]] = defaultdict(list)
    for signal in data.signals:
        component, dot, _ = signal.name.partition(".")
        components[component if dot else TABLE].append(signal)
    channels: dict[str, Channel] = {}
    samples: dict[str, TimedRows] = {}
    start = 0
    for name, own in components.items():
        signals = [
            Signal(
                signal.name.removeprefix(f"{name}."),
                signal.values.shape[1],
                unit=signal.unit,
                optional=True,
            )
            for signal in own
        ]
        rows = np.hstack([signal.values for signal in own])
        is_measured = ~np.isnan(rows).all(axis=1)
        channels[name] = Channel(name, Interface((), tuple(signals)), start)
        samples[name] = time_ns[is_measured], read_only(rows[is_measured])
        start += rows.shape[1]
    return FileRun(str(path), channels, samples)


def _messages(path: Path) -> FileRun:
    """Read the numeric fields of all topics that have any."""
    topics: dict[str, dict[str, str]] = defaultdict(dict)
    for part in survey(path):
        topics[part.channel.topic] |= part.fields
    names = [name for fields in topics.values() for name in fields]
    unknown = [name for name in names if "[]" in name]
    if unknown:
        warn([f"{path}: arrays of any length are left out: {listing(unknown)}"])
    names = [name for name in names if name not in unknown]
    if not names:
        raise LogError(f"{path}: expected messages with numeric fields, got none")
    found = {one.field: one for one in read_fields(path, names, is_lenient=True)}
    channels: dict[str, Channel] = {}
    samples: dict[str, TimedRows] = {}
    start = 0
    for topic, fields in topics.items():
        own = [found[field] for field in fields if field in found]
        if not own:
            continue
        rows = np.hstack([each.values for each in own])
        signals = [
            Signal(
                _name(each.field, topic),
                each.values.shape[1],
                variability="discrete" if each.is_discrete else "continuous",
                optional=True,
            )
            for each in own
        ]
        channels[topic] = Channel(topic, Interface((), tuple(signals)), start)
        samples[topic] = own[0].time_ns, read_only(rows)
        start += rows.shape[1]
    names = [f"{name}.{signal.name}" for name, one in channels.items() for signal in one.signals]
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise LogError(f"{path}: expected one field of each name, got two of {twice[0]!r}")
    return FileRun(str(path), channels, samples)


def _name(field: str, topic: str) -> str:
    """Return the name in a topic of a field; a message may be the number or the array itself."""
    found = split_field(field, [topic])
    return _WHOLE.sub("", found[1] if found else field) or VALUE
