"""A recorded component in the place of a live one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import TypeAlias

import numpy as np

from cosim.arrays import Mask, Matrix, Vector
from cosim.blocks.recorded_rows import RecordedRows
from cosim.blocks.recorded_times import (
    GivenTimes,
    RecordedTimes,
    RowNumbers,
    TimesFinder,
    instants_of,
)
from cosim.core.contracts import Design, Stopped
from cosim.core.port import Port
from cosim.core.recorded.partial import declared_channels, partial_of, reduced_interface
from cosim.core.recorded.signals import find_channel
from cosim.core.recording import EventCause, Recording
from cosim.core.signals import Channel, Interface, Signal
from cosim.errors import GraphError, LogError
from cosim.native.blocks.functions import RecordedStep
from cosim.native.step import NativeStep

_Outputs: TypeAlias = list[tuple[slice, tuple[float, ...]]]  # their columns, and the values


class Replay:
    """Returns the recorded outputs of a component, bit for bit, whatever its inputs are.

    Parameters
    ----------
    recording : Recording
        A log file, or the memory of a run.
    component : str
        The recorded component.
    inputs : bool
        Whether it has the recorded inputs too, so that what drives the component may stay
        connected; else it is a source. An input that was constant needs no connection.
    unrecorded : bool
        Whether it has the inputs, too, that a partial log did not record; none needs a connection.

    Raises
    ------
    UnknownSignalError
        If the recording has no such component; names the nearest.
    LogError
        If it has no row of it, or not every one.
    GraphError
        If the run starts before the recording.
    Stopped
        From ``advance``, where the recording ends.
    """

    def __init__(
        self,
        recording: Recording,
        component: str,
        *,
        inputs: bool = True,
        unrecorded: bool = False,
    ) -> None:
        channel = find_channel(recording.channels, component, source=recording.label)
        _check_every_row(recording, channel)
        times, constant = _look_through(recording, channel)
        if not len(times):
            raise LogError(
                f"{recording.label} has no rows of {component!r}; expected at least the one at t "
                "= 0"
            )
        recorded = channel.interface
        shown = Interface((), recorded.outputs, {}, continuous=recorded.continuous)
        if inputs:
            whole = _with_unrecorded(recording, channel) if unrecorded else recorded
            signals = tuple(_shown(channel, signal, constant) for signal in whole.inputs)
            shown = replace(whole, inputs=signals)
        self._limits = _changes(recording, component, recorded, "jump")
        self.interface = replace(
            shown,
            prepares=True,
            rollback=True,
            native=not self._limits,
            linearizable=False,
            keeps_events=False,
            locates_events=False,
            one_value=(),
            left_limits=_jumping(recorded, self._limits),
            substeps=True,  # in a loop the recorded ones are taken
        )
        self._last = len(times) - 1  # of its own rows
        last_ns = times.nanoseconds(self._last, len(times))[0]
        if channel.period > 1 and recording.end_ns > last_ns:
            # the run went on behind the last row of a component that lacks some steps
            time_ns = np.append(times.nanoseconds(0, len(times)), recording.end_ns)
            times = GivenTimes(time_ns, instants_of(recording, time_ns))
        self._times = times
        self._right_limits: dict[float, _Outputs] = {}
        self._right_limits_at = np.empty(0)
        self._find_followed = partial(_changes, recording, component, recorded, "follow")
        self._rows = RecordedRows(recording, component, times)
        self._kernel = RecordedStep(recorded.n_y)
        self._show_rows()
        self._never = np.zeros(1, np.int32)
        self._no_outputs = np.zeros(max(recorded.n_y, 1))
        if not self._limits:
            # what may jump, but has no recorded jump, has not jumped
            left_outputs = (self._never.ctypes.data, self._no_outputs.ctypes.data)
            self._kernel.step.left_outputs = left_outputs

    def hold(self, interface: Interface) -> None:
        """Hold its outputs between its rows, as a component does that has a sample period.

        An output that followed an input at a row holds from there on what it had then, which is
        not what the row has: that is the left limit.

        Parameters
        ----------
        interface : Interface
            The one with the sample period.
        """
        self.interface = interface
        self._right_limits = self._find_followed()
        self._right_limits_at = np.array(list(self._right_limits))
        self._show_rows()

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Pass the recorded design on, so that a replay's log is as complete as the run's."""
        return recorded

    def prepare_substeps(self, lengths: tuple[float, ...], recorded: Design) -> Design:
        """Pass the recorded design on."""
        return recorded

    def initialize(self, t: float, u: Vector) -> Vector:
        """Return the recorded row at ``t``."""
        return self.outputs(t, u)

    def outputs(self, t: float, u: Vector) -> Vector:
        """Return the recorded row at ``t``.

        Raises
        ------
        GraphError
            If ``t`` is before the recording.
        """
        row: Vector = self._rows_at(np.array([t]))[0]
        return row

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Return the recorded rows at ``t[1:]``.

        Raises
        ------
        Stopped
            Where the recording ends; with the rows before it.
        GraphError
            If ``t`` starts before the recording.
        """
        end = self._times.seconds(len(self._times) - 1, len(self._times))[0]
        inside = t[1:][t[1:] <= end]
        rows = self._rows_at(inside)
        if len(inside) < len(t) - 1:
            raise Stopped(rows, f"the recording ends at {end} s")
        return rows

    def left_limits(self, t: Vector) -> dict[int, Vector]:
        """Return the recorded left limits at ``t``."""
        limits = {}
        for place, time in enumerate(t.tolist()):
            if time in self._limits:
                y = self.outputs(time, t[:0])
                for columns, values in self._limits[time]:
                    y[columns] = values
                limits[place] = y
        return limits

    def save(self) -> None:
        """Copy nothing: there is no state."""

    def restore(self, state: None) -> None:
        """Do nothing: there is no state."""

    def native(self) -> NativeStep:
        """Return the compiled step."""
        return self._kernel.step

    def _rows_at(self, t: Vector) -> Matrix:
        """Return the rows at some times; the compiled step has those around the last one."""
        before = self._rows.rows
        numbers = self._index(t)
        rows = self._rows.at(numbers)
        if self._rows.rows is not before:
            self._show_rows()
        return self._held(t, numbers, rows)

    def _held(self, t: Vector, numbers: RowNumbers, rows: Matrix) -> Matrix:
        """Put right limits in the places of rows that are held behind them."""
        if not (len(self._right_limits) and len(t)):
            return rows
        numbers = np.minimum(numbers, self._last)
        row = int(numbers[0])
        ends = (self._times.seconds(row, row + 1)[0], t[-1])
        begin, stop = np.searchsorted(self._right_limits_at, ends)
        for time in self._right_limits_at[begin:stop].tolist():
            own = numbers == self._times.last_not_after(np.array([time]))
            for columns, values in self._right_limits[time]:
                rows[own & (t > time), columns] = values
        return rows

    def _show_rows(self) -> None:
        kept = self._rows
        t = self._times.seconds(kept.begin, kept.stop)
        rows = kept.rows
        begin, stop = np.searchsorted(self._right_limits_at, t[[0, -1]])
        within = self._right_limits_at[begin:stop]
        if len(within):
            t = np.union1d(t, np.nextafter(within, np.inf))  # right limits are rows of their own
            numbers = self._times.last_not_after(t)
            rows = self._held(t, numbers, rows[numbers - kept.begin])
        self._kernel.take(t, rows)

    def _index(self, t: Vector) -> RowNumbers:
        index = self._times.last_not_after(t)
        if (index < 0).any():
            begin = self._times.seconds(0, 1)[0]
            raise GraphError(f"the recording begins at {begin} s, requested: {t[0]} s")
        return index


def _check_every_row(recording: Recording, channel: Channel) -> None:
    """Check that a component was recorded at each of its rows: nobody knows what was between.

    Raises
    ------
    LogError
        If it was not.
    """
    partial = partial_of(recording.channels)
    if partial is not None and channel.period != partial.declared[channel.name].period:
        raise LogError(
            f"{recording.label} has one row of {channel.name!r} in {channel.period} steps "
            f"(recorded with {partial.selection}); expected every row: every = 1"
        )


def _changes(
    recording: Recording, component: str, interface: Interface, cause: EventCause
) -> dict[float, _Outputs]:
    """Return what events of one cause have of outputs, by time [s]: their columns, and the values.

    Of outputs that jump by themselves these are left limits, of those that follow right ones.
    """
    changes: dict[float, _Outputs] = {}
    columns = interface.output_columns()
    for event in recording.events():
        port = Port.parse(event.signal)
        if event.cause == cause and port.component == component and port.name in columns:
            own = (columns[port.name], event.values)
            (time,) = instants_of(recording, np.array([event.time_ns])).tolist()
            changes.setdefault(time, []).append(own)
    return changes


def _jumping(interface: Interface, limits: Mapping[float, _Outputs]) -> tuple[str, ...]:
    """Return the outputs that may jump by themselves, or of which there are left limits."""
    starts = {columns.start for at_time in limits.values() for columns, _ in at_time}
    names = []
    for name, columns in interface.output_columns().items():
        if name in interface.left_limits or columns.start in starts:
            names.append(name)
    return tuple(names)


def _with_unrecorded(recording: Recording, channel: Channel) -> Interface:
    """Return the interface of a recorded component with all inputs that it had."""
    declared = declared_channels(recording.channels)[channel.name].interface
    outputs = {signal.name for signal in channel.interface.outputs}
    return reduced_interface(declared, outputs | declared.input_names)


def _look_through(
    recording: Recording, channel: Channel
) -> tuple[RecordedTimes, dict[str, tuple[float, ...]]]:
    """Return the times of a component's rows, and the inputs that have one value in all of them."""
    n_u = channel.interface.n_u
    times = TimesFinder()
    first: Vector | None = None
    is_constant = np.ones(n_u, np.bool_)
    for time_ns, rows in recording.blocks(channel.name):
        times.add(time_ns)
        if len(rows):
            first = rows[0, :n_u].copy() if first is None else first
            is_constant &= (rows[:, :n_u] == first).all(axis=0)
    constant = {}
    if first is not None:
        for name, columns in channel.interface.input_columns().items():
            if is_constant[columns].all():
                constant[name] = tuple(first[columns].tolist())
    return times.times(recording, channel.name), constant


def _shown(channel: Channel, signal: Signal, constant: Mapping[str, tuple[float, ...]]) -> Signal:
    """Return an input; a constant one has that value where nothing drives it."""
    if signal.name not in channel.by_name:
        return replace(signal, connection="optional")
    if signal.name not in constant:
        return signal
    return replace(signal, start=constant[signal.name], connection="optional")
