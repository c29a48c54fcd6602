"""Tables as text: CSV and JSON Lines, a few rows at a time.

A number is the shortest text that reads back as the same double, a time an exact decimal. The first
line of CSV has the units, as in the tables of samples that cosim reads; a cell is empty where a
component has no row. In JSON Lines the name is omitted there, and values without a number in JSON
are texts as in the JSON of protobuf: "NaN", "Infinity", "-Infinity".

The signals and the span of time that are chosen from a log.
"""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from typing import Final, Protocol, TypeAlias

import numpy as np

from cosim.arrays import Nanoseconds
from cosim.core.recorded.joined_rows import TIME, JoinedRows, joined_rows
from cosim.core.recorded.run import RecordedRun, RecordedWindow, span_ns
from cosim.core.recorded.selection import (
    SelectedColumn,
    select_signals,
    selected_columns,
    split_names,
)
from cosim.core.recorded.signals import RecordedPort
from cosim.core.signals import Signal
from cosim.errors import UsageError, nearest
from cosim.instants import NANOSECONDS, Seconds
from cosim.units import with_unit


@dataclass(frozen=True, slots=True)
class LogChoice:
    """Some signals of a run, or of a window of it.

    Parameters
    ----------
    run : RecordedRun
    selection : mapping of name to RecordedPort
    """

    run: RecordedRun
    selection: Mapping[str, RecordedPort]

    @staticmethod
    def of(run: RecordedRun, signals: Iterable[str] | str | None = None) -> LogChoice:
        """Choose signals of a run by names and patterns; None: all.

        Raises
        ------
        LogError
            If one of them chooses nothing.
        """
        return LogChoice(run, select_signals(run.channels, signals, source=run.label))

    @property
    def columns(self) -> tuple[SelectedColumn, ...]:
        """The elements of the signals, each once."""
        return selected_columns(self.selection)

    def joined(self) -> Iterator[JoinedRows]:
        """Yield the signals joined on time, some rows at a time."""
        return joined_rows(self.run, self.columns)


def signal_metadata(signal: Signal, unit: str | None) -> dict[str, str]:
    """Return what a signal, or an element in a unit, is, as far as that is declared."""
    metadata = {"unit": unit or "", "description": signal.description}
    metadata |= {"role": signal.role, "variability": signal.variability, "type": signal.type}
    return {key: text for key, text in metadata.items() if text}


def choose(
    run: RecordedRun, names: Iterable[str] | None, start: Seconds | None, stop: Seconds | None
) -> LogChoice:
    """Choose of a run what options of the command line say.

    Parameters
    ----------
    run : RecordedRun
    names : iterable of str, or None
        Names and patterns, several with commas between; None: all.
    start, stop : float, Decimal or None
        First and last time [s].

    Raises
    ------
    UsageError
        If ``start`` is after ``stop``.
    LogError
        If a signal is unknown.
    """
    span = span_ns(start, stop, names=("--from", "--to"))
    part = run if span == (None, None) else RecordedWindow(run, *span)
    return LogChoice.of(part, None if names is None else split_names(",".join(names)))


def first_instant(run: RecordedRun) -> int | None:
    """Return when the first row of a run is [ns]; None: it has no rows."""
    firsts = []
    for name in run.channels:
        blocks = (time_ns for time_ns, _ in run.blocks(name) if len(time_ns))
        firsts += [int(time_ns[0]) for time_ns in islice(blocks, 1)]
    return min(firsts, default=None)


def rows_text(run: RecordedRun) -> str:
    """Return from when to when a run has rows."""
    begin = first_instant(run)
    if begin is None:
        return "no rows at all"
    first, last = exact_seconds(np.array([begin, run.end_ns]))
    return f"rows from {first} s to {last} s"


_MOST_ROWS: Final = 4096  # that are text at a time


class TextSource(Protocol):
    """Signals joined on time."""

    @property
    def columns(self) -> tuple[SelectedColumn, ...]:
        """The elements of the signals, each once."""
        ...

    def joined(self) -> Iterator[JoinedRows]:
        """Yield their rows, some at a time."""
        ...


TextFormat: TypeAlias = Callable[[TextSource], Iterator[str]]


def csv_text(table: TextSource) -> Iterator[str]:
    """Yield a table as CSV, a few rows at a time."""
    header = [f"{TIME} [s]"]
    for column in table.columns:
        header.append(with_unit(column.name, column.unit))
    line = io.StringIO()
    csv.writer(line, lineterminator="\n").writerow(header)
    yield line.getvalue()
    for part in _short(table):
        cells = [exact_seconds(part.time_ns)]
        for number in range(part.values.shape[1]):
            cells.append(_shown(part, number, repr))
        lines = map(",".join, zip(*cells, strict=True))
        yield "\n".join(lines) + "\n"


def json_lines(table: TextSource) -> Iterator[str]:
    """Yield a table as JSON Lines, a few rows at a time."""
    entries = [_json_entry(column.name) for column in table.columns]
    for part in _short(table):
        texts = [[f'{{"{TIME}": {time}' for time in exact_seconds(part.time_ns)]]
        for number, entry in enumerate(entries):
            texts.append(_shown(part, number, entry))
        lines = map("".join, zip(*texts, strict=True))
        yield "}\n".join(lines) + "}\n"


def _json_entry(name: str) -> Callable[[float], str]:
    """Return what writes a value after those before it, with its name."""
    key = f", {json.dumps(name)}: "

    def entry(value: float) -> str:
        if math.isfinite(value):
            return f"{key}{value!r}"
        text = "NaN" if math.isnan(value) else f"{'-' if value < 0.0 else ''}Infinity"
        return f'{key}"{text}"'

    return entry


def _shown(part: JoinedRows, number: int, show: Callable[[float], str]) -> list[str]:
    """Return the values of a column as texts, empty where there is none."""
    values = part.values[:, number]
    if part.missing is None or not part.missing[:, number].any():
        return list(map(show, values.tolist()))
    texts = [""] * len(part)
    rows = np.flatnonzero(~part.missing[:, number])
    for row, value in zip(rows.tolist(), values[rows].tolist(), strict=True):
        texts[row] = show(value)
    return texts


def exact_seconds(time_ns: Nanoseconds) -> list[str]:
    """Return times as decimals of seconds, exactly; a double reads back the time [s] of a log."""
    texts = []
    for time in time_ns.tolist():
        whole, fraction = divmod(abs(time), NANOSECONDS)
        digits = f"{fraction:09d}".rstrip("0") or "0"
        texts.append(f"{'-' if time < 0 else ''}{whole}.{digits}")
    return texts


def _short(table: TextSource) -> Iterator[JoinedRows]:
    for part in table.joined():
        for begin in range(0, len(part), _MOST_ROWS):
            yield part.part(begin, begin + _MOST_ROWS)


_FORMATS: Final[dict[str, TextFormat]] = {"csv": csv_text, "jsonl": json_lines}


def table_text(table: TextSource, name: str) -> Iterator[str]:
    """Return an iterator over a table as text, in the format of a name.

    Raises
    ------
    UsageError
        If there is no such format.
    """
    if name not in _FORMATS:
        raise UsageError(f"--format: unknown format {name!r}; {nearest(name, _FORMATS)}")
    return _FORMATS[name](table)
