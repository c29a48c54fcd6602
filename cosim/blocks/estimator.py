"""An estimator as a component: what all methods of identification have in common."""

from __future__ import annotations

from types import MappingProxyType
from typing import Final, Generic, Protocol

import numpy as np

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.contracts import Design, State, Stopped, check_design
from cosim.core.signals import Interface, Signal
from cosim.native.blocks.wrapping import kept_step
from cosim.native.step import FULL, NO_VALUE, OUTSIDE, NativeStep

GRIDS: Final = "grids"  # the array of a design that has the grids of starts
_NO_VALUE: Final = (
    "an input is NaN at {time} s, after the identification start time; start after the delays"
)
_PROBLEMS: Final = MappingProxyType(
    {
        FULL: "no room for more samples at {time} s",
        OUTSIDE: "a sample at {time} s has a time stamp before the previous communication point; "
        "expected the samples of this step",
    }
)
_TEXTS: Final = MappingProxyType(
    {
        "regressor": "signals mu of the regression",
        "delta": "reconstructed disturbance",
        "sample_times": "instants of the samples of a step",
        "samples": "measured outputs at these instants",
        "theta": "estimated parameters of the disturbance",
        "standard_error": "standard errors of theta",
        "deviation": "standard deviation of the noise of y",
        "amplitude": "estimated amplitudes of the disturbance",
        "eta": "estimated coefficients of the regression",
    }
)


class EstimatorKernel(Protocol[State]):
    """A native step with its memory, which can go back."""

    step: NativeStep

    def initialize(self) -> Vector:
        """Forget the past and return the outputs, which have no value yet."""

    def save(self) -> State:
        """Copy the state."""

    def restore(self, state: State) -> None:
        """Return to a saved state."""


class SteppableEstimator(Protocol[State]):
    """A method of identification: what it needs once, and the kernel that takes the samples."""

    @property
    def interface(self) -> Interface:
        """Inputs of role input, the output theta, and what else the method has."""

    def design(self, h: float, held: Mask) -> Design:
        """Compute what needs linear algebra, to be recorded.

        Parameters
        ----------
        h : float
            Communication step [s].
        held : Mask
            Inputs with a zero-order hold.
        """

    def kernel(self, h: float, held: Mask, design: Design) -> EstimatorKernel[State]:
        """Return a kernel without samples."""


class Estimator(Generic[State]):
    """Runs a method of identification.

    The outputs have no value (NaN) until the data determine them. An estimate rests on the samples
    up to its instant.

    Parameters
    ----------
    method : SteppableEstimator
    no_value : str
        What is said where an input that counts has no value.

    Raises
    ------
    Stopped
        From ``advance``, where an input that counts has no value, a sample is said to be of an
        instant outside its step, or there is no room for more samples.
    """

    def __init__(self, method: SteppableEstimator[State], *, no_value: str = _NO_VALUE) -> None:
        self.method = method
        self.interface = method.interface
        self._problems = {**_PROBLEMS, NO_VALUE: no_value}

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Compute the design, or take the recorded design."""
        computed = self.method.design(h, held)
        design = dict(recorded or computed)
        shapes = {name: array.shape for name, array in computed.items()}
        if GRIDS not in design:  # older logs have one for all data
            shapes.pop(GRIDS, None)
        check_design(design, shapes)
        self._kernel = self.method.kernel(h, held, design)
        self._last = np.empty(self.interface.n_y)
        return design

    def initialize(self, t: float, u: Vector) -> Vector:
        """Forget all samples; there is no estimate yet."""
        self._last[:] = self._kernel.initialize()
        return self._last.copy()

    def outputs(self, t: float, u: Vector) -> Vector:
        """Return the last estimate; the inputs at this instant do not change it."""
        return self._last.copy()

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Take the samples of K steps."""
        step = self._kernel.step
        y = step.advance(t, h, u)
        if len(y):
            self._last[:] = y[-1]
        if step.status in self._problems:
            problem = self._problems[step.status]
            raise Stopped(y, problem.format(time=float(t[len(y)])))
        return y

    def native(self) -> NativeStep:
        """Return the compiled step."""
        return kept_step(self._kernel.step, self._last)

    def save(self) -> tuple[State, Vector]:
        """Copy the state and the estimate."""
        return self._kernel.save(), self._last.copy()

    def restore(self, state: tuple[State, Vector]) -> None:
        """Return to a saved state."""
        memory, last = state
        self._kernel.restore(memory)
        self._last[:] = last


def optional_input(name: str, size: int) -> Signal:
    """Return an input that may have no value yet."""
    return Signal(name, size, optional=True, role="input", description=_TEXTS[name])


def estimate(name: str, size: int) -> Signal:
    """Return an output that has no value until the data determine it."""
    return Signal(name, size, optional=True, role="estimate", description=_TEXTS[name])
