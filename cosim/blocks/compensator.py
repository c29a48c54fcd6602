"""The compensator: state feedback, feedforward, and an internal model that theta_hat switches on.

At the communication point t_k, with x_hat, delta_hat, y and r there::

    v        = -K x_hat + F delta_hat + N r                  before
    v        = -K x_hat + F delta_hat + N r - K_w (w - X x)  with the internal model
    u(t_k+1) = v within the limits
    w(t_k+1) = E w + Gamma e + H (u(t_k+1) - v),    e = y - r of the regulated outputs

where x is x_hat less its steady state under delta_hat and r. E, Gamma and H are those of
``w' = S(theta) w + b e - B_w (u - v)`` over a step, its inputs held. The step of delay between
x_hat and u, which a digital controller has, opens the algebraic loop by which x_hat follows u.
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

from cosim.arrays import NAN, Mask, Matrix, Vector
from cosim.core.contracts import Design, check_design
from cosim.core.linear import shapes_of
from cosim.core.signals import Interface, Signal
from cosim.errors import UsageError
from cosim.native.step import affine, matrix_exponential
from cosim.theory.compensation.activation import Activation
from cosim.theory.compensation.design import (
    CompensatorGains,
    ControlledPlant,
    Stabilization,
    certify_compensator,
)
from cosim.theory.observer import StateSpace


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
        Largest standard error of theta, relative to theta, with which the internal model is used.
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
                f"compensator: found largest_error = {self.largest_error}, needed a positive number"
            )
        if not (self.lower < self.upper).all():
            limits = (self.lower.tolist(), self.upper.tolist())
            raise UsageError(f"compensator: found lower and upper = {limits}, needed lower < upper")


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
        self._options = options
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
        arrays = dict(recorded) or self._design(h, held)
        check_design(arrays, self._shapes())
        self._arrays = arrays
        lower, upper = arrays["theta"]
        self._activation = Activation(lower, upper, self._options.largest_error)
        return arrays

    def _design(self, h: float, held: Mask) -> dict[str, Matrix]:
        system = ControlledPlant(
            plant=self._plant,
            observer=self._observer,
            regulated=self._options.regulated,
            h=h,
            u_held=bool(held[self._columns[self._options.state]].all()),
            y_held=bool(held[self._columns["y"]].any()),
        )
        certificate = certify_compensator(self._gains, system)
        rates = [certificate.base_rate, certificate.rate, float(certificate.cells)]
        finite = [rate if math.isfinite(rate) else 0.0 for rate in rates]
        return {**self._numbers(), "h": np.array([h]), "certificate": np.array(finite)}

    def _numbers(self) -> dict[str, Matrix]:
        gains = self._gains
        n_w = len(gains.model.b)
        n_u, n = gains.K.shape
        internal = gains.internal
        if internal is None:
            internal = Stabilization.none(n_u=n_u, n_w=n_w, n=n)
        H = np.zeros((n_w, n_u))
        if self._options.anti_windup:
            H = H - internal.B_w
        return {
            "before": self._of_known(gains.before),
            "after": self._of_known(gains.after(internal)),
            "K_w": -internal.K_w,
            "X": self._of_known(internal.X @ gains.deviation),
            "S0": gains.model.S0,
            "S1": np.reshape(gains.model.S1, (len(gains.model.S1), n_w, n_w)),
            "G": np.hstack([gains.model.b, H]),
            "theta": np.stack([gains.box.lower, gains.box.upper]),
        }

    def _of_known(self, of_x_a: Matrix) -> Matrix:
        """Return a gain of (x_a, delta, r) as one of the inputs."""
        n = self._gains.K.shape[1]
        return np.hstack([of_x_a[:, :n] @ self._options.R, of_x_a[:, n:]])

    def _shapes(self) -> dict[str, tuple[int, ...]]:
        return {**shapes_of(self._numbers()), "h": (1,), "certificate": (3,)}

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
        n_w, m = self._arrays["G"].shape
        self._u = self._limited(np.zeros(len(self._gains.K)))
        self._w = np.zeros(n_w)
        self._theta = np.full(self._arrays["theta"].shape[1], NAN)
        self._is_active = False
        self._generator = np.zeros((n_w, n_w + m))
        return self.outputs(t, u)

    def outputs(self, t: float, u: Vector) -> Vector:
        """Return u and the internal model."""
        active = [float(self._is_active)]
        return np.concatenate([self._u, self._w, active, self._theta])

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Advance by K steps."""
        rows = np.empty((len(t) - 1, self.interface.n_y))
        for k in range(len(rows)):
            self._step(u[k])
            end = k + 1
            rows[k] = self.outputs(float(t[end]), u[end])
        return rows

    def _step(self, row: Vector) -> None:
        known = row[self._known]
        if self._gains.internal is not None:
            self._follow(row, known)
        if not self._is_active:
            v = affine([(self._arrays["before"], known)])
            self._u = self._limited(v)
            return
        v = affine([(self._arrays["after"], known), (self._arrays["K_w"], self._w)])
        self._u = self._limited(v)
        error = row[self._regulated] - row[self._columns["r"]]
        driven = np.concatenate([self._w, error, self._u - v])
        self._w = affine([(self._generator, driven)])

    def _limited(self, v: Vector) -> Vector:
        above = np.maximum(v, self._options.lower)
        return np.minimum(above, self._options.upper)

    def _follow(self, row: Vector, known: Vector) -> None:
        """Switch the internal model on, or follow theta, where the estimate is good enough."""
        theta = row[self._columns["theta"]] if self._theta.size else np.zeros(0)
        if self._is_active and np.array_equal(theta, self._theta):
            return
        error = row[self._columns["standard_error"]] if self._theta.size else theta
        if not self._activation.allows(theta, error):
            return
        if not self._is_active:
            self._w = affine([(self._arrays["X"], known)])
        self._is_active = True
        self._theta = theta.copy()
        self._generator = self._discretized(theta)

    def _discretized(self, theta: Vector) -> Matrix:
        """Return what a step does to w, by w and what drives it, shape ``(n_w, n_w + m)``."""
        S = self._arrays["S0"].copy()
        for value, slope in zip(theta, self._arrays["S1"], strict=True):
            S += value * slope
        dynamics = np.hstack([S, self._arrays["G"]])
        n_w, n = dynamics.shape
        driving = np.zeros((n - n_w, n))
        Z = np.vstack([dynamics, driving])
        step = matrix_exponential(self._arrays["h"][0] * Z)
        return np.ascontiguousarray(step[:n_w])

    def save(self) -> tuple[Vector, Vector, Vector, Matrix, bool]:
        """Copy the state."""
        arrays = (self._u, self._w, self._theta, self._generator)
        u, w, theta, generator = (array.copy() for array in arrays)
        return u, w, theta, generator, self._is_active

    def restore(self, state: tuple[Vector, Vector, Vector, Matrix, bool]) -> None:
        """Go back to a saved state."""
        u, w, theta, generator, self._is_active = state
        self._u = u.copy()
        self._w = w.copy()
        self._theta = theta.copy()
        self._generator = generator.copy()


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
    names = tuple(signal.name for signal in inputs)
    return Interface(tuple(inputs), tuple(outputs), delayed=names, prepares=True, rollback=True)
