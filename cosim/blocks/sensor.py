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
too high. y holds where the input holds, and where the sensor has a period of its own.

Who must not take kept or interpolated values for measured ones finds the samples themselves beside
y: ``y_samples`` and ``sample_times`` have them where one was taken, and no value (NaN) elsewhere
and for what was lost. Their time is that at which they are reported, of a sensor with time stamps
the instant at which they were taken, in whole nanoseconds; there are none of before the start.

Each random effect has a stream of its own, PCG64 of the seed sequence of ``seed`` with the spawn
key 0 (noise), 1 (jitter) or 2 (dropouts). Every sample takes the same count of its words, so that
an effect that is switched on changes no number of another. Elements of a vector are independent.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cosim.arrays import Mask, Matrix, Vector
from cosim.blocks.measurement import (
    MeasuringChain,
    SampleStreams,
    SamplingInstants,
    SensorParameters,
    StreamState,
)
from cosim.core.contracts import Design
from cosim.core.linearization import Linearized, static
from cosim.core.signals import SAMPLE_TIMES, Interface, Signal, samples_of
from cosim.errors import UsageError, steps_text
from cosim.native.blocks.sensor import SensorConstants, SensorStep
from cosim.native.step import NativeStep


@dataclass(frozen=True, eq=False, slots=True)
class SensorState:
    """All that changes in a sensor; no array of it is written to.

    Parameters
    ----------
    memory : Vector
        Of the kernel: what it has kept of samples and inputs.
    streams : StreamState
        The random numbers.
    """

    memory: Vector
    streams: StreamState


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
    holds : bool
        y holds between samples also where there is one at every communication point.

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
        holds: bool = False,
    ) -> None:
        if stamped:
            _check_stamps(parameters, size)
        self._samples = samples
        self._period = parameters.period
        self._holds = holds or parameters.period > 1
        self._drops = parameters.dropout is not None
        self._delay = parameters.delay
        # What is sampled between two communication points, or lost, is no linear function of them.
        is_regular = not (parameters.jitter or self._drops or parameters.delay % 1.0)
        self._is_linear = is_regular and (self._period == 1 or not parameters.delay)
        self._instants = SamplingInstants(parameters, size)
        chain = MeasuringChain(parameters, size)
        self._quantizes = chain.levels is not None
        self._streams = SampleStreams(parameters, size)
        constants = SensorConstants(
            depth=self._instants.depth,
            period=self._period,
            drops=self._drops,
            samples=samples,
            stamps=stamped,
            bias=chain.bias,
            lower=chain.lower,
            upper=chain.upper,
            levels=chain.levels,
        )
        self._kernel = SensorStep(constants, self._streams.drawn)
        self.interface = self._interface(size, unit)

    def _interface(self, size: int, unit: str | None) -> Interface:
        u = Signal("u", size, unit)
        y = Signal("y", size, unit, "discrete" if self._holds else "inherited")
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
            jumping=("y",) if now and self._quantizes and not self._holds else (),
            prepares=True,
            rollback=True,
            native=True,
            linearizable=self._is_linear,
            samples=True,
        )

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Note which inputs hold within a step; there is nothing to record."""
        self._kernel.held[:] = held
        self._kernel.set_step(h)
        return recorded

    def initialize(self, t: float, u: Vector) -> Vector:
        """Begin all random sequences, with ``u`` as the input before ``t``."""
        self._streams.begin()
        self._kernel.start(t, u)
        return self.outputs(t, u)

    def outputs(self, t: float, u: Vector) -> Vector:
        """Return what is reported at ``t``."""
        y = self._kernel.step.outputs_at(t, u)
        assert y is not None
        return y

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Report K samples."""
        return self._kernel.step.advance_through(t, h, u, self._draw_more)

    def _draw_more(self, k: int) -> None:
        """Draw the random numbers of the next steps."""
        self._streams.draw_more()
        self._kernel.next = 0

    def linearized(self, t: float, u: Vector) -> Linearized | None:
        """Return what y is of u: the same, later where it is late, held where it is sampled.

        That is between the limits, and of many levels.
        """
        D = np.zeros((self.interface.n_y, len(u)))
        D[: len(u)] = np.eye(len(u))
        if self._delay:
            return replace(static(D), delay=int(self._delay))
        if self._holds:
            return static(D).sampled(self._period, hold=False)
        return static(D)

    def native(self) -> NativeStep:
        """Return the compiled step: it takes the numbers that were drawn."""
        return self._kernel.step

    def save(self) -> SensorState:
        """Copy the state."""
        return SensorState(self._kernel.step.save(), self._streams.save())

    def restore(self, state: SensorState) -> None:
        """Go back to a saved state."""
        self._kernel.step.restore(state.memory)
        self._streams.restore(state.streams)


def _check_stamps(parameters: SensorParameters, size: int) -> None:
    if parameters.jitter and size > 1:
        raise UsageError(
            "time_stamps: expected one sampling instant for all elements, got jitter and size "
            f"{size}; omit jitter, or use one sensor per element"
        )
    if parameters.latest > 0.0:
        raise UsageError(
            "time_stamps: expected a delay of at least the jitter (samples are reported after "
            f"they are taken), got a jitter of {steps_text(parameters.jitter)} and a delay of "
            f"{steps_text(parameters.delay)}"
        )
