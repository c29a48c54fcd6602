"""Files of arrays: every signal is an array, and so are the instants of every component.

For npz the rows of one component at a time are in memory, for MAT those of all.
"""

from __future__ import annotations

import json
import re
import zipfile
from collections.abc import Iterator, Mapping
from typing import Any, BinaryIO, Final

import numpy as np
from numpy.lib.format import write_array

from cosim.arrays import Matrix, Nanoseconds
from cosim.core.recorded.signals import RecordedPort
from cosim.errors import UsageError
from cosim.instants import NANOSECONDS
from cosim.log.conversion.choice import LogChoice, signal_metadata
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
