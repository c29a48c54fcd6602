"""Field data: samples with times of their own, from tables and MCAP files.

The names of the columns say what these are, with their units: ``t [ms]``, ``y [mm]``, ``x_a[0]``,
``x_a[1]``; :mod:`~cosim.scenario.data_files.tables` says where the names and further units stand.
The times are the index that pandas wrote, where its name or
type is that of times; else the column of a name such as ``t``, ``time`` or ``Timestamp``, else the
one in a unit of time, else the one of time stamps; else the index or the first one, which is said.
Times are numbers, dates (ISO 8601) or durations as pandas writes them (``0 days 00:00:00.02``). An
empty cell and NaN say that nothing was measured; all else that is no finite number is refused, and
so are times that do not ascend. The offset of the times is subtracted before they are rounded: a
time stamp in ns since 1970 has more digits than a double.

A message tells where a file is wrong, and of what stands there only the times.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from decimal import Decimal
from itertools import chain, groupby, pairwise
from pathlib import Path
from typing import Final

import numpy as np

from cosim.arrays import Vector
from cosim.blocks.field_data import FieldData, FieldSignal, elements_named
from cosim.errors import UsageError, warn
from cosim.files import expanded
from cosim.scenario.data_files.headers import Header, find_headers, second_of, unit_of
from cosim.scenario.data_files.recorded_fields import (
    MCAP,
    check_asked,
    offset_text,
    read_samples,
    recorded_data,
    without_codes,
)
from cosim.scenario.data_files.table import DataTable, FieldForm, SameTime, TableForm, TimeOffset
from cosim.scenario.data_files.tables import read_table

SPREAD: Final = "spread"


def read_field_data(
    path: str | Path,
    *,
    time: str | None = None,
    time_unit: str | None = None,
    offset: TimeOffset | None = None,
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
    if isinstance(missing, str):  # a sequence too, of letters
        raise UsageError(f"missing: expected a list of numbers and texts, got {missing!r}")
    form = FieldForm(
        time=time,
        time_unit=time_unit,
        offset=offset,
        same_time=same_time,
        columns=columns,
        table=TableForm(separator, decimal, skip, comment, tuple(missing), sheet),
    )
    data = field_data(path, form)
    warn(data.diagnostics)
    return data


def field_data(
    path: str | Path, form: FieldForm | None = None, *, unread: dict[str, str] | None = None
) -> FieldData:
    """Read samples as :func:`read_field_data` does; whoever takes them shows their diagnostics.

    ``unread`` takes the signals that cannot be read, and why, where that shall be no error.
    """
    path = expanded(path)
    form = form or FieldForm()
    if path.suffix.lower() == MCAP:
        fields = listed_columns(form.columns or {})
        check_asked(path, fields, form.same_time)
        samples = read_samples(path, chain.from_iterable(fields.values()), form)
        return recorded_data(path, fields, samples, form)
    table = read_table(path, form.table)
    named = [header for header in table.headers if header.text]
    clock, reason, notes = _clock(table, named, form)
    table.tell("times", repr(clock.name) if clock.name else "index", reason, "time", form.time)
    chosen = _signals(table.label, named, clock, form.columns)
    stamps = _Stamps(table, clock, form)
    signals = []
    for name, parts in chosen.items():
        try:
            columns_of = [table.values(part.position) for part in parts]
        except UsageError as error:
            if unread is None:
                raise
            unread[name] = str(error).removeprefix(f"{table.label}, ")
            continue
        stacked = without_codes(np.stack(columns_of, axis=1)[stamps.rows], form.table.missing)
        unit = unit_of(table.label, name, parts)
        signals.append(FieldSignal(name, unit, stacked, tuple(part.text for part in parts)))
    return FieldData(
        table.label,
        stamps.t,
        tuple(signals),
        (*notes, *stamps.notes),
        restart=stamps.restart,
        reading=tuple(table.reading),
    )


def listed_columns(columns: Mapping[str, str | Sequence[str]]) -> dict[str, list[str]]:
    """Return the columns of every signal as a list.

    Raises
    ------
    UsageError
        If a signal has none.
    """
    listed = {}
    for name, wanted in columns.items():
        listed[name] = [wanted] if isinstance(wanted, str) else list(wanted)
    if not all(listed.values()):
        raise UsageError(f"columns: expected a column for each signal, got {dict(columns)}")
    return listed


# --- what the columns are ---


def _clock(
    table: DataTable, named: Sequence[Header], form: FieldForm
) -> tuple[Header, str, tuple[str, ...]]:
    """Return the column of the times, why it is that, and what is to be known of it.

    Raises
    ------
    UsageError
        If several may be it.
    """
    if form.time is not None:
        (clock,) = find_headers(table.label, named, [form.time])
        return clock, "", ()
    unnamed = [
        header for header in table.headers if not header.text and header.position in table.index
    ]
    candidates = _candidates(table, named, unnamed)
    if len(candidates) > 1:
        names = ", ".join(repr(header.name) for header in candidates)
        way_out = "select one by time"
        if any(header.has_dates for header in candidates):
            way_out = (
                "write date and time of day into one, such as 2024-03-01T12:00:00, or select one "
                "by time and the signals by columns"
            )
        raise UsageError(f"{table.label}: expected one column of times, got {names}; {way_out}")
    if candidates:
        clock = candidates[0]
        is_named = clock.times is not None or clock.time_unit is not None
        return clock, "says so by its name or unit" if is_named else "has dates or durations", ()
    index = [header for header in named if header.position in table.index]
    clock = [*unnamed, *index, *named][0]
    where = "the index that pandas wrote" if clock.position in table.index else "the first column"
    name = f", {clock.name!r}" if clock.name else ""
    unit = form.time_unit or "s"
    note = (
        f"{table.label}: the times are those of {where}{name}, in {unit}, as no column says that "
        "it has times, by a name such as t or time, a unit of time or dates; time selects another"
    )
    return clock, "no column says that it has times", (note,)


def _candidates(
    table: DataTable, named: Sequence[Header], unnamed: Sequence[Header]
) -> list[Header]:
    """Return the columns that say of themselves that they have times, in the first way."""
    everything = [*unnamed, *named]
    stamps = [header for header in everything if header.position in table.stamps]
    timed = [header for header in named if header.time_unit is not None]
    called = []
    for header in named:
        is_number = header.has_dates and header.position in table.numbers
        if header.times is not None and not is_number:
            called.append(header)
    of_times = {header.position for header in (*called, *timed, *stamps)} & table.index
    index = [header for header in everything if header.position in of_times]
    return index or called or timed or stamps


def _signals(
    label: str,
    named: Sequence[Header],
    clock: Header,
    columns: Mapping[str, str | Sequence[str]] | None,
) -> dict[str, list[Header]]:
    """Return the columns of every signal."""
    if columns is None:
        others = [header for header in named if header != clock]
        own = {header.name: header for header in others}
        for name, count in Counter(header.name for header in others).most_common(1):
            if count > 1:
                raise UsageError(f"{label}: expected a unique column {name!r}, got {count}")
        groups = elements_named(list(own)).items()
        return {name: [own[part] for part in parts] for name, parts in groups}
    if not columns:
        raise UsageError("columns: expected a column for each signal, got {}")
    listed = listed_columns(columns).items()
    return {name: find_headers(label, named, parts) for name, parts in listed}


# --- times ---


class _Stamps:
    """The times of the rows that count.

    ``t`` [s] ascends, ``rows`` are those rows, ``restart`` where the largest gap begins [s] and the
    offset by which t = 0 is behind it.
    """

    def __init__(self, table: DataTable, clock: Header, form: FieldForm) -> None:
        offset = form.offset
        same_time = form.same_time or table.same_time
        stamps = table.times(clock.position)
        second = _second(table, clock, form.time_unit)
        if not stamps:
            raise UsageError(f"{table.label}: expected rows of numbers, got none")
        infinite = next((row for row, stamp in enumerate(stamps) if not stamp.is_finite()), None)
        if infinite is not None:
            raise UsageError(
                f"{table.label}, {table.place(infinite)}: expected a finite time, got "
                f"{float(stamps[infinite])!r} s"
            )
        self.notes: tuple[str, ...] = ()
        repeated = sum(after == before for before, after in pairwise(stamps))
        self.rows = np.arange(len(stamps))
        if repeated and same_time == SPREAD:
            stamps = _spread(table.label, stamps)
        elif repeated and same_time is not None:
            is_last = [after != before for before, after in pairwise(stamps)]
            self.rows = np.flatnonzero([*is_last, True])
            stamps = [stamps[row] for row in self.rows]
            self.notes = (
                f"{table.label}: {repeated} of {len(stamps) + repeated} rows dropped: a later one "
                "has the same time",
            )
        zero = stamps[0] if offset == "first" else Decimal(repr(offset or 0))
        seconds = [float((stamp - zero) * second) for stamp in stamps]
        self.t: Vector = np.array(seconds)
        self._check_increasing(table, seconds)
        self.restart: tuple[float, str] | None = None
        if len(stamps) > 1:
            gap = int(np.argmax(np.diff(self.t)))
            self.restart = (seconds[gap], offset_text(stamps[gap + 1]))
        own = table.stamp_unit(clock.position) or clock.time_unit
        reason = "the default"
        if own is not None:
            reason = "of dates or durations" if clock.position in table.stamps else "of the column"
        unit = form.time_unit
        table.tell("time unit", unit or own or "s", reason, "time_unit", unit)
        origin = "the first time stamp" if offset == "first" else str(offset or 0)
        table.tell("t = 0", origin, 'the default, or "first"', "offset", offset)
        if repeated:
            found = f"{repeated} rows have the time of the one before"
            table.tell("same time", found, str(same_time), "same_time")

    def _check_increasing(self, table: DataTable, seconds: Sequence[float]) -> None:
        for number, t in enumerate(seconds):
            is_after = number == 0 or t > seconds[number - 1]
            if is_after and math.isfinite(t):
                continue
            place = table.place(int(self.rows[number]))
            if not math.isfinite(t):
                raise UsageError(f"{table.label}, {place}: expected a finite time, got {t!r} s")
            way_out = "select another column by time"
            if t == seconds[number - 1]:
                way_out += (
                    ', or samples of one time stamp by same_time: "spread" spreads them evenly up '
                    'to the next one, "last" takes the last'
                )
            raise UsageError(
                f"{table.label}, {place}: expected increasing times, got {t!r} s after "
                f"{seconds[number - 1]!r} s in {table.place(int(self.rows[number - 1]))}; {way_out}"
            )


def _second(table: DataTable, clock: Header, unit: str | None) -> Decimal:
    """Return the unit of the times in s."""
    own = table.stamp_unit(clock.position)
    if own is not None and unit is not None:
        raise UsageError(
            f"{table.label}: column {clock.name!r}: expected numbers, as time_unit is {unit!r}, "
            "got dates or durations, which have their unit; leave out time_unit"
        )
    way_out = "select another column by time, another unit by time_unit"
    return second_of(table.label, clock, own or unit, way_out)


def _spread(label: str, stamps: Sequence[Decimal]) -> list[Decimal]:
    """Return time stamps of which equal ones are spread evenly up to the next other one.

    The recording may begin and end between two of them: fewer samples than their neighbors have
    are as far apart as these.
    """
    groups = [(stamp, len(list(group))) for stamp, group in groupby(stamps)]
    if len(groups) < 2:
        raise UsageError(f"{label}: expected at least two different time stamps, got one")
    distances = []
    for (stamp, count), (after, _) in pairwise(groups):
        distances.append((after - stamp) / count)
    first_count = groups[0][1]
    begin, end = groups[0][0], groups[1][0]
    if len(groups) > 2 and first_count < groups[1][1]:
        distances[0] = min(distances[0], distances[1])
        begin = end - first_count * distances[0]
    last_distance = distances[-1]
    if groups[-1][1] > groups[-2][1]:
        last_distance = last_distance * groups[-2][1] / groups[-1][1]
    distances.append(last_distance)
    starts = [begin, *(stamp for stamp, _ in groups[1:])]
    spread: list[Decimal] = []
    for start, distance, (_, count) in zip(starts, distances, groups, strict=True):
        spread += [start + number * distance for number in range(count)]
    return spread
