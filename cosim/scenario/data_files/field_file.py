"""Field data: samples with times of their own, from tables and from MCAP files of other tools.

The names of the columns say what these are, with their units. The times of a table are the index
that pandas wrote, where its name or type is that of times; else the column of a name such as ``t``,
``time`` or ``Timestamp``, else the one in a unit of time, else the one of time stamps; else the
index or the first one, which is said. Times are numbers, dates (ISO 8601) or durations as pandas
writes them (``0 days 00:00:00.02``). An empty cell and NaN say that nothing was measured; all else
that is no finite number is refused, and so are times that do not ascend. The offset of the times is
subtracted before they are rounded: a time stamp in ns since 1970 has more digits than a double.

The times of messages are whole ns, and stay so until the one that is t = 0 is subtracted. With
``offset = "first"`` that is the first instant by which every field that is taken has a sample: at
t = 0 all is measured, and of several components from one file all have the same t = 0.

A message tells where a file is wrong, and of what stands there only the times.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from decimal import Decimal
from functools import partial
from itertools import chain, groupby, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Literal, NamedTuple, TypeAlias, cast

import numpy as np
from pydantic import AfterValidator, Field, PlainValidator, StrictStr, ValidationError

from cosim.arrays import NAN, Matrix, Nanoseconds, Vector
from cosim.blocks.field_data import FieldData, FieldSignal, elements_named
from cosim.errors import UsageError, option, quoted, warn
from cosim.files import expanded
from cosim.instants import NANOSECONDS
from cosim.scenario.data_files.table import (
    DataTable,
    Header,
    SameTime,
    TableForm,
    find_headers,
    is_number,
    is_time_word,
    second_of,
    seconds_in,
    unit_of,
)
from cosim.scenario.data_files.tables import read_table
from cosim.scenario.document.document import plain
from cosim.scenario.document.problems import TableProblems, problems_of
from cosim.units import base_unit, unknown_unit

if TYPE_CHECKING:
    from cosim.log.foreign.samples import FieldSamples
    from cosim.log.foreign.topics import Instants, Spacing

MOST_VALUES: Final = 2**26  # of all signals at all times
_MOST_NS: Final = 2**63
_LONG_GAP: Final = 2  # median distances that are worth a word

SamplesByField: TypeAlias = "Mapping[str, FieldSamples]"


def _time_unit(name: str) -> str:
    if not is_time_word(name) and base_unit(name) is None:
        raise ValueError(unknown_unit(name))
    return name


def _offset(value: object) -> object:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if value != "first" and not (is_number and math.isfinite(cast(float, value))):
        raise ValueError(f'expected a finite number or "first", got {quoted(value)}')
    return value


TimeUnit: TypeAlias = Annotated[str, AfterValidator(_time_unit)]
Offset: TypeAlias = Annotated[int | float | Literal["first"], PlainValidator(_offset)]


class FieldForm(TableForm):
    """A file of samples, and what is given of them."""

    path: str = Field(
        description="path of a table: CSV and other text, .parquet, .xlsx, .mat (trajectory of "
        "Dymola or OpenModelica, arrays); or of an MCAP (.mcap) with messages in protobuf, JSON or "
        "CDR (ROS 2)"
    )
    time: str | None = Field(
        None,
        description="column of the times; default: the index of times that pandas wrote, the "
        'column named as times are, such as "t", "Time [s]" or "timestamp", the one with a unit of '
        'time, the one of dates, or the first, with a warning; MCAP: "log_time" '
        '(default), "publish_time", or a field such as "header.stamp"',
    )
    time_unit: TimeUnit | None = Field(
        None, description="unit of the times; default: from the column name, as in t [ms], or s"
    )
    offset: Offset | None = Field(
        None,
        description="time stamp of t = 0, in the unit of the file (dates: ns since 1970), an "
        'integer exactly, or "first"; default: 0; MCAP: '
        'in time_unit, default "first", the first time when all fields used have a sample',
    )
    columns: dict[str, StrictStr | list[StrictStr]] | None = Field(
        None,
        description='columns per output, such as { y = "level", x_a = ["s1", "s2"] }; default: one '
        "output per column, x[0], x[1], ... as elements of x; MCAP: fields, such as "
        '{ y = "/drive/state.position", u = ["/cmd.a", "/cmd.b[3]"] }; default: those in the '
        "map of the swap",
    )
    missing: tuple[Annotated[float, Field(strict=True)] | StrictStr, ...] = Field(
        (),
        description="what stands for no measured value, beside empty cells and NaN, as in "
        '[-9999, "NA"]',
    )
    same_time: SameTime | None = Field(
        None,
        description='samples of one time stamp: the "last" counts, or they are "spread" evenly up '
        "to the next time stamp, as where stamps are whole seconds; default: refused; trajectory "
        'in a .mat, MCAP: "last"',
    )

    @property
    def is_mcap(self) -> bool:
        """Whether the samples are fields of messages."""
        return Path(self.path).suffix.lower() == ".mcap"

    @property
    def listed_columns(self) -> dict[str, list[str]]:
        """The columns of every signal as a list.

        Raises
        ------
        UsageError
            If a signal has none.
        """
        columns = self.columns or {}
        if not all(columns.values()):
            raise UsageError(f"columns: expected a column for each signal, got {columns}")
        return {name: [own] if isinstance(own, str) else own for name, own in columns.items()}


def read_field_data(
    path: str | Path,
    *,
    time: str | None = None,
    time_unit: str | None = None,
    offset: float | Literal["first"] | None = None,
    columns: Mapping[str, str | Sequence[str]] | None = None,
    separator: str | None = None,
    decimal: str | None = None,
    skip: int | None = None,
    comment: str | None = None,
    missing: Sequence[float | str] = (),
    sheet: str | None = None,
    same_time: SameTime | None = None,
) -> FieldData:
    r"""Read samples with times of their own from a table, or an MCAP of another tool.

    Parameters
    ----------
    path : str or Path
        Of a file whose name ends in .parquet, .xlsx, .mat or .mcap, or of a text, such as CSV.
    time : str, optional
        Name of the column of the times; by default the index that pandas wrote, if it is of times,
        the column that is named as times are (``t``, ``time``, ``timestamp``, ``date``, ...), has a
        unit of time or has dates, or else the first, with a :class:`cosim.CosimWarning`. Of an MCAP
        "log_time", which is the default, "publish_time", or a field of the messages, such as
        "header.stamp".
    time_unit : str, optional
        Unit of the times; by default the one in the name of their column, or s.
    offset : float, int or "first", optional
        The time stamp, as the file has it, that is t = 0; of dates in ns since 1970, of an MCAP in
        ``time_unit``. An integer is exact. "first": the first one, of an MCAP the first by which
        every field has a sample. By default 0, of an MCAP "first".
    columns : mapping of signal to the name of a column, or names of several, optional
        By default every other column is a signal of its name, and ``x[0]``, ``x[1]``, ... are the
        elements of ``x``. Of an MCAP the fields, such as ``/drive/state.position``; needed there.
    separator, decimal : str, optional
        Between the columns of a text, and the decimal sign, "." or ","; by default as found.
        Several blanks count as one.
    skip : int, optional
        Lines, or rows of a sheet, before the names of the columns; by default they are found, above
        the first row of numbers.
    comment : str, optional
        What a line begins with that is left out; by default "#".
    missing : sequence of numbers and texts
        That stand for no measured value, such as ``[-9999, "NA"]``, beside empty cells and NaN.
    sheet : str, optional
        Of a workbook with several.
    same_time : "last" or "spread", optional
        Of samples with one time stamp the last one counts, or they are spread evenly up to the next
        time stamp; the first and the last group may be cut off, and take the distance of their
        neighbor. By default they are refused; in a trajectory of Dymola the last one counts.

    Raises
    ------
    UsageError
        If the file cannot be read, is no such table, or has times that do not ascend.

    Examples
    --------
    >>> with open("level.csv", "w") as file:
    ...     _ = file.write("# tank 3\nt;level\ns;mm\n0,0;1,5\n0,5;-9999\n1,0;2,5\n")
    >>> data = read_field_data("level.csv", missing=[-9999])
    >>> data["level"][:, 0].tolist()
    [1.5, nan, 2.5]
    """
    given = {**locals(), "path": str(path)}
    options = plain({key: value for key, value in given.items() if value is not None})
    try:
        form = FieldForm.model_validate(options)
    except ValidationError as error:
        raise TableProblems(problems_of(error, FieldForm, options, ())) from error
    data = field_data(path, form)
    warn(data.diagnostics)
    return data


def field_data(
    path: str | Path,
    form: FieldForm | None = None,
    *,
    unread: dict[str, str] | None = None,
) -> FieldData:
    """Read samples as :func:`read_field_data` does; whoever takes them shows their diagnostics.

    ``unread`` takes the signals that cannot be read, and why, where that shall be no error.
    """
    path = expanded(path)
    form = form or FieldForm.model_validate({"path": str(path)})
    if form.is_mcap:
        fields = form.listed_columns
        wanted = chain.from_iterable(fields.values())
        return message_data(form, path, fields, partial(read_samples, form, path, wanted))
    return _table_data(read_table(path, form, form.missing), form, unread)[0]


class RecordedTable(NamedTuple):
    """A table as a recording: its samples, their times as whole ns, and what cannot be read."""

    data: FieldData
    time_ns: Nanoseconds
    left_out: dict[str, str]


def recorded_table(path: Path) -> RecordedTable:
    """Read a table as a recording: rows of one time are those of a jump, and NaN is a value.

    Infinity is one, too; an empty cell is ABSENT.
    """
    form = FieldForm.model_validate({"path": str(path)})
    table = read_table(path, form)
    unread = dict(table.left_out)
    for header in table.headers:
        if not header.text and not header.is_index:
            unread[f"column {header.position + 1}"] = "it has no name"
    data, time_ns = _table_data(table, form, unread, jumps=True)
    return RecordedTable(data, time_ns, unread)


def _table_data(
    table: DataTable, form: FieldForm, unread: dict[str, str] | None, *, jumps: bool = False
) -> tuple[FieldData, Nanoseconds]:
    """Return the samples of a table; with jumps also their times as whole ns."""
    named = [header for header in table.headers if header.text]
    clock, notes = _clock(table, named, form)
    chosen = _signals(table.label, named, clock, form)
    times = _times(table, clock, form, jumps=jumps)
    signals = []
    for name, parts in chosen.items():
        try:
            columns = [table.values(part.position, finite=not jumps) for part in parts]
        except UsageError as error:
            if unread is None:
                raise
            unread[name] = str(error).removeprefix(f"{table.label}, ")
            continue
        values = _without_codes(np.stack(columns, axis=1)[times.rows], form.missing)
        if not jumps:
            values[np.isnan(values)] = NAN
        unit = unit_of(table.label, name, parts)
        signals.append(FieldSignal(name, unit, values, tuple(part.text for part in parts)))
    data = FieldData(
        table.label,
        times.t,
        tuple(signals),
        (*notes, *times.notes),
        restart=times.restart,
        reading=tuple(table.reading),
    )
    return data, times.time_ns


def _without_codes(values: Matrix, missing: Sequence[float | str]) -> Matrix:
    """Return values with NaN in the place of numbers that stand for no measured value.

    Texts that are numbers are meant as such, and a column of float32 has a code as float32.
    """
    codes = [float(code) for code in missing if not isinstance(code, str) or is_number(code)]
    if not codes:
        return values
    with np.errstate(over="ignore"):
        rounded = np.array(codes).astype(np.float32).astype(np.float64)
    return np.where(np.isin(values, [*codes, *rounded]), NAN, values)


def offset_text(stamp: Decimal) -> str:
    """Return an offset that is a time stamp or, if that has too many digits, hardly later."""
    if stamp == stamp.to_integral_value():
        return str(int(stamp))
    number = float(stamp)
    return repr(number if Decimal(repr(number)) >= stamp else math.nextafter(number, math.inf))


# --- what the columns of a table are ---


def _clock(
    table: DataTable, named: Sequence[Header], form: FieldForm
) -> tuple[Header, tuple[str, ...]]:
    """Return the column of the times, and what is to be known of it.

    Raises
    ------
    UsageError
        If several may be it.
    """
    unnamed = [one for one in table.headers if not one.text and one.is_index]
    reason = ""
    notes: tuple[str, ...] = ()
    if form.time is not None:
        (clock,) = find_headers(table.label, named, [form.time])
    elif candidates := _candidates([*unnamed, *named]):
        clock = candidates[0]
        if len(candidates) > 1:
            names = ", ".join(repr(header.name) for header in candidates)
            way_out = "select one by time"
            if any(header.has_dates for header in candidates):
                way_out = (
                    "write date and time of day into one, such as 2024-03-01T12:00:00, or select "
                    "one by time and the signals by columns"
                )
            raise UsageError(f"{table.label}: expected one column of times, got {names}; {way_out}")
        is_named = clock.times is not None or clock.time_unit is not None
        reason = "says so by its name or unit" if is_named else "has dates or durations"
    else:
        index = [header for header in named if header.is_index]
        clock = [*unnamed, *index, *named][0]
        where = "the index that pandas wrote" if clock.is_index else "the first column"
        name = f", {clock.name!r}" if clock.name else ""
        reason = "no column says that it has times"
        note = (
            f"{table.label}: the times are those of {where}{name}, in {form.time_unit or 's'}, as "
            "no column says that it has times, by a name such as t or time, a unit of time or "
            "dates; time selects another"
        )
        notes = (note,)
    table.tell("times", repr(clock.name) if clock.name else "index", reason, "time", form.time)
    return clock, notes


def _candidates(headers: Sequence[Header]) -> list[Header]:
    """Return the columns that say of themselves that they have times, in the first way."""
    stamps = [one for one in headers if one.stamp_unit is not None]
    timed = [one for one in headers if one.time_unit is not None]
    called = [one for one in headers if one.times and not (one.has_dates and one.is_number)]
    index = [one for one in (*called, *timed, *stamps) if one.is_index]
    return list(dict.fromkeys(index)) or called or timed or stamps


def _signals(
    label: str, named: Sequence[Header], clock: Header, form: FieldForm
) -> dict[str, list[Header]]:
    """Return the columns of every signal."""
    if form.columns is not None:
        if not form.columns:
            raise UsageError("columns: expected a column for each signal, got {}")
        listed = form.listed_columns.items()
        return {name: find_headers(label, named, parts) for name, parts in listed}
    others = [header for header in named if header != clock]
    own = {header.name: header for header in others}
    for name, count in Counter(header.name for header in others).most_common(1):
        if count > 1:
            raise UsageError(f"{label}: expected a unique column {name!r}, got {count}")
    groups = elements_named(list(own)).items()
    return {name: [own[part] for part in parts] for name, parts in groups}


# --- times of a table ---


class _Times(NamedTuple):
    """Ascending times [s] and their rows, where the largest gap begins, and what is to be known."""

    t: Vector
    rows: Sequence[int]
    restart: tuple[float, str] | None
    notes: tuple[str, ...]
    time_ns: Nanoseconds  # none, where they are not whole


def _times(table: DataTable, clock: Header, form: FieldForm, *, jumps: bool) -> _Times:
    """Return the times of the rows that count.

    Raises
    ------
    UsageError
        If there are none, they do not ascend, or have no unit of time.
    """
    stamps = table.times(clock.position)
    own = clock.stamp_unit
    if own is not None and form.time_unit is not None:
        raise UsageError(
            f"{table.label}: column {clock.name!r}: expected numbers, as time_unit is "
            f"{form.time_unit!r}, got dates or durations, which have their unit; leave out "
            "time_unit"
        )
    way_out = "select another column by time, another unit by time_unit"
    second = second_of(table.label, clock, own or form.time_unit, way_out)
    if not stamps:
        raise UsageError(f"{table.label}: expected rows of numbers, got none")
    same_time = form.same_time or table.same_time
    is_last = [after != before for before, after in pairwise(stamps)]
    repeated = is_last.count(False)
    rows: Sequence[int] = range(len(stamps))
    notes: tuple[str, ...] = ()
    if repeated and jumps:
        found = f"{repeated} of {len(stamps)} rows have the time of the row before, as at a jump"
        notes = (f"{table.label}: {found}",)
    elif repeated and same_time == "spread":
        stamps = _spread(table.label, stamps)
    elif repeated and same_time == "last":
        dropped = f"{repeated} of {len(stamps)} rows dropped: a later one has the same time"
        notes = (f"{table.label}: {dropped}",)
        rows = np.flatnonzero([*is_last, True]).tolist()
        stamps = [stamps[row] for row in rows]
    zero = stamps[0] if form.offset == "first" else Decimal(repr(form.offset or 0))
    exact = [(stamp - zero) * second for stamp in stamps]
    seconds = list(map(float, exact))
    _check_increasing(table, exact if jumps else seconds, rows, jumps=jumps)
    t = np.array(seconds)
    time_ns = _whole_ns(table, exact) if jumps else np.empty(0, np.int64)
    restart = None
    if len(stamps) > 1:
        gap = int(np.argmax(np.diff(t)))
        restart = (seconds[gap], offset_text(stamps[gap + 1]))
    unit = own or clock.time_unit
    reason = "the default" if unit is None else "of dates or durations" if own else "of the column"
    table.tell("time unit", form.time_unit or unit or "s", reason, "time_unit", form.time_unit)
    origin = "the first time stamp" if form.offset == "first" else str(form.offset or 0)
    table.tell("t = 0", origin, 'the default, or "first"', "offset", form.offset)
    if repeated:
        found = f"{repeated} rows have the time of the one before"
        table.tell("same time", found, str(same_time), "same_time")
    return _Times(t, rows, restart, notes, time_ns)


def _whole_ns(table: DataTable, exact: Sequence[Decimal]) -> Nanoseconds:
    """Return times in s as whole ns.

    Raises
    ------
    UsageError
        If one has too many digits, or two that differ are less than 1 ns apart.
    """
    if max(map(abs, exact)) * NANOSECONDS >= _MOST_NS:
        raise UsageError(
            f"{table.label}: expected times within 292 years of 0, got {max(exact, key=abs)} s"
        )
    time_ns = [round(time * NANOSECONDS) for time in exact]
    for row, (before, after) in enumerate(pairwise(exact)):
        if before != after and time_ns[row] == time_ns[row + 1]:
            raise UsageError(
                f"{table.label}, {table.place(row + 1)}: expected times at least 1 ns apart, got "
                f"{after} s after {before} s"
            )
    return np.array(time_ns, np.int64)


def _check_increasing(
    table: DataTable, seconds: Sequence[Decimal | float], rows: Sequence[int], *, jumps: bool
) -> None:
    for number, (before, t) in enumerate(pairwise([-math.inf, *seconds])):
        if before < t < math.inf or (jumps and before == t):
            continue
        way_out = "select another column by time"
        if t == before:
            way_out += (
                ', or samples of one time stamp by same_time: "spread" spreads them evenly up '
                'to the next one, "last" takes the last'
            )
        place = f"in {table.place(rows[number - 1])}" if number else "the beginning"
        raise UsageError(
            f"{table.label}, {table.place(rows[number])}: expected increasing times, got {t} s "
            f"after {before} s {place}; {way_out}"
        )


def _spread(label: str, stamps: Sequence[Decimal]) -> list[Decimal]:
    """Return time stamps of which equal ones are spread evenly up to the next other one.

    The recording may begin and end between two of them: fewer samples than their neighbors have
    are as far apart as these.
    """
    groups = [(stamp, len(list(group))) for stamp, group in groupby(stamps)]
    if len(groups) < 2:
        raise UsageError(f"{label}: expected at least two different time stamps, got one")
    starts = [stamp for stamp, _ in groups]
    counts = [count for _, count in groups]
    gaps = [after - before for before, after in pairwise(starts)]
    distances = [gap / count for gap, count in zip(gaps, counts, strict=False)]
    last = distances[-1]
    if counts[-1] > counts[-2]:
        last = last * counts[-2] / counts[-1]
    distances.append(last)
    if len(groups) > 2 and counts[0] < counts[1]:
        distances[0] = min(distances[0], distances[1])
        starts[0] = starts[1] - counts[0] * distances[0]
    spread: list[Decimal] = []
    for start, distance, count in zip(starts, distances, counts, strict=True):
        spread += [start + number * distance for number in range(count)]
    return spread


# --- fields of messages ---


def read_samples(form: FieldForm, path: Path, fields: Iterable[str]) -> SamplesByField:
    """Read fields of the messages in an MCAP file, in one pass.

    Raises
    ------
    UsageError
        If the file or a field cannot be read, or the unit is none of time.
    """
    from cosim.log.foreign.samples import LOG_TIME, read_fields  # rarely needed

    unit = _unit_ns(f"file {str(path)!r}", form.time_unit)
    names = list(dict.fromkeys(fields))
    found = read_fields(path, names, time=form.time or LOG_TIME, time_unit_ns=unit)
    return dict(zip(names, found, strict=True))


def message_data(
    form: FieldForm,
    path: Path,
    columns: Mapping[str, Sequence[str]],
    read: Callable[[], SamplesByField],
) -> FieldData:
    """Return fields of messages as signals.

    Parameters
    ----------
    form : FieldForm
        Its offset is in its unit of time; None: "first".
    path : Path
    columns : mapping of signal to fields
        Which are its elements, one behind the other.
    read : callable
        Returns the samples of at least these fields; with ``"first"`` all have one at t = 0.

    Raises
    ------
    UsageError
        If no field is asked for, the times are too far from the offset, or there are too many.
    """
    label = f"file {str(path)!r}"
    if form.same_time not in (None, "last"):
        raise UsageError(f'{label}: same_time: expected "last" of messages, got {form.same_time!r}')
    if not columns:
        raise UsageError(
            f"{label}: expected a map, {option('map', 'PORT', '/topic.field')}, or columns = "
            "{ y = \"/topic.field\" }, got neither; 'cosim info' lists the fields"
        )
    samples = read()
    unit_ns = _unit_ns(label, form.time_unit)
    if form.offset is None or form.offset == "first":
        zero_ns = max(_first_measured(found) for found in samples.values())
    else:
        zero_ns = round(Decimal(repr(form.offset)) * unit_ns)
    used = [samples[name] for name in chain.from_iterable(columns.values())]
    time_ns = np.unique(np.concatenate([found.time_ns for found in used]))
    first, last = [int(time_ns[place]) - zero_ns for place in (0, -1)]
    if max(map(abs, (first, last, zero_ns))) >= _MOST_NS:
        raise UsageError(
            f"{label}: expected times within 2**63 ns of the offset, got {first} ns to {last} ns; "
            'use offset = "first"'
        )
    width = sum(found.values.shape[1] for found in used)
    if len(time_ns) * width > MOST_VALUES:
        raise UsageError(
            f"{label}: expected at most {MOST_VALUES} numbers, got {width} at {len(time_ns)} "
            "times; use fewer fields or a shorter file"
        )
    t = (time_ns - zero_ns) / 1e9
    signals = []
    discrete = []
    for name, fields in columns.items():
        found = [samples[field] for field in fields]
        values = np.hstack([_at_times(one, time_ns) for one in found])
        values = _without_codes(values, form.missing)
        signals.append(FieldSignal(name, None, values, tuple(fields)))
        if any(one.is_discrete for one in found):
            discrete.append(name)
    spacings = {found.topic: found.spacing for found in used}
    notes = [_note(label, topic, spacing, zero_ns) for topic, spacing in spacings.items()]
    gap = int(np.argmax(np.diff(time_ns))) if len(time_ns) > 1 else 0
    after_gap = Decimal(int(time_ns[min(gap + 1, len(time_ns) - 1)]))
    end_ns = max(found.end_ns for found in samples.values())
    return FieldData(
        label,
        t,
        tuple(signals),
        tuple(filter(None, notes)),
        zero_ns,
        tuple(discrete),
        end=(end_ns - zero_ns) / NANOSECONDS,
        restart=(float(t[gap]), offset_text(after_gap / unit_ns)),
    )


def _unit_ns(label: str, name: str | None) -> int:
    """Return a unit of time in ns."""
    seconds = seconds_in(name or "s")
    unit = Decimal(repr(seconds or 0.0)) * NANOSECONDS
    if unit < 1 or unit != unit.to_integral_value():
        raise UsageError(
            f"{label}: time_unit: expected a unit of time of whole ns, such as ms, got {name!r}"
        )
    return int(unit)


def _first_measured(found: FieldSamples) -> int:
    """Return the first time at which every element of a field has had a value."""
    is_measured = np.isfinite(found.values)
    if not is_measured.any(axis=0).all():
        return int(found.time_ns[0])  # who needs that element says that it is never measured
    return int(found.time_ns[is_measured.argmax(axis=0).max()])


def _at_times(found: FieldSamples, time_ns: Instants) -> Matrix:
    """Return the values of a field at all times, NaN where it has none."""
    values = np.full((len(time_ns), found.values.shape[1]), NAN)
    values[np.searchsorted(time_ns, found.time_ns)] = found.values
    return values


def _note(label: str, topic: str, spacing: Spacing, zero_ns: int) -> str:
    """Return what is to be known of the messages of a topic; empty: nothing."""
    texts = [spacing.disorder_text()]
    if spacing.largest_ns > _LONG_GAP * spacing.median_ns:
        begin = (spacing.largest_at_ns - zero_ns) / 1e9
        texts.append(
            f"the largest gap is {spacing.largest_ns / 1e9:g} s, from t = {begin:g} s on, the "
            f"median distance {spacing.median_ns / 1e9:g} s"
        )
    text = "; ".join(filter(None, texts))
    return f"{label}, topic {topic!r}: {text}" if text else ""
