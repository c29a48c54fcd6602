"""Reductions bound to the rows that they reduce.

Components may have rows at several rates. A reduction is over the instants at which all components
in it have a row; one of ``t`` alone over those of the fastest component.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cosim.arrays import Nanoseconds
from cosim.core.recorded.signals import RecordedPort, find_signal
from cosim.core.recording import Recording
from cosim.core.signals import Channel, Layout
from cosim.errors import UnknownSignalError, UsageError, listing
from cosim.native.numerics.expression import ConditionProgram, Program
from cosim.native.numerics.reductions import KeptValues, RowReduction, RowReductions
from cosim.studies.metrics.language import Reduction


@dataclass(frozen=True, eq=False)
class BoundReductions:
    """Reductions over the same rows.

    Parameters
    ----------
    numbers : tuple of int
        Which ones of all they are.
    rows : RowReductions
    period : int
        Communication steps between the rows.
    """

    numbers: tuple[int, ...]
    rows: RowReductions
    period: int


def find_element(channels: Mapping[str, Channel], name: str, source: str) -> RecordedPort:
    """Return a signal of one element, or an element of a signal.

    Raises
    ------
    UsageError
        If there is none of that name, with the nearest, or it has several elements.
    """
    try:
        port = find_signal(channels, name, source=source)
    except UnknownSignalError as error:
        raise UsageError(str(error)) from error
    if port.size != 1:
        begin = port.columns.start + port.channel.start
        first = begin - port.channel.signal_columns[port.signal.name].start
        elements = range(first, first + port.size)
        names = [f"{port.channel.name}.{port.signal.element(i)}" for i in elements]
        raise UsageError(f"'{name}' has {port.size} elements; expected one of: {listing(names)}")
    return port


def bind_layout(reductions: Sequence[Reduction], layout: Layout) -> list[BoundReductions]:
    """Return reductions bound to the rows of a run while it advances.

    Raises
    ------
    UsageError
        If there is no such signal; :meth:`cosim.studies.metrics.metrics.Metrics.check` names all.
    """
    channels = {channel.name: channel for channel in layout.channels}

    def column_of(name: str) -> int:
        port = find_element(channels, name, "the run")
        return int(port.channel.start + port.columns.start)

    groups: dict[int, list[int]] = {}
    for number, reduction in enumerate(reductions):
        period = math.lcm(*(channel.period for channel in _channels_of(reduction, channels)))
        groups.setdefault(period, []).append(number)
    return [
        BoundReductions(tuple(numbers), _bound(reductions, numbers, column_of), period)
        for period, numbers in groups.items()
    ]


def reduce_recording(reductions: Sequence[Reduction], recording: Recording) -> list[KeptValues]:
    """Return what reductions keep of a recorded run.

    Raises
    ------
    UsageError
        If there is no such signal.
    """
    groups: dict[tuple[str, ...], list[int]] = {}
    for number, reduction in enumerate(reductions):
        names = {channel.name for channel in _channels_of(reduction, recording.channels)}
        groups.setdefault(tuple(sorted(names)), []).append(number)
    kept: dict[int, KeptValues] = {}
    for components, numbers in groups.items():
        rows = _reduced(recording, components, [reductions[number] for number in numbers])
        kept.update({number: rows.kept(place) for place, number in enumerate(numbers)})
    return [kept[number] for number in range(len(reductions))]


def _reduced(
    recording: Recording, components: Sequence[str], reductions: Sequence[Reduction]
) -> RowReductions:
    """Return reductions over the rows that some components have at the same instants."""
    time_ns = _common_instants([recording.time_ns(name) for name in components])
    columns: dict[str, int] = {}
    for reduction in reductions:
        for name in reduction.signals:
            columns.setdefault(name, len(columns))
    rows = np.empty((len(time_ns), max(len(columns), 1)))
    for name, column in columns.items():
        component = find_element(recording.channels, name, recording.label).channel.name
        own_ns = recording.time_ns(component)
        rows[:, column] = recording[name][np.searchsorted(own_ns, time_ns)]
    bound = _bound(reductions, range(len(reductions)), columns.__getitem__)
    bound.begin(recording.step_ns)
    bound.add(time_ns, rows)
    return bound


def _common_instants(times: Sequence[Nanoseconds]) -> Nanoseconds:
    """Return the instants that are in all of several increasing ones."""
    common = times[0]
    for other in times[1:]:
        if not np.array_equal(common, other):
            common = np.intersect1d(common, other, assume_unique=True)
    return np.ascontiguousarray(common)


def _channels_of(reduction: Reduction, channels: Mapping[str, Channel]) -> Iterator[Channel]:
    """Yield the channels at whose common instants a reduction has rows."""
    if not channels:
        raise UsageError("expected at least one component in the run, got none")
    if not reduction.signals:
        yield min(channels.values(), key=lambda channel: channel.period)
    for name in reduction.signals:
        yield find_element(channels, name, "the run").channel


def _bound(
    reductions: Sequence[Reduction], numbers: Sequence[int], column_of: Callable[[str], int]
) -> RowReductions:
    """Return reductions over rows in which signals have some columns."""
    bound = []
    for number in numbers:
        reduction = reductions[number]
        values = _with_columns(reduction.values, column_of)
        where = None
        if reduction.where is not None:
            where = _condition_with_columns(reduction.where, column_of)
        bound.append(RowReduction(reduction.kind.parts, values, where))
    return RowReductions(bound)


def _with_columns(
    values: Program | ConditionProgram, column_of: Callable[[str], int]
) -> Program | ConditionProgram:
    if isinstance(values, ConditionProgram):
        return _condition_with_columns(values, column_of)
    return values.with_columns([column_of(name) for name in values.signals])


def _condition_with_columns(
    condition: ConditionProgram, column_of: Callable[[str], int]
) -> ConditionProgram:
    columns = [column_of(name) for name in condition.program.signals]
    return replace(condition, program=condition.program.with_columns(columns))
