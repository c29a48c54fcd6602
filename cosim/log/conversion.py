"""A log as a file of another format: written under a hidden name, then moved to its own.

Tables join the signals on time, as :mod:`cosim.core.recorded.joined_rows` says; Parquet is written
a group of rows at a time. Every column holds doubles, null where a component has no row; unit,
description and role of the signal are metadata of its field. Dictionaries are not used: they would
merge all NaN, and both zeros.

Files of arrays (npz, MAT) have every signal with the instants of its component. For npz the rows of
one component at a time are in memory, for MAT those of all.
"""

from __future__ import annotations

import io
import json
import re
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np
from numpy.lib.format import write_array

from cosim.arrays import Matrix, Nanoseconds
from cosim.core.recorded.joined_rows import TIME, JoinedRows
from cosim.core.recorded.signals import RecordedPort
from cosim.errors import LogError, UsageError
from cosim.instants import NANOSECONDS
from cosim.log.files import UnfinishedLog
from cosim.log.text import LogChoice, csv_text, signal_metadata
from cosim.units import units_text

TIME_KEY: Final = "t:"  # before a component's name; no signal has a name without a dot
SIGNALS_KEY: Final = "signals"
_NOT_DECLARED: Final = {"unit": "", "description": ""}  # a struct has all fields
_LONGEST_NAME: Final = 63  # of a MATLAB variable


def write_npz(stream: BinaryIO, choice: LogChoice) -> None:
    """Write arrays as ``numpy.load`` reads them.

    ``"plant.y"`` has the values, ``"t:plant"`` the instants of the component [s], ``"signals"`` a
    JSON text with unit, description, role, variability and type by name.
    """
    with zipfile.ZipFile(stream, "w", allowZip64=True) as archive:
        about = {name: _metadata(port) for name, port in choice.selection.items()}
        _write_entry(archive, SIGNALS_KEY, np.array(json.dumps(about)))
        for component, names, time_ns, rows in _by_component(choice):
            _write_entry(archive, f"{TIME_KEY}{component}", time_ns / NANOSECONDS)
            for name in names:
                _write_entry(archive, name, _values(rows, choice.selection[name]))


def _write_entry(archive: zipfile.ZipFile, name: str, array: Any) -> None:
    entry = zipfile.ZipInfo(f"{name}.npy")  # with a constant date: equal logs give equal files
    with archive.open(entry, "w", force_zip64=True) as file:
        write_array(file, array, allow_pickle=False)


def write_mat(stream: BinaryIO, choice: LogChoice) -> None:
    """Write arrays as MATLAB and ``scipy.io.loadmat`` read them (MAT 5).

    ``plant_y`` has the values, ``t_plant`` the instants of the component [s]. The struct array
    ``signals`` tells for each signal its ``name``, the ``variable`` that has it, that of its
    ``time``, and its unit, description, role, variability
    and type.

    Raises
    ------
    UsageError
        If an array is larger than the format can hold.
    """
    from scipy.io import savemat
    from scipy.io.matlab import MatWriteError

    variables: dict[str, Any] = {SIGNALS_KEY: None}
    described: dict[str, dict[str, str]] = {}
    for component, names, time_ns, rows in _by_component(choice):
        time_name = _legal_name(f"t_{component}", variables)
        variables[time_name] = time_ns / NANOSECONDS
        for name in names:
            variable = _legal_name(name, variables)
            variables[variable] = _values(rows, choice.selection[name])
            own = {"name": name, "variable": variable, "time": time_name}
            described[name] = own | _NOT_DECLARED | _metadata(choice.selection[name])
    variables[SIGNALS_KEY] = _struct_array([described[name] for name in choice.selection])
    try:
        savemat(stream, variables, long_field_names=True, oned_as="column")
    except MatWriteError as error:
        raise UsageError(f"MAT files are limited to 4 GB per array ({error}); use npz") from error


def _legal_name(text: str, taken: Mapping[str, Any]) -> str:
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


def _struct_array(entries: list[dict[str, str]]) -> Any:
    """Return a struct array of texts, one struct an entry."""
    table = np.empty((len(entries), 1), dtype=[(key, object) for key in entries[0]])
    for row, entry in enumerate(entries):
        for key, text in entry.items():
            table[key][row, 0] = text
    return table


def _by_component(choice: LogChoice) -> Iterator[tuple[str, list[str], Nanoseconds, Matrix]]:
    """Yield each component with its chosen signals, its instants and its rows."""
    names: dict[str, list[str]] = {}
    for name, port in choice.selection.items():
        names.setdefault(port.channel.name, []).append(name)
    for component, own in names.items():
        blocks = list(choice.run.blocks(component))
        time_ns = np.concatenate([times for times, _ in blocks])
        rows = np.concatenate([part for _, part in blocks])
        yield component, own, time_ns, rows


def _metadata(port: RecordedPort) -> dict[str, str]:
    return signal_metadata(port.described, units_text(port.measures))


def _values(rows: Matrix, port: RecordedPort) -> Matrix:
    values: Matrix = np.ascontiguousarray(rows[:, port.columns])
    return values[:, 0] if port.size == 1 else values


_MOST_ROWS: Final = 2**16  # of a group


def write_parquet(stream: BinaryIO, choice: LogChoice) -> None:
    """Write the signals as a table."""
    arrow = _pyarrow()
    from pyarrow import parquet

    fields = [arrow.field(TIME, arrow.float64(), nullable=False, metadata={"unit": "s"})]
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
                writer.write_batch(arrow.record_batch(_arrays(arrow, rows), schema=schema))


def need_pyarrow() -> None:
    """Check that Parquet can be written.

    Raises
    ------
    UsageError
        If there is no pyarrow.
    """
    _pyarrow()


def _pyarrow() -> Any:
    try:
        import pyarrow
    except ImportError as error:
        raise UsageError(
            "Parquet files need pyarrow, which is not installed: pip install pyarrow, or, in a "
            "clone of cosim, pip install -e '.[parquet]'"
        ) from error
    return pyarrow


def _arrays(arrow: Any, rows: JoinedRows) -> list[Any]:
    arrays = [arrow.array(rows.time_ns / NANOSECONDS)]
    for number in range(rows.values.shape[1]):
        missing = None if rows.missing is None else rows.missing[:, number]
        values = np.ascontiguousarray(rows.values[:, number])
        arrays.append(arrow.array(values, mask=missing, from_pandas=False))
    return arrays


ENDINGS: Final = (".csv", ".parquet", ".mat", ".npz")

_BUFFER_BYTES: Final = 2**20


def free_target(out: Path, *, force: bool = False) -> UnfinishedLog:
    """Return where a log is converted to; check that it can be, before the log is read.

    Raises
    ------
    UsageError
        If its ending is not that of a known format, or a library for that is missing.
    LogError
        If a file exists there and is not to be replaced, or none can be written.
    """
    ending = out.suffix.lower()
    if ending not in ENDINGS:
        found = repr(out.suffix) if out.suffix else "none"
        raise UsageError(
            f"{out}: expected a file extension among {', '.join(ENDINGS)}, got {found}"
        )
    if ending == ".parquet":
        need_pyarrow()
    target = UnfinishedLog(out, force=force)
    target.check_free()
    return target


def convert(choice: LogChoice, out: Path, *, force: bool = False) -> None:
    """Write signals to a file, in the format that its ending names.

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
        As :func:`free_target`, or if an array is too large for MAT.
    LogError
        If the log is damaged, or the file cannot be written.
    """
    target = free_target(out, force=force)
    try:
        with io.BufferedWriter(target.create(), _BUFFER_BYTES) as stream:
            _write(stream, choice, out.suffix.lower())
        target.publish()
    except OSError as error:
        raise LogError(f"{out} cannot be written: {error.strerror or error}") from error
    finally:
        target.discard()


def _write(stream: BinaryIO, choice: LogChoice, ending: str) -> None:
    match ending:
        case ".npz":
            write_npz(stream, choice)
        case ".mat":
            write_mat(stream, choice)
        case ".parquet":
            write_parquet(stream, choice)
        case _:
            for text in csv_text(choice):
                stream.write(text.encode())
