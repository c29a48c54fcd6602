"""Sensors: what a measuring chain reports of the signal that it measures.

A sample passes the chain in this order:

1. *Delay and jitter*: it is the input at the instant ``t - delay + j``, j uniform within plus and
   minus the jitter. The input is interpolated linearly between communication points, or held where
   it is discrete, and has its first value before the start. With a jitter beyond the delay some
   instants lie after t, where no component knows its input: there the straight line of the last
   step goes on. Its error, up to ``j (h + j)/2 |u''|``, is of the order of that of interpolation.
2. *Bias* and 3. *noise*: a constant, and a Gaussian number for every sample, are added.
4. *Limits*: the sample saturates.
5. *Quantization*: it becomes the nearest level; a tie goes to the even level.
6. *Dropouts*: it may be lost; y then keeps the last sample that was not.

So noise is limited and quantized like the signal, every sample is a level, and what is lost is lost
on the way from the converter.

Between samples y is interpolated linearly where the input is, as everything here that reads sampled
data assumes: held, it would lag by half a step, and a derivative filter behind it would read a ramp
too high. y holds where the input holds, and where the sensor samples less often than at every
communication point.

Who must not take kept or interpolated values for measured ones finds the samples themselves beside
y: ``y_samples`` and ``sample_times`` have them where one was taken, and no value (NaN) elsewhere
and for what was lost. Their time is that at which they are reported, of a sensor with time stamps
the instant at which they were taken, in whole nanoseconds; there are none of before the start.

Each random effect has a stream of its own, PCG64 of the seed sequence of ``seed`` with the spawn
key 0 (noise), 1 (jitter) or 2 (dropouts). Every sample takes the same count of its words, so that
an effect that is switched on changes no number of another. Elements of a vector are independent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cosim.arrays import NAN, Mask, Matrix, Vector
from cosim.blocks.field_data import SAMPLE_TIMES, samples_of
from cosim.blocks.measurement import (
    MeasuringChain,
    SampleStreams,
    SamplingInstants,
    SensorParameters,
    StreamState,
)
from cosim.core.clock import NANOSECONDS
from cosim.core.contracts import Design
from cosim.core.signals import Interface, Signal
from cosim.errors import UsageError, steps_text


@dataclass(frozen=True, slots=True)
class SensorState:
    """All that changes in a sensor; no array of it is written to.

    Parameters
    ----------
    past : Matrix
        Inputs at the last communication points before the time reached.
    y : Vector
        What y was before the time reached.
    valid : Mask
        The same of ``valid``.
    since : int
        Communication steps since the last sample before the time reached; the period where one is
        due now.
    streams : StreamState
    """

    past: Matrix
    y: Vector
    valid: Mask
    since: int
    streams: StreamState


@dataclass(frozen=True, slots=True)
class _Reported:
    """What is reported, one row a communication point.

    ``offset`` is the sampling instant minus t in communication steps; NaN: there is no new sample.
    """

    y: Matrix
    valid: Mask
    offset: Vector


class Sensor:
    """Reports its input u as y, and by ``valid`` whether the sample in y is new (1) or kept (0).

    The order of the effects is that of the module's description. ``valid`` is there where
    ``dropout`` is given; the first sample is never lost.

    Parameters
    ----------
    parameters : SensorParameters
    size : int
        Number of elements of u, y and valid.
    unit : str, optional
        The unit of u and y.
    samples : bool
        The samples are there beside y.
    stamped : bool
        Their times are the sampling instants.

    Raises
    ------
    UsageError
        If a parameter is not possible, or time stamps are not one for all elements, or after the
        time at which the sample is reported.
    """

    def __init__(
        self,
        parameters: SensorParameters,
        *,
        size: int = 1,
        unit: str | None = None,
        samples: bool = False,
        stamped: bool = False,
    ) -> None:
        if stamped:
            _check_stamps(parameters, size)
        self._size = size
        self._samples = samples
        self._stamped = stamped
        self._step = 0.0
        self._begin = 0.0
        self._period = parameters.period
        self._drops = parameters.dropout is not None
        self._instants = SamplingInstants(parameters, size)
        self._chain = MeasuringChain(parameters, size)
        self._streams = SampleStreams(parameters, size)
        self._held = np.zeros(size, np.bool_)
        self.interface = self._interface(size, unit)

    def _interface(self, size: int, unit: str | None) -> Interface:
        u = Signal("u", size, unit)
        y = Signal("y", size, unit, "inherited" if self._period == 1 else "discrete")
        outputs: tuple[Signal, ...] = (y,)
        if self._drops:
            valid = Signal("valid", size, variability="discrete", type="boolean")
            outputs = (y, valid)
        measured = ["y"]
        if self._samples:
            measured.append(samples_of("y"))
            of_y = Signal(samples_of("y"), size, unit, "discrete", optional=True)
            times = Signal(SAMPLE_TIMES, 1, "s", "discrete", optional=True)
            outputs += (of_y, times)
        now = self._instants.reach_now
        by_u = dict.fromkeys(measured, ("u",))
        return Interface(
            (u,),
            outputs,
            feedthrough=by_u if now else {},
            initial=by_u,
            delayed=() if now else ("u",),
            prepares=True,
            rollback=True,
        )

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Note which inputs hold within a step; there is nothing to record."""
        self._held = held.copy()
        self._step = h
        return recorded

    def initialize(self, t: float, u: Vector) -> Vector:
        """Begin all random sequences, with ``u`` as the input before ``t``."""
        self._streams.begin()
        self._begin = t
        self._past = np.tile(u, (self._instants.depth, 1))
        self._y = np.zeros(self._size)
        self._valid = np.ones(self._size, np.bool_)
        self._since = self._period
        return self.outputs(t, u)

    def outputs(self, t: float, u: Vector) -> Vector:
        """Return what is reported at ``t``."""
        reported = self._report(u[np.newaxis])
        row: Vector = self._outputs(np.array([t]), reported, 1)[0]
        return row

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Report K samples."""
        steps = len(t) - 1
        # row 0 again: its input may have been extrapolated when it was reported
        reported = self._report(u)
        self._keep_past(u[:steps])
        self._y = reported.y[steps].copy()
        self._valid = reported.valid[steps].copy()
        until_end = self._since + steps
        before_end = (until_end - 1) // self._period
        self._streams.skip(before_end)
        self._since = until_end - before_end * self._period
        return self._outputs(t[1:], reported, 2)

    def _keep_past(self, u: Matrix) -> None:
        depth = self._instants.depth
        if depth:
            known = np.concatenate((self._past, u))
            self._past = known[-depth:].copy()

    def _report(self, u: Matrix) -> _Reported:
        """Return what is reported before the time reached, then at the rows of ``u``."""
        row = np.arange(len(u))
        if self._period > 1:
            # from now to the first sample: none where a sample is due
            first = self._period - self._since
            row = row[first :: self._period]
        samples = self._streams.next(len(row))
        values = self._instants.values(self._past, u, row, samples.position, self._held)
        measured = self._chain.values(values, samples.noise)
        y = np.concatenate((self._y[np.newaxis], measured))
        valid = np.concatenate((self._valid[np.newaxis], ~samples.lost))
        if self._drops:
            y = _kept(y, valid)
        if self._period > 1:
            until_row = self._since + np.arange(len(u))
            latest = np.concatenate(([0], until_row // self._period))
            offset = np.concatenate(([NAN], samples.position[:, 0]))[latest]
            offset[np.append(True, until_row % self._period > 0)] = NAN
            return _Reported(y[latest], valid[latest], offset)
        offset = np.concatenate(([NAN], samples.position[:, 0]))
        return _Reported(y, valid, offset)

    def _outputs(self, t: Vector, reported: _Reported, first: int) -> Matrix:
        """Return the outputs at ``t``, which are those of the rows from ``first`` on."""
        y = reported.y[first:]
        valid = reported.valid[first:]
        columns = [y]
        if self._drops:
            columns.append(valid.astype(np.float64))
        if self._samples:
            offset = reported.offset[first:, np.newaxis]
            instants = t[:, np.newaxis]
            if self._stamped:
                ns = np.rint((instants + offset * self._step) * NANOSECONDS)
                instants = ns / NANOSECONDS
            is_new = np.isfinite(offset) & (instants >= self._begin)
            columns.append(np.where(is_new & valid, y, NAN))
            columns.append(np.where(is_new, instants, NAN))
        return np.concatenate(columns, axis=1)

    def save(self) -> SensorState:
        """Copy the state."""
        streams = self._streams.save()
        return SensorState(self._past, self._y, self._valid, self._since, streams)

    def restore(self, state: SensorState) -> None:
        """Go back to a saved state."""
        self._past = state.past
        self._y = state.y
        self._valid = state.valid
        self._since = state.since
        self._streams.restore(state.streams)


def _check_stamps(parameters: SensorParameters, size: int) -> None:
    if parameters.jitter and size > 1:
        raise UsageError(
            f"time_stamps: found jitter and size {size}; needed one sampling instant for all "
            "elements: no jitter, or a sensor for each element"
        )
    if parameters.latest > 0.0:
        raise UsageError(
            f"time_stamps: found a jitter of {steps_text(parameters.jitter)} and a delay of "
            f"{steps_text(parameters.delay)}; needed a delay of at least the jitter, so that no "
            "sample is taken after it is reported"
        )


def _kept(y: Matrix, valid: Mask) -> Matrix:
    """Return ``y``, each value that is not valid replaced by the last valid one; row 0 is past."""
    if valid.all():
        return y
    row = np.arange(len(y))[:, np.newaxis]
    last_valid = np.maximum.accumulate(np.where(valid, row, 0), axis=0)
    return np.take_along_axis(y, last_valid, axis=0)
