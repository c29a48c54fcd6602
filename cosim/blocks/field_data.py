"""Recorded samples at times of their own, in the place of a plant.

At the communication points the outputs are on the straight lines between the samples, or have the
last of them (zero-order hold). Beside them are the samples themselves, for those who must not take
interpolated values for measured ones: of every output ``y`` there is ``y_samples``, and
``sample_times`` has their instants. At a communication point these are the samples since the point
before it; at the start of the run, a sample of that instant. As many as can be in one step have a
place, NaN where there is none.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import NAN, Matrix, Vector
from cosim.core.contracts import Stopped
from cosim.core.signals import (
    SAMPLE_TIMES,
    Interface,
    PortUnit,
    Signal,
    Variability,
    samples_of,
)
from cosim.errors import GraphError, UsageError, listing, nearest
from cosim.instants import NANOSECONDS
from cosim.native.blocks.field_data import field_data_step
from cosim.native.step import NativeStep

USUAL_GAP: Final = 10.0  # median distances of samples
_ELEMENT: Final = re.compile(r"(?P<whole>.+)\[(?P<index>\d{1,9})\]", re.DOTALL)
JITTER: Final = 1.1  # communication steps: so far apart are samples that come once in a step


def units_of_samples(units: PortUnit, most: int) -> str | tuple[str, ...]:
    """Return the units of the samples of an output, of which each element has ``most``."""
    if isinstance(units, str):
        return units
    return tuple(unit for unit in units for _ in range(most))


@dataclass(frozen=True, eq=False)
class FieldSignal:
    """A recorded signal.

    Parameters
    ----------
    name : str
    unit : str, tuple of str, or None
        One for all elements, or one for each; None: not declared.
    values : Matrix, shape (N, size)
        NaN: not measured.
    columns : tuple of str
        What its elements are in the file, or one name for all of them.
    """

    name: str
    unit: str | tuple[str, ...] | None
    values: Matrix
    columns: tuple[str, ...] = ()

    @property
    def element_labels(self) -> list[str]:
        """How messages name its elements: with their columns, where these have other names."""
        size = self.values.shape[1]
        columns = self.columns if len(self.columns) == size else self.columns[:1] * size
        labels = []
        for column in columns or (self.name,) * size:
            labels.append(repr(self.name) if column == self.name else f"{self.name!r} ({column})")
        return labels


@dataclass(frozen=True, eq=False)
class FieldData:
    """Recorded signals at times of their own.

    Parameters
    ----------
    source : str
        Where they come from, for messages.
    t : Vector, shape (N,)
        Ascending times [s].
    signals : tuple of FieldSignal
    diagnostics : tuple of str
        What is to be known of the samples, such as how many were out of order.
    zero_ns : int or None
        The time in the file that is t = 0 [ns]; None: its times are no whole ns.
    discrete : tuple of str
        Signals that are known to have nothing between two samples.
    end : float or None
        When the recording ends [s]; None: at its last time.
    restart : (float, str) or None
        Where the largest gap begins [s], and the offset by which t = 0 is behind it.
    reading : tuple of (str, str, str, str)
        What was found in the file: what, as what, why, and the key that says it otherwise.
    """

    source: str
    t: Vector
    signals: tuple[FieldSignal, ...]
    diagnostics: tuple[str, ...] = ()
    zero_ns: int | None = None
    discrete: tuple[str, ...] = ()
    end: float | None = None
    restart: tuple[float, str] | None = None
    reading: tuple[tuple[str, str, str, str], ...] = ()

    def __getitem__(self, name: str) -> Matrix:
        """Return the samples of a signal, shape (N, size); NaN: not measured.

        Raises
        ------
        UsageError
            If there is none of that name.
        """
        by_name = {signal.name: signal.values for signal in self.signals}
        if name not in by_name:
            raise UsageError(f"{self.source} has no signal {name!r}; {nearest(name, by_name)}")
        return by_name[name]

    @property
    def measured(self) -> NDArray[np.bool_]:
        """The times at which something was measured, shape (N,)."""
        is_measured = np.zeros(len(self.t), np.bool_)
        for signal in self.signals:
            is_measured |= np.isfinite(signal.values).any(axis=1)
        return is_measured

    def most_in_a_step(self, points: Vector) -> int:
        """Return the largest number of samples between two communication points, at least 1."""
        t = self.t[self.measured]
        counts = np.diff(np.searchsorted(t, points, side="right"))
        return max(1, int(counts.max(initial=1)))


@dataclass(frozen=True, eq=False)
class _Line:
    """The measured values of one element, straight lines or a zero-order hold between them."""

    name: str
    t: Vector
    values: Vector

    def at(self, t: Vector, *, hold: bool) -> Vector:
        """Return the values at times within the samples."""
        before = np.searchsorted(self.t, t, side="right") - 1
        if hold:
            held: Vector = self.values[before]
            return held
        after = np.minimum(before + 1, len(self.t) - 1)
        is_last = after == before
        distance = np.where(is_last, 1.0, self.t[after] - self.t[before])
        part = (t - self.t[before]) / distance
        first = self.values[before]
        values: Vector = first + part * (self.values[after] - first)
        return values


class FieldRecording:
    """Returns recorded samples, and what is between them at the communication points.

    Parameters
    ----------
    data : FieldData
    most : int
        Samples that can be in one step.
    hold : bool
        A zero-order hold between samples: the outputs are discrete. Else straight lines.
    end : float, optional
        The last time at which all have a value [s], by default that of :func:`last_covered`.

    Raises
    ------
    GraphError
        If it is initialized before all is measured, or a step has more samples.
    Stopped
        From ``advance``, where an output is measured no more.
    """

    def __init__(
        self, data: FieldData, *, most: int, hold: bool = False, end: float | None = None
    ) -> None:
        is_measured = data.measured
        self._t = data.t[is_measured]
        self._columns: list[Vector] = []
        outputs = []
        samples = []
        for signal in data.signals:
            size = signal.values.shape[1]
            variability: Variability = "discrete" if hold else "continuous"
            output = Signal(signal.name, size, unit=signal.unit, variability=variability)
            outputs.append(output)
            of_signal = Signal(
                samples_of(signal.name),
                size * most,
                unit=None if signal.unit is None else units_of_samples(signal.unit, most),
                variability="discrete",
                optional=True,
            )
            samples.append(of_signal)
            self._columns += list(signal.values[is_measured].T)
        times = Signal(SAMPLE_TIMES, most, unit="s", variability="discrete", optional=True)
        shown = (*outputs, *samples, times)
        self.interface = Interface((), shown, rollback=True, native=True, continuous=True)
        self._lines = measured_lines(data)
        self._begin = max(line.t[0] for line in self._lines)
        self._end = last_covered(data, hold=hold) if end is None else end
        self._source = data.source
        self._most = most
        self._hold = hold
        lines = [(line.t, line.values) for line in self._lines]
        columns = np.stack([*self._columns, self._t])
        self._columns = list(columns[:-1])
        self._t = columns[-1]
        self._step = field_data_step(lines, columns, most=most, end=float(self._end), hold=hold)

    def initialize(self, t: float, u: Vector) -> Vector:
        """Begin at ``t``: the samples before it are of no step."""
        self._before = None
        return self.outputs(t, u)

    def outputs(self, t: float, u: Vector) -> Vector:
        """Return what is between the samples at ``t``, and the samples of the last step.

        Raises
        ------
        GraphError
            If not all is measured then.
        """
        if not self._begin <= t <= self._end:
            raise GraphError(
                f"{self._source}: expected a time from {self._begin} s to {self._end} s, got {t} s"
            )
        end = np.array([t])
        first = np.searchsorted(self._t, end, side="left")
        if self._before is not None:
            first = np.searchsorted(self._t, np.array([self._before]), side="right")
        row: Vector = self._rows(end, first)[0]
        return row

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Return the rows at ``t[1:]``.

        Raises
        ------
        Stopped
            Where an output is measured no more; with the rows before it.
        """
        ends = t[1:][t[1:] <= self._end]
        first = np.searchsorted(self._t, t[: len(ends)], side="right")
        rows = self._rows(ends, first)
        if len(ends) < len(t) - 1:
            raise Stopped(rows, f"the samples end at {self._end} s")
        self._before = float(t[-2])
        return rows

    def native(self) -> NativeStep:
        """Return the compiled step."""
        return self._step

    @property
    def _before(self) -> float | None:
        """The communication point before the last [s]; None: there is none."""
        before = float(self._step.memory[0])
        return None if np.isnan(before) else before

    @_before.setter
    def _before(self, t: float | None) -> None:
        self._step.memory[0] = NAN if t is None else t

    def save(self) -> float | None:
        """Return the communication point before the last."""
        return self._before

    def restore(self, state: float | None) -> None:
        """Return to a saved state."""
        self._before = state

    def _rows(self, ends: Vector, first: NDArray[np.intp]) -> Matrix:
        """Return the rows at the ends of steps, with the samples from number ``first`` on."""
        after = np.searchsorted(self._t, ends, side="right")
        if (after - first).max(initial=0) > self._most:
            raise GraphError(
                f"{self._source}: more than {self._most} samples in a step; expected the "
                "communication points that it was built for"
            )
        number = first[:, np.newaxis] + np.arange(self._most)
        is_there = number < after[:, np.newaxis]
        number = np.minimum(number, len(self._t) - 1)
        parts = [line.at(ends, hold=self._hold)[:, np.newaxis] for line in self._lines]
        for column in (*self._columns, self._t):
            picked = column[number]
            parts.append(np.where(is_there & np.isfinite(picked), picked, NAN))
        return np.hstack(parts)


def at_points(data: FieldData, points: Vector) -> FieldData:
    """Return samples with those of a communication point at that very time.

    A time stamp is of a point that is no farther than the clock resolves, 1 ns, or than doubles do.

    Parameters
    ----------
    data : FieldData
    points : Vector
        The communication points [s].

    Raises
    ------
    UsageError
        If two samples are of one point.
    """
    after = np.searchsorted(points, data.t).clip(1, len(points) - 1)
    is_nearer = data.t - points[after - 1] < points[after] - data.t
    nearest = points[after - is_nearer]
    rounding = 4.0 * np.spacing(np.abs(nearest))
    is_there = np.abs(data.t - nearest) <= np.maximum(1.0 / NANOSECONDS, rounding)
    t = np.where(is_there, nearest, data.t)
    doubled = np.flatnonzero(np.diff(t) <= 0.0)
    if doubled.size:
        first, second = data.t[doubled[0] :][:2].tolist()
        raise UsageError(
            f"{data.source}: expected times at least 1 ns apart, got {first!r} s and {second!r} s, "
            "which are of one communication point"
        )
    return replace(data, t=t)


def measured_lines(data: FieldData) -> list[_Line]:
    """Return what was measured of each element of the signals.

    Raises
    ------
    UsageError
        If nothing was measured of an element.
    """
    lines = []
    for signal in data.signals:
        for name, values in zip(signal.element_labels, signal.values.T, strict=True):
            is_measured = np.isfinite(values)
            if not is_measured.any():
                raise UsageError(f"{data.source} has no measured value of {signal.name!r}")
            lines.append(_Line(name, data.t[is_measured], values[is_measured]))
    return lines


def last_covered(data: FieldData, *, hold: bool) -> float:
    """Return the last time at which all signals have a value [s].

    Samples that are held are so to the end of the recording.
    """
    ends = [float(line.t[-1]) for line in measured_lines(data)]
    if hold:
        recorded = float(data.t[-1]) if data.end is None else data.end
        ends = [max(end, recorded) for end in ends]
    return min(ends)


def check_covers(
    data: FieldData,
    points: Vector,
    maximum_gap: float | None,
    *,
    hold: bool = False,
    extrapolate: bool = False,
) -> list[str]:
    """Check that all is measured from the first to the last communication point.

    Parameters
    ----------
    data : FieldData
    points : Vector
        The communication points [s].
    maximum_gap : float or None
        Longest time between two samples of a signal [s]; None: ten times the median, no limit for
        samples that are held.
    hold : bool
        Samples are held until the next one, or the end of the recording.
    extrapolate : bool
        The last sample is held to the end of the run.

    Returns
    -------
    list of str
        What is to be known of samples that are held for very long.

    Raises
    ------
    UsageError
        If a signal begins later, ends earlier, or has a longer gap; says what can be done.
    """
    lines = measured_lines(data)
    begin = max(float(line.t[0]) for line in lines)
    end = np.inf if extrapolate else last_covered(data, hold=hold)
    if begin > points[0] or end < points[-1]:
        raise UsageError(_uncovered_text(data, points, begin=begin, end=end, hold=hold))
    notes = []
    until = points[-1] if hold and maximum_gap is not None else None
    for line in lines:
        t = line.t if until is None or until <= line.t[-1] else np.append(line.t, until)
        note = _check_gaps(data, line.name, t, points, maximum_gap, hold=hold)
        if note and data.zero_ns is None:  # of messages the largest gap is said anyway
            notes.append(note)
    return notes


def _uncovered_text(
    data: FieldData, points: Vector, *, begin: float, end: float, hold: bool
) -> str:
    """Return which signals do not cover a run, and what can be done."""
    late = []
    early = []
    for line in measured_lines(data):
        if line.t[0] > points[0]:
            late.append(f"{line.name} begins at {line.t[0]} s")
        if end < points[-1] and line.t[-1] < points[-1]:
            early.append(f"{line.name} ends at {line.t[-1]} s")
    ways_out = []
    inside = points[(points >= begin) & (points <= end)]
    if len(inside) > 1:
        ways_out.append(
            f"start_time = {inside[0]} and stop = {inside[-1]} of [scenario] are inside"
        )
    elif data.t[0] != 0.0:
        ways_out.append('offset = "first" makes its first time 0')
    if early and not late:
        if not hold and last_covered(data, hold=True) >= points[-1]:
            ways_out.append('interpolation = "zero-order" holds a sample until the next one')
        else:
            ways_out.append('extrapolation = "hold" keeps the last sample')
    last = end if np.isfinite(end) else float(data.t[-1])
    return (
        f"{data.source}: expected samples over the whole run, from {points[0]} s to {points[-1]} "
        f"s, got {begin} s to {last} s, as {listing([*late, *early])}: "
        f"{', or '.join(ways_out) or 'choose other columns'}"
    )


def check_step(data: FieldData, step: float) -> None:
    """Check that the communication step is not shorter than the time between two samples.

    Parameters
    ----------
    data : FieldData
    step : float
        [s].

    Raises
    ------
    UsageError
        If it is, so that most points have a value of no sample; says what can be done.
    """
    for line in measured_lines(data):
        if len(line.t) < 2:
            continue
        median = float(np.median(np.diff(line.t)))
        if median > JITTER * step:
            raise UsageError(
                f"{data.source}: the communication step of {step:g} s is smaller than the "
                f'sampling period of {line.name}, {median:g} s; set interpolation = "linear" or '
                f'"zero-order", or use a step of {median:g} s'
            )


def _check_gaps(
    data: FieldData, name: str, t: Vector, points: Vector, maximum_gap: float | None, *, hold: bool
) -> str:
    """Check the times between samples; return what is to be known of one that is held for long."""
    begin = t[:-1]
    end = t[1:]
    in_run = (end > points[0]) & (begin < points[-1])
    gaps = end - begin
    limit = maximum_gap
    needed = f"a gap of at most maximum_gap = {maximum_gap} s"
    median = float(np.median(gaps)) if len(gaps) else 0.0
    if limit is None:
        limit = USUAL_GAP * median
        needed = f"a gap of at most {USUAL_GAP:g} times the median sampling period, {median:g} s"
    too_long = np.flatnonzero(in_run & (gaps > limit))
    if not too_long.size:
        return ""
    first = too_long[0]
    longest = float(gaps[in_run].max())
    if hold and maximum_gap is None:
        return (
            f"{data.source}: {name} is held from {begin[first]} s to {end[first]} s, the median "
            f"distance of its samples is {median:g} s; maximum_gap refuses what is longer"
        )
    way_out = f"set maximum_gap = {longest!r}, or run before or after the gap"
    restart, offset = data.restart or (np.nan, "")
    if np.isclose(begin[first], restart) and end[first] >= points[-1]:
        way_out = f"offset = {offset} is the time stamp after the gap, as t = 0; or {way_out}"
    raise UsageError(
        f"{data.source}: {name} has no sample between {begin[first]} s and {end[first]} s; "
        f"expected {needed}; {way_out}"
    )


def elements_named(names: Sequence[str]) -> dict[str, list[str]]:
    """Return names by signal: x[0], x[1], ..., all from 0 on, are the elements of x."""
    groups: dict[str, dict[int, str]] = {}
    for name in names:
        match = _ELEMENT.fullmatch(name)
        if match is not None:
            groups.setdefault(match["whole"], {})[int(match["index"])] = name
    known = set(names)
    whole_of: dict[str, str] = {}
    for whole, elements in groups.items():
        if whole not in known and sorted(elements) == list(range(len(elements))):
            whole_of |= dict.fromkeys(elements.values(), whole)
    signals: dict[str, list[str]] = {}
    for name in names:
        whole = whole_of.get(name, name)
        if whole not in signals:
            elements = groups[whole] if name in whole_of else {0: name}
            signals[whole] = [elements[i] for i in range(len(elements))]
    return signals
