"""A linear model beside moving averages with a fixed lag: over a window, or exponential ones.

What is averaged is a signal that is known by parts, ``rate + level'``. The increment of its
integral over a step, ``Jx x(t) + J0 u(t) + J1 u(t+h)``, is exact for the level whatever it does
within the step.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from cosim.arrays import Mask, Matrix, Vector, frozen
from cosim.core.contracts import Design, check_design
from cosim.core.linear import LinearModel
from cosim.core.signals import Interface, Signal
from cosim.errors import UsageError
from cosim.native.blocks.window import WindowConstants, WindowStep, window_memory
from cosim.native.numerics.linear import DiscretizedDynamics, affine, first_order_hold, linear_step
from cosim.native.step import LARGEST_MEMORY, NativeStep


@dataclass(frozen=True, slots=True)
class AveragedModel:
    """A linear model, and signals to be averaged.

    Its last two outputs are their ``rate`` and ``level``, which are not shown.

    Parameters
    ----------
    linear : LinearModel
    lagging : tuple of Signal
        What the averages are called; together of the size of ``rate``.
    """

    linear: LinearModel
    lagging: tuple[Signal, ...]

    @property
    def width(self) -> int:
        """The number of averages."""
        return sum(signal.size for signal in self.lagging)

    @property
    def direct(self) -> slice:
        """The rows of the outputs that are shown as they are."""
        return slice(0, len(self.linear.C) - 2 * self.width)

    @property
    def rate(self) -> slice:
        """The rows of the rate."""
        return slice(self.direct.stop, self.direct.stop + self.width)

    @property
    def level(self) -> slice:
        """The rows of the level."""
        return slice(self.rate.stop, None)

    def interface(self, *, window: bool) -> Interface:
        """Return inputs, direct outputs, then the averages.

        They follow the inputs at once, by the newest increment; those over a ``window`` have no
        value at first.
        """
        linear = self.linear.interface
        inputs = tuple(signal.name for signal in linear.inputs)
        direct = linear.outputs[:-2]
        feedthrough = {}
        initial = {}
        for signal in direct:
            feedthrough[signal.name] = linear.feeds(signal.name)
            initial[signal.name] = linear.feeds_initially(signal.name)
        for signal in self.lagging:
            feedthrough[signal.name] = inputs
        lagging = [replace(signal, optional=window) for signal in self.lagging]
        outputs = (*direct, *lagging)
        return Interface(
            linear.inputs,
            outputs,
            feedthrough,
            initial,
            prepares=True,
            rollback=True,
            native=True,
            continuous=True,
        )

    def increments(self, h: float, held: Mask) -> dict[str, Matrix]:
        """Discretize for steps of ``h`` [s]; return the arrays by name."""
        model = self.linear
        n = len(model.states)
        # the integral of rate is a state beside those of the model
        no_effect = np.zeros((n + self.width, self.width))
        by_state = np.vstack([model.A, model.C[self.rate]])
        A = np.hstack([by_state, no_effect])
        B = np.vstack([model.B, model.D[self.rate]])
        discrete = first_order_hold(A, B, h, held)
        Ad = discrete.Ad[:n, :n]
        B0 = discrete.B0[:n]
        B1 = discrete.B1[:n]
        C_level = model.C[self.level]
        D_level = model.D[self.level]
        Jx = discrete.Ad[n:, :n] + C_level @ (Ad - np.eye(n))
        J0 = discrete.B0[n:] + C_level @ B0 - D_level
        J1 = discrete.B1[n:] + C_level @ B1 + D_level
        arrays = {
            "Ad": Ad,
            "B0": B0,
            "B1": B1,
            "C": model.C[self.direct],
            "D": model.D[self.direct],
            "Jx": Jx,
            "J0": J0,
            "J1": J1,
            "X0": model.X0,
            "Xu": model.Xu,
        }
        return {name: np.ascontiguousarray(array) for name, array in arrays.items()}

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """The shapes of these arrays."""
        n, m = self.linear.B.shape
        p = self.direct.stop
        width = self.width
        return {
            "Ad": (n, n),
            "B0": (n, m),
            "B1": (n, m),
            "C": (p, n),
            "D": (p, m),
            "Jx": (width, n),
            "J0": (width, m),
            "J1": (width, m),
            "X0": (n,),
            "Xu": (n, m),
        }


class Windowed:
    """Averages over a window: weighted sums of the increments of the last steps.

    They have no value (NaN) until the window is full.

    Parameters
    ----------
    model : AveragedModel
    weights : Vector
        Of the increments, the oldest first [1/s].

    Raises
    ------
    UsageError
        If the window is too long to be kept.
    """

    def __init__(self, model: AveragedModel, weights: Vector) -> None:
        taps = len(weights)
        if window_memory(len(model.linear.states), taps, model.width) > LARGEST_MEMORY:
            raise UsageError(
                f"a window of {taps} communication steps of {model.width} signals is too large; "
                f"expected at most {LARGEST_MEMORY} numbers in all"
            )
        self._model = model
        self._weights = frozen(weights, 1)
        self.interface = model.interface(window=True)

    def design(self, h: float, held: Mask) -> dict[str, Matrix]:
        """Discretize for steps of ``h`` [s]; return the arrays by name."""
        return {**self._model.increments(h, held), "weights": self._weights}

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Discretize, or take the recorded arrays."""
        arrays = dict(recorded) or self.design(h, held)
        check_design(arrays, {**self._model.shapes, "weights": self._weights.shape})
        self._arrays = arrays
        self._kernel = WindowStep(window_constants(arrays))
        return arrays

    def initialize(self, t: float, u: Vector) -> Vector:
        """Set the initial state, with an empty window."""
        self._kernel.start(_initial_state(self._arrays, u))
        return self._kernel.outputs(u)

    def outputs(self, t: float, u: Vector) -> Vector:
        """Return the outputs at the time reached."""
        return self._kernel.outputs(u)

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Take K steps."""
        return self._kernel.step.advance(t, h, u)

    def native(self) -> NativeStep:
        """Return the compiled step."""
        return self._kernel.step

    def save(self) -> Vector:
        """Copy state and window."""
        return self._kernel.step.save()

    def restore(self, state: Vector) -> None:
        """Return to a saved state and window."""
        self._kernel.step.restore(state)


def window_constants(arrays: Design) -> WindowConstants:
    """Return the numbers of the step among the arrays of :meth:`Windowed.design`."""
    discrete = DiscretizedDynamics(arrays["Ad"], arrays["B0"], arrays["B1"])
    return WindowConstants(
        discrete,
        C=arrays["C"],
        D=arrays["D"],
        Jx=arrays["Jx"],
        J0=arrays["J0"],
        J1=arrays["J1"],
        weights=arrays["weights"],
    )


class Smoothed:
    """Averages with exponential weights.

    ``e(t+h) = a e(t) + g (Jx x(t) + J0 u(t) + J1 u(t+h))`` with ``a = exp(-rate h)`` and
    ``g = (1 - a)/h``. The state beside that of the model is ``s = e - g J1 u``, so that an input
    that is extrapolated first and corrected later does no harm.

    Parameters
    ----------
    model : AveragedModel
    rate : float
        [1/s].
    start : Matrix, shape (width, width)
        Initially e is this times the rate of what is averaged.
    """

    def __init__(self, model: AveragedModel, rate: float, start: Matrix) -> None:
        self._model = model
        self._rate = rate
        self._start = start
        self.interface = model.interface(window=False)

    def design(self, h: float, held: Mask) -> dict[str, Matrix]:
        """Discretize for steps of ``h`` [s]; return the arrays by name."""
        model = self._model
        linear = model.linear
        increments = model.increments(h, held)
        width = model.width
        n = len(linear.states)
        a = math.exp(-self._rate * h)
        g = -math.expm1(-self._rate * h) / h
        at_once = g * increments["J1"]
        no_effect = np.zeros((n, width))
        decay = a * np.eye(width)
        s_of_u = g * increments["J0"] + a * at_once
        initial_of_x = self._start @ linear.C[model.rate]
        initial_of_u = self._start @ linear.D[model.rate] - at_once
        s = np.hstack([np.zeros((width, n)), np.eye(width)])
        direct = np.hstack([increments["C"], np.zeros((len(increments["C"]), width))])
        initial_s = initial_of_x @ linear.X0
        initial_s_of_u = initial_of_x @ linear.Xu + initial_of_u
        return {
            "Ad": np.block([[increments["Ad"], no_effect], [g * increments["Jx"], decay]]),
            "B0": np.vstack([increments["B0"], s_of_u]),
            "B1": np.vstack([increments["B1"], np.zeros(s_of_u.shape)]),
            "C": np.vstack([direct, s]),
            "D": np.vstack([increments["D"], at_once]),
            "X0": np.concatenate([linear.X0, initial_s]),
            "Xu": np.vstack([linear.Xu, initial_s_of_u]),
        }

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Discretize, or take the recorded arrays."""
        arrays = dict(recorded) or self.design(h, held)
        check_design(arrays, self._shapes())
        self._arrays = arrays
        discrete = DiscretizedDynamics(arrays["Ad"], arrays["B0"], arrays["B1"])
        self._step: NativeStep = linear_step(discrete, arrays["C"], arrays["D"])
        return arrays

    def _shapes(self) -> dict[str, tuple[int, ...]]:
        linear = self._model.linear
        m = linear.B.shape[1]
        n = len(linear.states) + self._model.width
        p = self._model.direct.stop + self._model.width
        by_u = (n, m)
        shapes = {"Ad": (n, n), "B0": by_u, "B1": by_u, "C": (p, n), "D": (p, m)}
        return {**shapes, "X0": (n,), "Xu": by_u}

    @property
    def _state(self) -> Vector:
        return self._step.memory[: len(self._arrays["X0"])]

    def initialize(self, t: float, u: Vector) -> Vector:
        """Set the initial state."""
        self._state[:] = _initial_state(self._arrays, u)
        return self.outputs(t, u)

    def outputs(self, t: float, u: Vector) -> Vector:
        """Return the outputs at the time reached."""
        return affine([(self._arrays["C"], self._state), (self._arrays["D"], u)])

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Take K steps."""
        return self._step.advance(t, h, u)

    def native(self) -> NativeStep:
        """Return the compiled step."""
        return self._step

    def save(self) -> Vector:
        """Copy the state."""
        return self._step.save()

    def restore(self, state: Vector) -> None:
        """Return to a saved state."""
        self._step.restore(state)


def _initial_state(arrays: Design, u: Vector) -> Vector:
    """Return the state at the start for inputs ``u``."""
    return arrays["X0"] + affine([(arrays["Xu"], u)])
