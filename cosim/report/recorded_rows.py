"""Signals of a recording, by their written names."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice
from math import ceil
from typing import Final

import numpy as np

from cosim.arrays import Matrix, Nanoseconds, Vector, as_columns
from cosim.core.port import Port
from cosim.core.recorded.run import RecordedRun, RecordedWindow
from cosim.core.recorded.signals import RecordedPort, find_signal
from cosim.core.recording import Recording
from cosim.errors import LogError, UnknownSignalError
from cosim.instants import NANOSECONDS
from cosim.scenario.record import component_record
from cosim.units import Unit, conversions_between, units_text

_PART_STEPS: Final = 2**17  # of a run that are looked at together


def recorded_port(recording: Recording, port: str) -> RecordedPort:
    """Return a recorded port, which may name some of the elements of a signal.

    Raises
    ------
    UnknownSignalError
        If there is none.
    """
    return find_signal(recording.channels, port, source=recording.label)


def element_names(port: str, size: int) -> list[str]:
    """Return the names of a port's elements, numbered as in its signal; a scalar's is its own."""
    return Port.parse(port).element_names(size)


def has_signal(recording: Recording, port: str) -> bool:
    """Return whether a port was recorded."""
    try:
        recorded_port(recording, port)
    except UnknownSignalError:
        return False
    return True


def rows_of(recording: Recording, port: str, *, like: Sequence[Unit] | None = None) -> Matrix:
    """Return a port at every recorded row, shape (N, size).

    Parameters
    ----------
    recording : Recording
    port : str
        ``component.signal``, ``component.signal[1]`` or ``component.signal[0:2]``.
    like : sequence of Unit, optional
        In which the elements are returned.

    Raises
    ------
    LogError
        If there is no such component, signal or element, or the units differ in kind.
    """
    rows = as_columns(recording[port])
    if like is None:
        return rows
    columns = []
    conversions = conversions_between(recorded_port(recording, port).measures, like)
    for values, convert in zip(rows.T, conversions, strict=True):
        if convert is None:
            raise LogError(f"{port!r} has a unit incompatible with {units_text(like)!r}")
        columns.append(convert(values))
    return np.stack(columns, axis=1)


def stacked_units(recording: Recording, ports: Sequence[str], like: str) -> list[tuple[Unit, ...]]:
    """Return for each of several ports side by side the units of what another has there."""
    units = iter(recorded_port(recording, like).measures)
    return [tuple(islice(units, recorded_port(recording, port).size)) for port in ports]


def stacked_rows_of(
    recording: Recording, ports: Sequence[str], *, like: str
) -> tuple[Nanoseconds, Matrix]:
    """Return several ports side by side, in the unit of another, at the instants that they share.

    Returns
    -------
    tuple
        The instants [ns], shape (N,), and the rows there, shape (N, size of all).
    """
    first, *others = zip(ports, stacked_units(recording, ports, like), strict=True)
    times, rows = _rows_in_time(recording, *first)
    for port, units in others:
        times, rows, beside = _shared((times, rows), _rows_in_time(recording, port, units))
        rows = np.hstack([rows, beside])
    return times, rows


def _rows_in_time(
    recording: Recording, port: str, like: Sequence[Unit] | None = None
) -> tuple[Nanoseconds, Matrix]:
    times = recording.time_ns(port)
    return times, rows_of(recording, port, like=like)


def _shared(
    first: tuple[Nanoseconds, Matrix], other: tuple[Nanoseconds, Matrix]
) -> tuple[Nanoseconds, Matrix, Matrix]:
    """Return the instants that two ports share [ns], and the rows of both there."""
    if np.array_equal(first[0], other[0]):
        return *first, other[1]
    times, rows, other_rows = np.intersect1d(first[0], other[0], return_indices=True)
    return times, first[1][rows], other[1][other_rows]


def lag_of(recording: Recording, port: str) -> float:
    """Return how far a port lags behind what it estimates [s].

    Raises
    ------
    LogError
        If the metadata of its component cannot be understood.
    """
    parsed = Port.parse(port)
    return component_record(recording, parsed.component).lags.get(parsed.signal, 0.0)


def beside_truth(
    recording: Recording, estimate: str, true_ports: Sequence[str]
) -> tuple[Nanoseconds, Matrix, Matrix]:
    """Return an estimate, and the truth at the instants that it belongs to.

    An estimate that lags is compared with the truth that much earlier, which is interpolated
    linearly there.

    Returns
    -------
    tuple
        The instants of the estimate [ns], shape (N,), its rows and the true ones, shape (N, size).
    """
    true_ns, true_rows = stacked_rows_of(recording, true_ports, like=estimate)
    own_ns, own_rows = _rows_in_time(recording, estimate)
    lag = lag_of(recording, estimate)
    if not lag:
        return _shared((own_ns, own_rows), (true_ns, true_rows))
    wanted = own_ns - lag * 1e9
    known = np.zeros(len(wanted), np.bool_)
    if len(true_ns):
        known = (true_ns[0] <= wanted) & (wanted <= true_ns[-1])
    columns = [np.interp(wanted[known], true_ns, column) for column in true_rows.T]
    return own_ns[known], own_rows[known], np.stack(columns, axis=1)


def parts_beside_truth(
    recording: Recording, estimate: str, true_ports: Sequence[str]
) -> Iterator[tuple[Nanoseconds, Matrix, Matrix]]:
    """Yield what :func:`beside_truth` returns, of a long run a part of its time after another."""
    if not isinstance(recording, RecordedRun) or recording.steps <= _PART_STEPS:
        yield beside_truth(recording, estimate, true_ports)
        return
    ports = [recorded_port(recording, port) for port in (estimate, *true_ports)]
    # What is interpolated at a time has the rows around it.
    margin_ns = ceil(max(port.channel.period for port in ports) * recording.step_ns)
    before_ns = margin_ns + ceil(max(lag_of(recording, estimate), 0.0) * NANOSECONDS)
    span_ns = ceil(_PART_STEPS * recording.step_ns)
    for begin_ns in range(recording.grid.start_ns, recording.end_ns + 1, span_ns):
        last_ns = begin_ns + span_ns - 1
        part = RecordedWindow(recording, begin_ns - before_ns, last_ns + margin_ns)
        time_ns, own, true = beside_truth(part, estimate, true_ports)
        inside = (begin_ns <= time_ns) & (time_ns <= last_ns)
        yield time_ns[inside], own[inside], true[inside]


def last_value(recording: Recording, port: str) -> Vector:
    """Return a port at the last recorded row, shape (size,); NaN: there is no row."""
    rows = rows_of(recording, port)
    return rows[-1].copy() if len(rows) else np.full(rows.shape[1], np.nan)


def last_row(recording: Recording, component: str) -> Vector | None:
    """Return the last row of a component: inputs, then outputs; None: it has none."""
    period_ns = ceil(recording.channels[component].period * recording.step_ns)
    last: Vector | None = None
    for first_ns in (recording.end_ns - period_ns, None):  # of a long run not all is read
        for _, rows in recording.blocks(component, first_ns=first_ns):
            last = rows[-1].copy() if len(rows) else last
        if last is not None:
            break
    return last


def difference(first: Recording, other: Recording, port: str) -> tuple[Vector, Matrix]:
    """Compare a port of two recordings at the instants that they share.

    Returns
    -------
    tuple
        The instants [s], shape (N,), and ``other - first`` there, shape (N, size).
    """
    times, rows, other_rows = _shared(_rows_in_time(first, port), _rows_in_time(other, port))
    return times / 1e9, other_rows - rows
