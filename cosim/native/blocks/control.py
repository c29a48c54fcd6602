"""The steps of ``control.c``: an integrator with limits, and PID controllers."""

from __future__ import annotations

import ctypes
import sys
from ctypes import c_double, c_int32, c_void_p
from dataclasses import astuple, dataclass

import numpy as np

from cosim.arrays import Mask, Vector
from cosim.native.library import address, declare, library, pointer
from cosim.native.step import NativeStep

LARGEST_NUMBER = sys.float_info.max  # a limit that no value reaches


class IntegratorStruct(ctypes.Structure):
    """cosim_integrator."""

    _fields_ = (
        ("width", c_int32),
        *((name, c_double) for name in ("lower", "upper")),
        *((name, c_void_p) for name in ("held", "memory")),
    )


class PidStruct(ctypes.Structure):
    """cosim_pid."""

    _fields_ = (
        *((name, c_double) for name in ("gain", "integral_gain", "derivative_gain")),
        *((name, c_double) for name in ("setpoint_weight", "derivative_weight")),
        *((name, c_double) for name in ("filter_rate", "tracking_rate")),
        *((name, c_double) for name in ("lower", "upper", "initial_integral")),
        *((name, c_void_p) for name in ("held", "memory")),
    )


declare(
    {
        "cosim_pid_start": (None, (c_void_p, c_void_p)),
        "cosim_pid_outputs": (None, (c_void_p, c_void_p, c_void_p)),
    }
)


def integrator_step(lower: float, upper: float, held: Mask) -> NativeStep:
    """Build an integrator with limits; its memory is x, shape (n,).

    ``held``, shape (n,): which inputs have a zero-order hold.
    """
    width = len(held)
    memory = np.zeros(width)
    flags = held.astype(np.uint8)
    state = IntegratorStruct(width, lower, upper, pointer(flags), pointer(memory))
    function = address("cosim_integrator_step")
    outputs = address("cosim_integrator_refresh")
    return NativeStep(
        function,
        state,
        n_y=width,
        memory=memory,
        keep=(flags,),
        outputs=outputs,
        memory_is_state=True,
    )


@dataclass(frozen=True, slots=True)
class PidConstants:
    """The numbers of cosim_pid, in their order there; ``control.c`` has the equations.

    Parameters
    ----------
    gain, integral_gain, derivative_gain : float
    setpoint_weight, derivative_weight : float
        Of the setpoint in the proportional and in the derivative part.
    filter_rate, tracking_rate : float
        [1/s]; tracking rate 0: there are no limits.
    lower, upper : float
    initial_integral : float
    """

    gain: float
    integral_gain: float
    derivative_gain: float
    setpoint_weight: float
    derivative_weight: float
    filter_rate: float
    tracking_rate: float
    lower: float
    upper: float
    initial_integral: float

    @property
    def is_limited(self) -> bool:
        """Whether y has a limit that it can reach."""
        return self.lower > -LARGEST_NUMBER or self.upper < LARGEST_NUMBER

    @property
    def numbers(self) -> tuple[float, ...]:
        """All of them, in order."""
        return astuple(self)


class PidStep:
    """The step of a PID controller with its initialization and its outputs.

    Parameters
    ----------
    constants : PidConstants
    held : Mask, shape (2,)
        Which inputs have a zero-order hold.
    sampled : bool
        Euler's methods from sample to sample, instead of what is continuous in time.
    """

    def __init__(self, constants: PidConstants, held: Mask, *, sampled: bool) -> None:
        memory = np.zeros(2)
        flags = held.astype(np.uint8)
        state = PidStruct(*constants.numbers, pointer(flags), pointer(memory))
        function = address("cosim_sampled_pid_step" if sampled else "cosim_pid_step")
        outputs = address("cosim_pid_refresh")
        self.step = NativeStep(
            function,
            state,
            n_y=2,
            memory=memory,
            keep=(flags,),
            outputs=outputs,
            memory_is_state=True,
        )

    def initialize(self, u: Vector) -> None:
        """Begin with the initial integral part, and as if the inputs had been constant before."""
        state = ctypes.addressof(self.step.state)
        inputs = np.ascontiguousarray(u)
        library.cosim_pid_start(state, pointer(inputs))

    def outputs(self, u: Vector) -> Vector:
        """Compute y and the integral part, for inputs ``u`` at the time reached."""
        state = ctypes.addressof(self.step.state)
        inputs = np.ascontiguousarray(u)
        y = np.empty(2)
        library.cosim_pid_outputs(state, pointer(inputs), pointer(y))
        return y
