"""A log as a file of another format: written under a hidden name, then moved to its own.

Tables join the signals on time, as :mod:`cosim.core.recorded.joined_rows` says; Parquet is written
a group of rows at a time. Every column holds doubles, null where a signal has no row; that of the
times, whole ns where doubles in s would round them. Unit, description and role of the signal are
metadata of its field. Dictionaries are not used: they would merge all NaN, and both zeros.

Files of arrays (npz, MAT) have every signal with the instants of its component. For npz the rows of
one component at a time are in memory, for MAT those of all. All of them are read again by
:func:`cosim.open_recording`.
"""

from __future__ import annotations

import io
import json
import re
import zipfile
from collections.abc import Callable, Container, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np
from numpy.lib.format import write_array

from cosim.arrays import Matrix, Vector
from cosim.core.recorded.joined_rows import TIME
from cosim.core.recording import joined
from cosim.errors import LogError, UsageError, optional_library, warn
from cosim.instants import NANOSECONDS
from cosim.log.files import UnfinishedLog
from cosim.log.text import LogChoice, csv_text, first_instant, signal_metadata
from cosim.units import units_text

TIME_KEY: Final = "t:"  # before a component's name; no signal has a name without a dot
SIGNALS_KEY: Final = "signals"
_NOT_DECLARED: Final = {"unit": "", "description": ""}  # a struct has all fields
_LONGEST_NAME: Final = 63  # of a MATLAB variable
_MOST_ROWS: Final = 2**16  # of a group of Parquet
_BUFFER_BYTES: Final = 2**20
_LATEST_IN_S: Final = 2**22 * NANOSECONDS  # ns; up to 49 days doubles in s tell all ns apart


def convert(choice: LogChoice, out: Path, *, force: bool = False) -> list[str]:
    """Write signals to a file, in the format that its ending names; return what it warns of.

    Parameters
    ----------
    choice : LogChoice
    out : Path
        Ends in .csv, .parquet, .mat or .npz.
    force : bool
        Replace an existing file.

    Raises
    ------
    UsageError
        If its ending is not that of a known format, a library for that is missing, or an array is
        too large for MAT.
    LogError
        If the log is damaged, or a file exists and is not to be replaced, or cannot be written.
    """
    write = _WRITERS.get(out.suffix.lower())
    if write is None:
        found = repr(out.suffix) if out.suffix else "none"
        raise UsageError(
            f"{out}: expected a file extension among {', '.join(_WRITERS)}, got {found}"
        )
    if write is write_parquet:
        _arrow()
    notes = []
    if write in (write_npz, write_mat) and not _is_exact_in_s(choice):
        notes = [f"{out}: times are rounded to doubles in s; .csv and .parquet have their ns"]
    target = UnfinishedLog(out, force=force)
    target.check_free()
    try:
        with io.BufferedWriter(target.create(), _BUFFER_BYTES) as stream:
            write(stream, choice)
        target.publish()
    except OSError as error:
        raise LogError(f"{out} cannot be written: {error.strerror or error}") from error
    finally:
        target.discard()
    warn(notes)
    return notes


def write_csv(stream: BinaryIO, choice: LogChoice) -> None:
    """Write the signals as a table of text."""
    for text in csv_text(choice):
        stream.write(text.encode())


def _arrow() -> Any:
    return optional_library("pyarrow", "Parquet files need", "parquet")


def write_parquet(stream: BinaryIO, choice: LogChoice) -> None:
    """Write the signals as a table."""
    arrow = _arrow()
    from pyarrow import parquet

    is_in_s = _is_exact_in_s(choice)
    kind, unit = (arrow.float64(), "s") if is_in_s else (arrow.int64(), "ns")
    fields = [arrow.field(TIME, kind, nullable=False, metadata={"unit": unit})]
    for column in choice.columns:
        about = signal_metadata(column.signal, column.unit)
        fields.append(arrow.field(column.name, arrow.float64(), metadata=about))
    about = {"source": choice.run.label, "status": choice.run.status}
    schema = arrow.schema(fields, metadata=about)
    options = {"compression": "zstd", "use_dictionary": False, "use_byte_stream_split": True}
    with parquet.ParquetWriter(stream, schema, **options) as writer:
        for part in choice.joined():
            for begin in range(0, len(part), _MOST_ROWS):
                rows = part.part(begin, begin + _MOST_ROWS)
                times = rows.time_ns / NANOSECONDS if is_in_s else rows.time_ns
                arrays = [arrow.array(times)]
                for number, values in enumerate(np.ascontiguousarray(rows.values.T)):
                    missing = None if rows.missing is None else rows.missing[:, number]
                    arrays.append(arrow.array(values, mask=missing, from_pandas=False))
                writer.write_batch(arrow.record_batch(arrays, schema=schema))


def _is_exact_in_s(choice: LogChoice) -> bool:
    """Return whether a double has every time in s to the ns, as it has not since 1970."""
    return max(abs(first_instant(choice.run) or 0), abs(choice.run.end_ns)) < _LATEST_IN_S


def _by_component(choice: LogChoice) -> Iterator[tuple[str, Vector, dict[str, Matrix]]]:
    """Yield each component, its instants [s], and the values of its chosen signals."""
    names: dict[str, list[str]] = {}
    for name, port in choice.selection.items():
        names.setdefault(port.channel.name, []).append(name)
    for component, own in names.items():
        time_ns, rows = joined(choice.run.blocks(component))
        values = {
            name: np.ascontiguousarray(rows[:, choice.selection[name].columns]) for name in own
        }
        yield component, time_ns / NANOSECONDS, values


def _about(choice: LogChoice) -> dict[str, dict[str, str]]:
    """Return what each chosen signal is, as far as that is declared."""
    return {
        name: signal_metadata(port.described, units_text(port.measures))
        for name, port in choice.selection.items()
    }


def write_npz(stream: BinaryIO, choice: LogChoice) -> None:
    """Write arrays as ``numpy.load`` reads them.

    ``"plant.y"`` has the values, ``"t:plant"`` the instants of the component [s], ``"signals"`` a
    JSON text with unit, description, role, variability and type by name.
    """
    with zipfile.ZipFile(stream, "w", allowZip64=True) as archive:

        def write(name: str, array: Any) -> None:
            entry = zipfile.ZipInfo(f"{name}.npy")  # without a date: equal logs give equal files
            with archive.open(entry, "w", force_zip64=True) as file:
                write_array(file, array, allow_pickle=False)

        write(SIGNALS_KEY, np.array(json.dumps(_about(choice))))
        for component, times, signals in _by_component(choice):
            write(f"{TIME_KEY}{component}", times)
            for name, values in signals.items():
                write(name, values[:, 0] if values.shape[1] == 1 else values)


def write_mat(stream: BinaryIO, choice: LogChoice) -> None:
    """Write arrays as MATLAB and ``scipy.io.loadmat`` read them (MAT 5).

    ``plant_y`` has the values, ``t_plant`` the instants of the component [s]. The struct array
    ``signals`` tells for each signal its ``name``, the ``variable`` that has it, that of its
    ``time``, and its unit, description, role, variability and type.

    Raises
    ------
    UsageError
        If an array is larger than the format can hold.
    """
    from scipy.io import savemat
    from scipy.io.matlab import MatWriteError

    variables: dict[str, Any] = {SIGNALS_KEY: None}
    about = {name: _NOT_DECLARED | own for name, own in _about(choice).items()}
    for component, times, signals in _by_component(choice):
        time_name = _legal_name(f"t_{component}", variables)
        variables[time_name] = times
        for name, values in signals.items():
            variable = _legal_name(name, variables)
            variables[variable] = values
            about[name] = {"name": name, "variable": variable, "time": time_name} | about[name]
    fields = list(next(iter(about.values())))
    table = np.empty((len(about), 1), [(key, object) for key in fields])
    for row, own in enumerate(about.values()):
        table[row, 0] = tuple(own[key] for key in fields)
    variables[SIGNALS_KEY] = table
    try:
        savemat(stream, variables, long_field_names=True, oned_as="column")
    except MatWriteError as error:
        raise UsageError(f"MAT files are limited to 4 GB per array ({error}); use npz") from error


def _legal_name(text: str, taken: Container[str]) -> str:
    """Return a name for a MATLAB variable that says what it has, and is no other's."""
    name = re.sub(r"[^A-Za-z0-9_]", "_", text)
    if not name[0].isalpha():
        name = f"s{name}"
    candidate = name[:_LONGEST_NAME]
    number = 2
    while candidate in taken:
        suffix = f"_{number}"
        candidate = f"{name[: _LONGEST_NAME - len(suffix)]}{suffix}"
        number += 1
    return candidate


_WRITERS: Final[Mapping[str, Callable[[BinaryIO, LogChoice], None]]] = {
    ".csv": write_csv,
    ".parquet": write_parquet,
    ".mat": write_mat,
    ".npz": write_npz,
}
ENDINGS: Final = tuple(_WRITERS)
