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
from cosim.core.recorded.signals import find_signal
from cosim.core.recording import Recording
from cosim.core.signals import Signal
from cosim.errors import LogError, UnknownSignalError
from cosim.instants import NANOSECONDS
from cosim.scenario.record import component_record
from cosim.units import Unit, conversions_between, units_text

_PART_STEPS: Final = 2**17  # of a run that are looked at together


def signal_of(recording: Recording, port: str) -> Signal:
    """Return the signal of a recorded port, which may name some of its elements.

    Raises
    ------
    UnknownSignalError
        If there is none.
    """
    return find_signal(recording.channels, port, source="the recording").signal


def element_names(port: str, size: int) -> list[str]:
    """Return the names of the elements of a port, numbered as in its signal; a scalar's is its own.

    Parameters
    ----------
    port : str
    size : int
        Number of its elements.
    """
    return Port.parse(port).element_names(size)


def has_signal(recording: Recording, port: str) -> bool:
    """Return whether a port was recorded."""
    try:
        signal_of(recording, port)
    except UnknownSignalError:
        return False
    return True


def time_ns_of(recording: Recording, port: str) -> Nanoseconds:
    """Return the instants of the rows of a port, shape (N,) [ns]."""
    return recording.time_ns(Port.parse(port).component)


def units_of(recording: Recording, port: str) -> tuple[Unit, ...]:
    """Return the units of the elements of a port."""
    return find_signal(recording.channels, port, source="the recording").measures


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
    conversions = conversions_between(units_of(recording, port), like)
    for values, convert in zip(rows.T, conversions, strict=True):
        if convert is None:
            raise LogError(f"{port!r} has a unit incompatible with {units_text(like)!r}")
        columns.append(convert(values))
    return np.stack(columns, axis=1)


def stacked_units(recording: Recording, ports: Sequence[str], like: str) -> list[tuple[Unit, ...]]:
    """Return for each of several ports side by side the units of what another has there."""
    units = iter(units_of(recording, like))
    return [tuple(islice(units, len(units_of(recording, port)))) for port in ports]


def stacked_rows_of(
    recording: Recording, ports: Sequence[str], *, like: str
) -> tuple[Nanoseconds, Matrix]:
    """Return several ports side by side, in the unit of another, at the instants that they share.

    Returns
    -------
    tuple
        The instants [ns], shape (N,), and the rows there, shape (N, size of all).
    """
    units = stacked_units(recording, ports, like)
    times = time_ns_of(recording, ports[0])
    rows = rows_of(recording, ports[0], like=units[0])
    for port, port_units in zip(ports[1:], units[1:], strict=True):
        port_rows = rows_of(recording, port, like=port_units)
        port_times = time_ns_of(recording, port)
        times, shared, port_shared = np.intersect1d(times, port_times, return_indices=True)
        rows = np.hstack([rows[shared], port_rows[port_shared]])
    return times, rows


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
    own_ns = time_ns_of(recording, estimate)
    own_rows = rows_of(recording, estimate)
    lag = lag_of(recording, estimate)
    if not lag and np.array_equal(own_ns, true_ns):
        return own_ns, own_rows, true_rows
    if not lag:
        shared_ns, own, true = np.intersect1d(own_ns, true_ns, return_indices=True)
        return shared_ns, own_rows[own], true_rows[true]
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
    ports = [estimate, *true_ports]
    channels = [recording.channels[Port.parse(port).component] for port in ports]
    # What is interpolated at a time has the rows around it.
    margin_ns = ceil(max(channel.period for channel in channels) * recording.step_ns)
    before_ns = margin_ns + ceil(max(lag_of(recording, estimate), 0.0) * NANOSECONDS)
    span_ns = ceil(_PART_STEPS * recording.step_ns)
    for begin_ns in range(recording.grid.start_ns, recording.end_ns + 1, span_ns):
        last_ns = begin_ns + span_ns - 1
        part = RecordedWindow(recording, begin_ns - before_ns, last_ns + margin_ns)
        time_ns, own, true = beside_truth(part, estimate, true_ports)
        inside = (begin_ns <= time_ns) & (time_ns <= last_ns)
        yield time_ns[inside], own[inside], true[inside]


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


def difference(first: Recording, other: Recording, port: str) -> tuple[Matrix, Matrix]:
    """Compare a port of two recordings at the instants that they share.

    Returns
    -------
    tuple
        The instants [s], shape (N,), and ``other - first`` there, shape (N, size).
    """
    times, first_rows, other_rows = np.intersect1d(
        time_ns_of(first, port), time_ns_of(other, port), return_indices=True
    )
    values = rows_of(other, port)[other_rows] - rows_of(first, port)[first_rows]
    return times / 1e9, values
