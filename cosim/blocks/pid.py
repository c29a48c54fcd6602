"""PID controller with anti-windup, continuous in time or sampled.

After Astrom and Hagglund, Advanced PID Control (2006), chapters 3 and 13, with the setpoint r and
the measurement z::

    y = v within lower and upper,   v = K (b r - z) + I + D
    I' = K/Ti (r - z) + (y - v)/Tt                      back-calculation: no windup
    D' = N/Td (K Td (c r' - z') - D)                    derivative, limited to the gain K N

With limits the right-hand side of I is continuous and linear on each side of a limit. A step takes
v - I as a straight line, solves each side in closed form, and finds where y reaches and leaves a
limit, unless it does both within one step: exact but for that for inputs that are straight lines,
without a derivative part or without limits, else of second order.

Sampled with the period h, at the samples k::

    I[k+1] = I[k] + h K/Ti (r - z)[k] + h/Tt (y - v)[k]                        forward Euler
    D[k] = (Td D[k-1] + K Td N ((c r - z)[k] - (c r - z)[k-1]))/(Td + N h)     backward Euler
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.contracts import Design
from cosim.core.linearization import Linearized
from cosim.core.signals import Interface, Signal
from cosim.errors import UsageError
from cosim.native.blocks.control import LARGEST_NUMBER, PidConstants, PidStep
from cosim.native.step import NativeStep


@dataclass(frozen=True, slots=True)
class PidParameters:
    """The parameters of a PID controller, in ISA form.

    Parameters
    ----------
    gain : float
        K; negative where the measurement falls with y.
    integral_time : float or None
        Ti [s]; None: no integral part.
    derivative_time : float
        Td [s].
    derivative_gain_limit : float
        N.
    setpoint_weight, derivative_setpoint_weight : float
        b and c.
    lower, upper : float or None
        Limits of y.
    tracking_time : float or None
        Tt [s]; None: sqrt(Ti Td), without a derivative part Ti.
    initial_integral : float
        I(0); without an integral part it stays. D(0) is 0, so that y(0) = K (b r - z) + I(0).

    Raises
    ------
    UsageError
        If they are not those of a controller.
    """

    gain: float
    integral_time: float | None = None
    derivative_time: float = 0.0
    derivative_gain_limit: float = 10.0
    setpoint_weight: float = 1.0
    derivative_setpoint_weight: float = 0.0
    lower: float | None = None
    upper: float | None = None
    tracking_time: float | None = None
    initial_integral: float = 0.0

    def __post_init__(self) -> None:
        _require(self.gain != 0.0, "gain", self.gain, "a number other than 0")
        _require(
            self.derivative_time >= 0.0, "derivative_time", self.derivative_time, "a time >= 0 s"
        )
        limit = self.derivative_gain_limit
        _require(limit > 0.0, "derivative_gain_limit", limit, "a number > 0")
        for name in ("integral_time", "tracking_time"):
            time = getattr(self, name)
            _require(time is None or time > 0.0, name, time, "a time > 0")
        lower, upper = self.limits
        _require(lower < upper, "lower and upper", (lower, upper), "lower < upper")
        if self.tracking_time is not None and not self._tracks:
            raise UsageError(
                "pid: tracking_time requires integral_time and lower or upper: it is the time "
                "constant of anti-windup"
            )

    @property
    def limits(self) -> tuple[float, float]:
        """Both limits of y; those that are none are the largest numbers."""
        lower = -LARGEST_NUMBER if self.lower is None else self.lower
        upper = LARGEST_NUMBER if self.upper is None else self.upper
        return lower, upper

    @property
    def _tracks(self) -> bool:
        is_limited = self.lower is not None or self.upper is not None
        return is_limited and self.integral_time is not None

    def constants(self, period: float | None) -> PidConstants:
        """Return the numbers of the step; ``period`` [s], None: continuous in time.

        Raises
        ------
        UsageError
            If the tracking time is shorter than the period: the integral part would overshoot.
        """
        lower, upper = self.limits
        filter_rate = 0.0
        derivative_gain = 0.0
        if self.derivative_time > 0.0:
            filter_rate = self.derivative_gain_limit / self.derivative_time
            derivative_gain = self.gain * self.derivative_gain_limit
            if period is not None:
                derivative_gain /= 1.0 + filter_rate * period
        integral_gain = 0.0 if self.integral_time is None else self.gain / self.integral_time
        return PidConstants(
            self.gain,
            integral_gain,
            derivative_gain,
            self.setpoint_weight,
            self.derivative_setpoint_weight,
            filter_rate,
            self._tracking_rate(period),
            lower,
            upper,
            self.initial_integral,
        )

    def _tracking_rate(self, period: float | None) -> float:
        if not self._tracks or self.integral_time is None:
            return 0.0
        time = self.tracking_time
        if time is None:
            time = self.integral_time
            if self.derivative_time > 0.0:
                time = math.sqrt(self.integral_time * self.derivative_time)
        if period is not None and time < period:
            raise UsageError(
                f"pid: tracking_time: expected at least the period of {period} s, got {time} s"
            )
        return 1.0 / time


def _require(is_met: bool, name: str, value: object, needed: str) -> None:
    if not is_met:
        raise UsageError(f"pid: {name}: expected {needed}, got {value}")


class Pid:
    """A PID controller: inputs setpoint and measurement, outputs y and integral, which is I.

    Parameters
    ----------
    parameters : PidParameters
    period : float, optional
        [s]; it is sampled, and each of its steps is one period:
        ``Sampled(Pid(parameters, period=n * h), n, hold=True)``.
    unit : str, optional
        The unit of y.
    """

    def __init__(
        self, parameters: PidParameters, *, period: float | None = None, unit: str | None = None
    ) -> None:
        self.constants = parameters.constants(period)
        self._period = period
        inputs = (Signal("setpoint", role="input"), Signal("measurement", role="input"))
        y = Signal("y", 1, unit)
        integral = Signal("integral", 1, unit, role="state")
        feedthrough = {"y": _feeding(self.constants)}
        self.interface = Interface(
            inputs,
            (y, integral),
            feedthrough,
            prepares=True,
            rollback=True,
            native=True,
            linearizable=True,
            substeps=period is None,
            continuous=True,
        )

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Take which inputs are held; there is nothing to record."""
        self._kernel = PidStep(self.constants, held, sampled=self._period is not None)
        return recorded

    def prepare_substeps(self, lengths: tuple[float, ...], recorded: Design) -> Design:
        """Return what is recorded: nothing depends on the length of a step."""
        return recorded

    def initialize(self, t: float, u: Vector) -> Vector:
        """Begin with the initial integral part, and no derivative part."""
        self._kernel.initialize(u)
        return self.outputs(t, u)

    def outputs(self, t: float, u: Vector) -> Vector:
        """Return y and the integral part."""
        return self._kernel.outputs(u)

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Advance by K steps."""
        return self._kernel.step.advance(t, h, u)

    def native(self) -> NativeStep:
        """Return the compiled step."""
        return self._kernel.step

    def linearized(self, t: float, u: Vector) -> Linearized:
        """Return the controller between its limits; states are I and what D lacks of its input.

        At the start a limit may be reached that is left at once, so that it would say little.
        """
        numbers = self.constants
        proportional = numbers.gain * np.array([numbers.setpoint_weight, -1.0])
        of_error = numbers.integral_gain * np.array([1.0, -1.0])
        derivative = numbers.derivative_gain * np.array([numbers.derivative_weight, -1.0])
        decay = -numbers.filter_rate
        if self._period is not None:
            of_error = of_error * self._period
            decay = 1.0 / (1.0 + numbers.filter_rate * self._period) - 1.0
        A = np.diag([0.0, decay])
        B = np.vstack([of_error, decay * derivative])
        C = np.array([[1.0, 1.0], [1.0, 0.0]])
        D = np.vstack([proportional + derivative, np.zeros(2)])
        changes = B.any(axis=1)  # a part that there is none of would be a state that stays
        A = A[np.ix_(changes, changes)]
        B = B[changes]
        C = C[:, changes]
        if self._period is None:
            return Linearized(A, B, C, D)
        A = A + np.eye(len(A))
        return Linearized(A, B, C, D, input_use="start", is_discrete=True, own_steps=1)

    def save(self) -> Vector:
        """Copy the state."""
        return self._kernel.step.save()

    def restore(self, state: Vector) -> None:
        """Go back to a saved state."""
        self._kernel.step.restore(state)


def _feeding(constants: PidConstants) -> tuple[str, ...]:
    """Return the inputs that y depends on directly."""
    proportional = constants.setpoint_weight != 0.0
    derivative = constants.derivative_gain != 0.0 and constants.derivative_weight != 0.0
    return ("setpoint", "measurement") if proportional or derivative else ("measurement",)
