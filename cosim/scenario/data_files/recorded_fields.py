"""Field data from an MCAP file of another tool: fields of its messages as signals.

The times of the messages are whole ns, and stay so until the one that is t = 0 is subtracted. With
``offset = "first"`` that is the first instant by which every field that is taken has a sample: at
t = 0 all is measured, and of several components from one file all have the same t = 0.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from decimal import Decimal
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeAlias

import numpy as np

from cosim.arrays import NAN, Matrix, Vector
from cosim.blocks.field_data import FieldData, FieldSignal
from cosim.errors import UsageError, option
from cosim.instants import NANOSECONDS
from cosim.scenario.data_files.headers import is_number, seconds_in
from cosim.scenario.data_files.table import FieldForm

if TYPE_CHECKING:
    from cosim.log.foreign.samples import FieldSamples
    from cosim.log.foreign.spacing import Instants, Spacing

MCAP: Final = ".mcap"
MOST_NS: Final = 2**63
MOST_VALUES: Final = 2**26  # of all signals at all times
NANOSECOND: Final = Decimal("1e-9")  # s
LONG_GAP: Final = 2  # median distances that are worth a word

SamplesByField: TypeAlias = "Mapping[str, FieldSamples]"


def read_samples(path: Path, fields: Iterable[str], form: FieldForm) -> SamplesByField:
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


def check_asked(path: Path, columns: Mapping[str, Sequence[str]], same_time: str | None) -> None:
    """Check that some field of a file is asked for, and of messages of one time the last.

    Raises
    ------
    UsageError
        If that is not so.
    """
    if same_time not in (None, "last"):
        raise UsageError(
            f'file {str(path)!r}: same_time: expected "last" of messages, got {same_time!r}'
        )
    if columns:
        return
    map_option = option("map", "PORT", "/topic.field")
    raise UsageError(
        f"file {str(path)!r}: expected a map, {map_option}, or columns = "
        "{ y = \"/topic.field\" }, got neither; 'cosim info' lists the fields"
    )


def recorded_data(
    path: Path,
    columns: Mapping[str, Sequence[str]],
    samples: SamplesByField,
    form: FieldForm,
) -> FieldData:
    """Return fields of messages as signals.

    Parameters
    ----------
    path : Path
    columns : mapping of signal to fields
        Which are its elements, one behind the other.
    samples : mapping of field to FieldSamples
        At least of these; with ``"first"`` all of them have a sample at t = 0.
    form : FieldForm
        Its offset is in its unit of time; None: "first".

    Raises
    ------
    UsageError
        If the times are too far from the offset, or there are too many of them.
    """
    label = f"file {str(path)!r}"
    if form.offset is None or form.offset == "first":
        offset_ns = max(_first_measured(found) for found in samples.values())
    else:
        offset_ns = round(Decimal(repr(form.offset)) * _unit_ns(label, form.time_unit))
    used: list[FieldSamples] = []
    for fields in columns.values():
        used += [samples[name] for name in fields]
    time_ns = np.unique(np.concatenate([found.time_ns for found in used]))
    width = sum(found.values.shape[1] for found in used)
    if len(time_ns) * width > MOST_VALUES:
        raise UsageError(
            f"{label}: expected at most {MOST_VALUES} numbers, got {width} at {len(time_ns)} "
            "times; use fewer fields or a shorter file"
        )
    t = _seconds_since(label, time_ns, offset_ns)
    signals = []
    for name, fields in columns.items():
        parts = [_spread(samples[field], time_ns) for field in fields]
        values = without_codes(np.hstack(parts), form.table.missing)
        signals.append(FieldSignal(name, None, values, tuple(fields)))
    spacings = {found.topic: found.spacing for found in used}
    notes = [_note(label, topic, spacing, offset_ns) for topic, spacing in spacings.items()]
    diagnostics = tuple(note for note in notes if note)
    discrete = []
    for name, fields in columns.items():
        if any(samples[field].is_discrete for field in fields):
            discrete.append(name)
    end_ns = max(found.end_ns for found in samples.values())
    gap = int(np.argmax(np.diff(time_ns))) if len(time_ns) > 1 else 0
    after_gap = Decimal(int(time_ns[min(gap + 1, len(time_ns) - 1)]))
    return FieldData(
        label,
        t,
        tuple(signals),
        diagnostics,
        offset_ns,
        tuple(discrete),
        end=(end_ns - offset_ns) / NANOSECONDS,
        restart=(float(t[gap]), offset_text(after_gap / _unit_ns(label, form.time_unit))),
    )


def without_codes(values: Matrix, missing: Sequence[float | str]) -> Matrix:
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


def _unit_ns(label: str, name: str | None) -> int:
    """Return a unit of time in ns."""
    seconds = seconds_in(name or "s")
    if seconds is not None:
        unit = Decimal(repr(seconds)) / NANOSECOND
        if unit >= 1 and unit == unit.to_integral_value():
            return int(unit)
    raise UsageError(
        f"{label}: time_unit: expected a unit of time of whole ns, such as ms, got {name!r}"
    )


def _first_measured(found: FieldSamples) -> int:
    """Return the first time at which every element of a field has had a value."""
    is_measured = np.isfinite(found.values)
    if not is_measured.any(axis=0).all():
        return int(found.time_ns[0])  # who needs that element says that it is never measured
    return int(found.time_ns[is_measured.argmax(axis=0).max()])


def _seconds_since(label: str, time_ns: Instants, offset_ns: int) -> Vector:
    """Return times since the offset [s].

    Raises
    ------
    UsageError
        If there are too many ns between them.
    """
    first = int(time_ns[0]) - offset_ns
    last = int(time_ns[-1]) - offset_ns
    if max(map(abs, (first, last, offset_ns))) >= MOST_NS:
        raise UsageError(
            f"{label}: expected times within 2**63 ns of the offset, got {first} ns to {last} ns; "
            'use offset = "first"'
        )
    seconds: Vector = (time_ns - offset_ns) / 1e9
    return seconds


def _spread(found: FieldSamples, time_ns: Instants) -> Matrix:
    """Return the values of a field at all times, NaN where it has none."""
    values = np.full((len(time_ns), found.values.shape[1]), NAN)
    values[np.searchsorted(time_ns, found.time_ns)] = found.values
    return values


def _note(label: str, topic: str, spacing: Spacing, offset_ns: int) -> str:
    """Return what is to be known of the messages of a topic; empty: nothing."""
    texts = []
    disorder = spacing.disorder_text()
    if disorder:
        texts.append(disorder)
    if spacing.largest_ns > LONG_GAP * spacing.median_ns:
        begin = (spacing.largest_at_ns - offset_ns) / 1e9
        texts.append(
            f"the largest gap is {spacing.largest_ns / 1e9:g} s, from t = {begin:g} s on, the "
            f"median distance {spacing.median_ns / 1e9:g} s"
        )
    return f"{label}, topic {topic!r}: {'; '.join(texts)}" if texts else ""
