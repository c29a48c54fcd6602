"""The compensator: state feedback, feedforward, and an internal model that theta_hat switches on.

At the communication point t_k, with x_hat, delta_hat, y and r there::

    v        = -K x_hat + F delta_hat + N r                  before
    v        = -K x_hat + F delta_hat + N r - K_w (w - X x)  with the internal model
    u(t_k+1) = v within the limits
    w(t_k+1) = E w + Gamma e + H (u(t_k+1) - v),    e = y - r of the regulated outputs

where x is x_hat less its steady state under delta_hat and r. E, Gamma and H are those of
``w' = S(theta) w + b e - B_w (u - v)`` over a step, its inputs held; K_w, X and B_w are
interpolated between the thetas that they are designed for. The step of delay between x_hat and u,
which a digital controller has, opens the algebraic loop by which x_hat follows u.
:mod:`cosim.theory.compensation.design` has the reasons.

The internal model becomes active at the first point where the 95 % interval of every theta is in
the interval that it is certified for, and its standard error small enough. It follows theta_hat
from then on, as the error that it leaves is proportional to that of theta, which falls with the
samples; an estimate that does not satisfy the conditions is not taken, the last one that did stays.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import NAN, Mask, Matrix, Vector
from cosim.blocks.identification_problem import sampling_interface
from cosim.core.contracts import Design, check_design
from cosim.core.signals import Interface, Signal
from cosim.errors import LogError, UsageError
from cosim.native.blocks.compensator import CompensatorConstants, CompensatorStep
from cosim.native.numerics.linear import affine, matrix_exponential
from cosim.native.step import NativeStep
from cosim.theory.compensation.activation import Activation
from cosim.theory.compensation.design import (
    CertifiedCompensator,
    CompensatorGains,
    ControlledPlant,
    certify_compensator,
)
from cosim.theory.compensation.schedule import Schedule, blended, corner_weights
from cosim.theory.observers.observer import StateSpace


@dataclass(frozen=True, eq=False, kw_only=True)
class CompensatorOptions:
    """How a compensator runs.

    Parameters
    ----------
    state : str
        The input that is the estimate of the states.
    R : Matrix, shape (n, n_x)
        The states of the design model by those of the input.
    largest_error : float
        Largest standard error of theta with which the internal model is used: see
        :class:`Activation`.
    lower, upper : Vector, shape (n_u,)
        Limits of u.
    anti_windup : bool
        The internal model follows what the limits leave of u.
    regulated : tuple of int
        The regulated elements of y.
    n_y : int
        Elements of y.

    Raises
    ------
    UsageError
        If they are not those of a controller.
    """

    state: str
    R: Matrix
    largest_error: float
    lower: Vector
    upper: Vector
    anti_windup: bool
    regulated: tuple[int, ...]
    n_y: int

    def __post_init__(self) -> None:
        if not self.largest_error > 0.0:
            raise UsageError(
                f"compensator: largest_error: expected a number > 0, got {self.largest_error}"
            )
        if not (self.lower < self.upper).all():
            limits = (self.lower.tolist(), self.upper.tolist())
            raise UsageError(f"compensator: expected lower < upper, got {limits}")


class Compensator:
    """A controller that uses the estimates of observer and identifier; see the module.

    Parameters
    ----------
    gains : CompensatorGains
    plant, observer : StateSpace
        What its loop is certified with: see :class:`ControlledPlant`.
    options : CompensatorOptions
    """

    def __init__(
        self,
        gains: CompensatorGains,
        plant: StateSpace,
        observer: StateSpace,
        options: CompensatorOptions,
    ) -> None:
        self._gains = gains
        self._plant = plant
        self._observer = observer
        self.options = options
        self.interface = _interface(gains, options)
        self._columns = self.interface.input_columns()
        y = self._columns["y"].start
        self._regulated = [y + element for element in options.regulated]
        state = options.state
        known = [state, "delta", "r"] if gains.F.gain.size else [state, "r"]
        self._known = self._elements(known)

    # --- before the run ---

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Certify the loop and compute what a step needs, or take what was recorded."""
        arrays = dict(recorded) or self.design(self.certified(h, held), h)
        counts = _counts(arrays, len(self._gains.box.lower))
        check_design(arrays, self._shapes(counts))
        self._arrays = arrays
        self._counts = counts
        lower, upper = arrays["theta"]
        self._activation = Activation(lower, upper, self.options.largest_error)
        self._kernel = CompensatorStep(self._constants(arrays["before"]))
        return arrays

    def _constants(self, before: Matrix) -> CompensatorConstants:
        gains = self._gains
        parameters = len(gains.box.lower)
        columns = self._columns
        return CompensatorConstants(
            before=before,
            lower=self.options.lower,
            upper=self.options.upper,
            states=len(gains.model.b),
            known=self._known,
            regulated=self._regulated,
            reference=columns["r"].start,
            theta=columns["theta"].start if parameters else 0,
            standard_error=columns["standard_error"].start if parameters else 0,
            parameters=parameters,
            follows=gains.decay_rate is not None,
        )

    def certified(self, h: float, held: Mask) -> CertifiedCompensator:
        """Certify the loop with a communication step, and design the internal model for it.

        Raises
        ------
        AssumptionError
            If the loop is not stable, or that cannot be proven.
        """
        system = ControlledPlant(
            plant=self._plant,
            observer=self._observer,
            regulated=self.options.regulated,
            h=h,
            u_held=bool(held[self._columns[self.options.state]].all()),
            y_held=bool(held[self._columns["y"]].any()),
        )
        return certify_compensator(self._gains, system)

    def design(self, certified: CertifiedCompensator, h: float) -> dict[str, NDArray[np.float64]]:
        """Return the arrays that a step needs."""
        rates = [certified.base_rate, certified.rate, float(certified.cells)]
        finite = [rate if math.isfinite(rate) else 0.0 for rate in rates]
        gains = self._gains
        return {
            "before": self._of_known(gains.before),
            **self._nodes(certified.schedule),
            "S0": gains.model.S0,
            "S1": np.reshape(gains.model.S1, (len(gains.model.S1), *gains.model.S0.shape)),
            "b": gains.model.b,
            "theta": np.stack([gains.box.lower, gains.box.upper]),
            "h": np.array([h]),
            "certificate": np.array(finite),
        }

    def _nodes(self, schedule: Schedule | None) -> dict[str, NDArray[np.float64]]:
        """Return the gains of the internal model at the nodes; zeros where there is none."""
        gains = self._gains
        parameters = len(gains.box.lower)
        if schedule is None:
            shapes = self._shapes((0,) * parameters)
            return {name: np.zeros(shapes[name]) for name in ("K_w", "X", "H")}
        of_known = [self._of_known(X @ gains.deviation) for X in schedule.X]
        H = -schedule.B_w if self.options.anti_windup else np.zeros_like(schedule.B_w)
        nodes = tuple(count + 1 for count in schedule.counts)
        tables = {"K_w": schedule.K_w, "X": np.stack(of_known), "H": H}
        return {
            name: np.reshape(table, (*nodes, *table.shape[1:])) for name, table in tables.items()
        }

    def _of_known(self, of_x_a: Matrix) -> Matrix:
        """Return a gain of (x_a, delta, r) as one of the inputs."""
        n = self._gains.K.shape[1]
        return np.hstack([of_x_a[:, :n] @ self.options.R, of_x_a[:, n:]])

    def _shapes(self, counts: Sequence[int]) -> dict[str, tuple[int, ...]]:
        n_u = len(self._gains.K)
        n_w, p = self._gains.model.b.shape
        parameters = len(self._gains.box.lower)
        known = len(self._known)
        nodes = tuple(count + 1 for count in counts)
        return {
            "before": (n_u, known),
            "K_w": (*nodes, n_u, n_w),
            "X": (*nodes, n_w, known),
            "H": (*nodes, n_w, n_u),
            "S0": (n_w, n_w),
            "S1": (parameters, n_w, n_w),
            "b": (n_w, p),
            "theta": (2, parameters),
            "h": (1,),
            "certificate": (3,),
        }

    def _elements(self, names: Sequence[str]) -> list[int]:
        """Return the columns of some inputs."""
        elements: list[int] = []
        for name in names:
            columns = self._columns[name]
            elements.extend(range(columns.start, columns.stop))
        return elements

    # --- the run ---

    def initialize(self, t: float, u: Vector) -> Vector:
        """Begin without the internal model, with u = 0 or the limit next to it."""
        kernel = self._kernel
        kernel.u[:] = self._limited(np.zeros(len(self._gains.K)))
        kernel.w[:] = 0.0
        kernel.theta[:] = NAN
        kernel.checked[:] = NAN
        kernel.is_active = False
        return self.outputs(t, u)

    def outputs(self, t: float, u: Vector) -> Vector:
        """Return u and the internal model."""
        return self._kernel.step.memory.copy()

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Advance by K steps."""
        return self._kernel.step.advance_through(t, h, u, lambda k: self._check_estimates(u[k]))

    def native(self) -> NativeStep:
        """Return the compiled step: it goes on until there is another estimate."""
        return self._kernel.step

    def _limited(self, v: Vector) -> Vector:
        above = np.maximum(v, self.options.lower)
        return np.minimum(above, self.options.upper)

    def _check_estimates(self, row: Vector) -> None:
        """Switch the internal model on, or follow theta, where the estimate is good enough."""
        kernel = self._kernel
        theta = row[self._columns["theta"]] if kernel.theta.size else np.zeros(0)
        error = row[self._columns["standard_error"]] if kernel.theta.size else theta
        kernel.checked[0] = theta
        kernel.checked[1] = error
        if kernel.is_active and np.array_equal(theta, kernel.theta):
            return
        if not self._activation.allows(theta, error):
            return
        kernel.theta[:] = theta
        self._take_gains()
        if not kernel.is_active:
            kernel.w[:] = affine([(kernel.X, row[self._known])])
        kernel.is_active = True

    def _take_gains(self) -> None:
        """Interpolate the gains, and discretize the internal model, at theta."""
        kernel = self._kernel
        arrays = self._arrays
        lower, upper = arrays["theta"]
        corners = corner_weights(kernel.theta, lower, upper, self._counts)
        kernel.X[:] = self._blended("X", corners)
        kernel.minus_K_w[:] = -self._blended("K_w", corners)
        S = arrays["S0"].copy()
        for value, slope in zip(kernel.theta, arrays["S1"], strict=True):
            S += value * slope
        dynamics = np.hstack([S, arrays["b"], self._blended("H", corners)])
        n_w, n = dynamics.shape
        driving = np.zeros((n - n_w, n))
        Z = np.vstack([dynamics, driving])
        step = matrix_exponential(arrays["h"][0] * Z)
        kernel.generator[:] = step[:n_w]

    def _blended(self, name: str, corners: Sequence[tuple[int, float]]) -> Matrix:
        table = self._arrays[name]
        return blended(table.reshape(-1, *table.shape[-2:]), corners)

    def save(self) -> tuple[Vector, Vector, Vector, bool]:
        """Copy the state."""
        kernel = self._kernel
        return kernel.u.copy(), kernel.w.copy(), kernel.theta.copy(), kernel.is_active

    def restore(self, state: tuple[Vector, Vector, Vector, bool]) -> None:
        """Go back to a saved state."""
        kernel = self._kernel
        u, w, theta, kernel.is_active = state
        kernel.u[:] = u
        kernel.w[:] = w
        kernel.theta[:] = theta
        kernel.checked[:] = np.inf  # no estimate: the next one is checked
        if kernel.is_active:
            self._take_gains()


def _counts(arrays: Design, parameters: int) -> tuple[int, ...]:
    """Return into how many parts the interval of each parameter is cut, by the nodes of K_w.

    Raises
    ------
    LogError
        If K_w has not an axis for each parameter.
    """
    shape = arrays.get("K_w", np.zeros(0)).shape
    nodes = shape[:parameters]
    if len(shape) != parameters + 2 or not all(nodes):
        raise LogError(
            f"the recorded design: K_w: expected {parameters} axes of nodes before its rows and "
            f"columns, got shape {shape}; run the scenario to compute it again"
        )
    return tuple(count - 1 for count in nodes)


def _interface(gains: CompensatorGains, options: CompensatorOptions) -> Interface:
    n_u = len(gains.K)
    n_w, p = gains.model.b.shape
    n_x = options.R.shape[1]
    n_d = gains.plant.Bd.shape[1]
    inputs = [
        Signal(options.state, n_x, role="input"),
        Signal("delta", n_d, role="input", optional=True, connection="optional"),
        Signal("y", options.n_y, role="input"),
    ]
    outputs = [Signal("u", n_u)]
    if n_w:
        outputs.append(Signal("w", n_w, role="state"))
    outputs.append(Signal("active", type="boolean", variability="discrete"))
    parameters = len(gains.box.lower)
    if parameters:
        for name in ("theta", "standard_error"):
            signal = Signal(name, parameters, role="input", optional=True, connection="optional")
            inputs.append(signal)
        used = Signal("model_theta", parameters, variability="discrete", optional=True)
        outputs.append(used)
    inputs.append(Signal("r", p, role="input", connection="optional"))
    return sampling_interface(inputs, outputs)
