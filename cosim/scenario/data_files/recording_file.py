"""Recordings of any origin to read from: a log of cosim, a table, an MCAP file of another tool."""

from __future__ import annotations

import json
import zipfile
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from io import BytesIO
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, TypeAlias, final

import numpy as np
from numpy.lib.format import read_array

from cosim.arguments import path_argument
from cosim.arrays import Mask, Matrix, Nanoseconds, Vector, as_columns, is_absent, read_only
from cosim.core.port import Port
from cosim.core.recorded.run import RecordedRun
from cosim.core.recorded.signals import RunMessage
from cosim.core.recording import TimedRows
from cosim.core.signals import Channel, Interface, Signal
from cosim.errors import GraphError, LogError, UsageError, listing, names_by_reason, warn
from cosim.files import read_type
from cosim.instants import NANOSECONDS
from cosim.log.conversion import SIGNALS_KEY, TIME_KEY
from cosim.log.foreign.recording import read_recording
from cosim.log.foreign.topics import is_foreign
from cosim.log.reader import open_log
from cosim.scenario.data_files.field_file import recorded_table
from cosim.scenario.data_files.mat_file import OtherVariable, read_variables
from cosim.scenario.data_files.table import LARGEST, content_of

TABLE: Final = "table"  # the component of columns that name none

_ARRAYS: Final = (".mat", ".npz")  # that 'cosim convert' writes
_MOST_WARNINGS: Final = 10  # about what is left out
_BETWEEN_ROWS: Final = {
    "variability": ("continuous", "discrete"),
    "type": ("real", "integer", "boolean"),
}
_MOST_SECONDS: Final = 2**63 / NANOSECONDS


def open_recording(path: str | Path) -> RecordedRun:
    r"""Open a recording of cosim or of another tool, to read, compare, plot or convert it.

    Parameters
    ----------
    path : str or Path
        Of a log of cosim, which is opened as by :func:`cosim.open_log`; of what ``cosim convert``
        made of one; of a table (CSV and other text, .parquet, .xlsx, .mat) with a column of times,
        as :func:`cosim.read_field_data` finds them; or of an MCAP file of another tool. Rows of a
        table at one time are those of a jump. A signal has no row where its cell is empty, and one
        that is NaN where that is written. A column ``plant.y`` is signal y of component
        plant, and ``plant.x[0]``, ``plant.x[1]``, ... are elements of one; a column without a
        component belongs to ``table``. Of messages a topic is a component, and its numeric fields
        are signals, at their log times; each message is a row. What cannot be read is in the
        recording's ``left_out``, with the reason, and a :class:`cosim.CosimWarning`.

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
    path = path_argument("path", path)
    kind = read_type(path)
    has_arrays = kind != "log" and path.suffix.lower() in _ARRAYS
    try:
        run = _arrays(path) if has_arrays else None
        if run is None:
            match kind:
                case "table":
                    run = _table(path)
                case "log" if is_foreign(path):
                    run = _messages(path)
                case _:
                    return open_log(path)
    except GraphError as error:  # of a name that no signal or component can have
        raise UsageError(f"{path}: {error}") from error
    warn(warning.text for warning in run.warnings)
    return run


def is_recording(path: str | Path) -> bool:
    """Return whether a file is one that :func:`open_recording` opens, as far as can be seen."""
    return read_type(path) in ("log", "table") or Path(path).suffix.lower() in _ARRAYS


_ComponentSamples: TypeAlias = tuple[Nanoseconds, Sequence[tuple[Signal, Matrix]]]


@final
class FileRun(RecordedRun):
    """Samples from a file of another tool: a run without a scenario, events or messages.

    Parameters
    ----------
    label : str
        Path of the file.
    components : mapping of name to (times, signals and their values)
        In order of time; ABSENT where a signal has no row.
    left_out : mapping of name to str
        What cannot be read of the file, and why.
    notes : sequence of str
        What else is to be known of how it was read; they are its warnings.
    """

    def __init__(
        self,
        label: str,
        components: Mapping[str, _ComponentSamples],
        left_out: Mapping[str, str] = MappingProxyType({}),
        notes: Sequence[str] = (),
    ) -> None:
        self._label = label
        self._left_out = left_out
        self._notes = notes
        self._rows_of: dict[str, TimedRows] = {}
        self._channels: dict[str, Channel] = {}
        start = 0
        distances = []
        for name, (time_ns, own) in components.items():
            rows = np.hstack([values for _, values in own])
            there = ~is_absent(rows).all(axis=1)
            time_ns, rows = time_ns[there], rows[there]
            self._rows_of[name] = read_only(time_ns), read_only(rows)
            interface = Interface((), tuple(signal for signal, _ in own))
            self._channels[name] = Channel(name, interface, start)
            start += rows.shape[1]
            apart = np.diff(time_ns)
            distances += [int(apart[apart > 0].min())] if (apart > 0).any() else []
        self._step_ns = min(distances, default=NANOSECONDS)

    @property
    def left_out(self) -> Mapping[str, str]:
        """What cannot be read of the file, and why, by name."""
        return self._left_out

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

    def messages(self) -> list[RunMessage]:
        """Return what is to be known of how the file was read."""
        return [RunMessage(0, "warning", "run", text) for text in self._notes]

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
        return max((len(times) - 1 for times, _ in self._rows_of.values()), default=0)

    @property
    def end_ns(self) -> int:
        """The last instant [ns]."""
        lasts = [int(times[-1]) for times, _ in self._rows_of.values() if len(times)]
        return max(lasts, default=0)

    def _timed_rows(self, channel: Channel) -> TimedRows:
        return self._rows_of[channel.name]


def _nanoseconds(label: str, times: Vector) -> Nanoseconds:
    """Return times in s, in order, as whole ns."""
    if len(times) and max(abs(times[0]), abs(times[-1])) >= _MOST_SECONDS:
        raise UsageError(f"{label}: expected times within 292 years of 0, got {times[-1]} s")
    time_ns = np.array([round(t * NANOSECONDS) for t in times.tolist()], np.int64)
    if ((np.diff(time_ns) <= 0) & (np.diff(times) != 0.0)).any():
        raise UsageError(f"{label}: expected times at least 1 ns apart")
    return time_ns


def _table(path: Path) -> FileRun:
    """Read a table; a component has rows where one of its cells is not empty."""
    data, time_ns, unread = recorded_table(path)
    left_out = {_table_name(name): reason for name, reason in unread.items()}
    problems = _left_out_texts(left_out)
    if not data.signals:
        raise UsageError("; ".join([f"{data.source}: expected a column of numbers", *problems]))
    declared = _declared(path)
    components: dict[str, list[tuple[Signal, Matrix]]] = defaultdict(list)
    for found in data.signals:
        component, _, name = _table_name(found.name).partition(".")
        about = declared.get(found.columns[0], {})
        signal = Signal(name, found.values.shape[1], found.unit, optional=True, **about)
        components[component].append((signal, found.values))
    samples = {name: (time_ns, own) for name, own in components.items()}
    notes = [*data.diagnostics, *(f"{path}: {problem}" for problem in problems)]
    return FileRun(str(path), samples, left_out, notes)


def _table_name(column: str) -> str:
    """Return the name of the signal of a column: one without a component is of the table."""
    return column if "." in column else f"{TABLE}.{column}"


def _declared(path: Path) -> dict[str, dict[str, Any]]:
    """Return what the columns are, as 'cosim convert' writes it beside them in Parquet."""
    if path.suffix.lower() != ".parquet":
        return {}
    from pyarrow.parquet import read_schema

    about = {}
    for field in read_schema(path):
        written = {key: (field.metadata or {}).get(key.encode(), b"") for key in _BETWEEN_ROWS}
        about[field.name] = _known({k: v.decode("utf-8", "replace") for k, v in written.items()})
    return about


def _known(about: Mapping[str, str]) -> dict[str, Any]:
    """Return what of a written signal says how it is between two rows."""
    return {key: about[key] for key, known in _BETWEEN_ROWS.items() if about.get(key) in known}


def _messages(path: Path) -> FileRun:
    """Read the numeric fields of all topics that have any."""
    found = read_recording(path)
    problems = _left_out_texts(found.left_out)
    if not found.topics:
        raise LogError(
            "; ".join([f"{path}: expected messages with numeric fields, got none", *problems])
        )
    components: dict[str, _ComponentSamples] = {}
    for topic in found.topics:
        if not topic.topic:
            raise LogError(f"{path}: expected topics with names, got one without")
        signals = []
        for name, values, is_discrete in topic.fields:
            signal = Signal(
                name,
                values.shape[1],
                optional=True,
                variability="discrete" if is_discrete else "continuous",
            )
            signals.append((signal, values))
        components[topic.topic] = topic.time_ns, signals
    names = [f"{topic}.{one.name}" for topic, (_, own) in components.items() for one, _ in own]
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise LogError(f"{path}: expected one field of each name, got two of {twice[0]!r}")
    notes = [f"{path}: {problem}" for problem in problems]
    return FileRun(str(path), components, found.left_out, notes)


def _left_out_texts(left_out: Mapping[str, str]) -> list[str]:
    """Return a text for each of the first ten reasons, and one for how much more is left out."""
    names = names_by_reason(left_out)
    texts = [f"left out: {listing(own)}: {reason}" for reason, own in names.items()]
    more = sum(len(own) for own in list(names.values())[_MOST_WARNINGS:])
    return texts[:_MOST_WARNINGS] + ([f"left out: {more} more"] if more else [])


# --- what 'cosim convert' wrote ---

# what is said of a signal, its values and their times
_WrittenArray: TypeAlias = tuple[Mapping[str, str], Any, Any]


def _npz_arrays(content: bytes) -> Iterator[_WrittenArray]:
    with zipfile.ZipFile(BytesIO(content)) as archive:
        if sum(entry.file_size for entry in archive.infolist()) > LARGEST:
            raise ValueError(f"more than {LARGEST} bytes")

        def read(name: str) -> Any:
            with archive.open(f"{name}.npy") as file:
                try:
                    return read_array(file, allow_pickle=False)
                except ValueError as error:  # numpy advises to allow what runs code
                    raise ValueError(f"array {name!r} is damaged or has Python objects") from error

        for name, about in json.loads(str(read(SIGNALS_KEY))).items():
            times = read(f"{TIME_KEY}{Port.parse(name).component}")
            yield {**about, "name": name}, read(name), times


def _arrays(path: Path) -> FileRun | None:
    """Read arrays as 'cosim convert' writes them; None: they are others."""
    label = f"file {str(path)!r}"
    content = content_of(path)
    arrays: Iterable[_WrittenArray]
    if path.suffix.lower() == ".npz":
        arrays = _npz_arrays(content)
    else:
        found = read_variables(label, content)
        signals = found.get(SIGNALS_KEY)
        if not isinstance(signals, OtherVariable) or not signals.entries:
            return None
        arrays = ((own, found[own["variable"]], found[own["time"]]) for own in signals.entries)
    components: dict[str, tuple[Nanoseconds, list[tuple[Signal, Matrix]]]] = {}
    try:
        for about, written, times in arrays:
            component = Port.parse(about["name"]).component
            values = as_columns(np.asarray(written, np.float64))
            size = values.shape[1]
            units = (about.get("unit") or "").split(", ")
            unit = tuple(units) if len(units) == size > 1 else about.get("unit") or None
            name = about["name"].removeprefix(f"{component}.")
            signal = Signal(name, size, unit, optional=True, **_known(about))
            if component not in components:
                components[component] = (_nanoseconds(label, np.ravel(times)), [])
            time_ns, own = components[component]
            if len(values) != len(time_ns):
                raise ValueError(f"{len(values)} values of {name!r} at {len(time_ns)} times")
            own.append((signal, values))
        return FileRun(str(path), components)
    except UsageError:
        raise
    except Exception as error:  # zipfile and numpy raise whatever a damaged byte leads to
        problem = f"expected arrays as 'cosim convert' writes them: {error}"
        raise UsageError(f"{label}: {problem}") from error
