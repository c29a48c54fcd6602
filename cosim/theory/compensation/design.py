"""The design of the compensator, once for an interval of theta, and its certificate.

With the state feedback K the loop ``x' = A_K x + B v, e = C_K x + D v`` is stable, A_K = A - B K
and C_K = C - D K. The internal model ``w' = S w + b e`` behind it has the coordinates
``W = w - X x``, X from the Sylvester equation ``S X - X A_K + b C_K = 0``, in which it is on its
own (forwarding):

    W' = S W + B_w v,    B_w = b D - X B

B_w reaches every mode of S where the regulated outputs have no transmission zero at an eigenvalue
of S. The gain ``v = -K_w W`` needs the least effort that makes all of them decay: it moves those
modes of S that decay slower than half the decay rate to their mirror image about that, and no other
mode of the loop. In w it is ``u = -K x - K_w W = -(K - K_w X) x - K_w w``.

Where delta_hat or r is fed forward, x above is its deviation from the steady state under these:
the internal model leaves what they do alone.

* Bumpless: with ``w = X x_hat`` at the start W = 0, so that u goes on as it was.
* Anti-windup: where the actuator gives u_a in place of u, ``w' = S w + b e - B_w (u_a - u)`` makes
  ``W' = (S - B_w K_w) W``: it decays, whatever the actuator does (back-calculation, Astrom and
  Wittenmark).

What is certified is the loop as it runs: sampled, the controller with one step of delay, u
interpolated linearly, the observer with its filter, plant and observer by the same model.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cosim.arrays import NAN, Matrix, Vector, frozen
from cosim.errors import AssumptionError
from cosim.native.step import first_order_hold
from cosim.theory.compensation.certificate import (
    Certificate,
    SampledLoop,
    certify,
    largest_factor,
)
from cosim.theory.compensation.internal_model import InternalModel, ParameterBox
from cosim.theory.compensation.state_feedback import (
    RegulatedPlant,
    SteadyGain,
    balancing,
    slowest_rate,
)
from cosim.theory.observer import StateSpace
from cosim.theory.placement import modes

RESIDUAL = 1e-9  # of the Sylvester equation, relative to its terms
NEAR = 1e-6  # relative distance from an eigenvalue of S at which a zero counts as on it


@dataclass(frozen=True, eq=False, kw_only=True)
class Stabilization:
    """How the internal model joins the state feedback.

    Shapes: ``K_w (n_u, n_w)``, ``X (n_w, n)``, ``B_w (n_w, n_u)``; ``decay_rate`` [1/s].
    """

    K_w: Matrix
    X: Matrix
    B_w: Matrix
    decay_rate: float

    def __post_init__(self) -> None:
        """Freeze the matrices."""
        for name in ("K_w", "X", "B_w"):
            object.__setattr__(self, name, frozen(getattr(self, name), 2))

    @classmethod
    def none(cls, *, n_u: int, n_w: int, n: int) -> Stabilization:
        """Return that of an internal model that does nothing."""
        K_w = np.zeros((n_u, n_w))
        X = np.zeros((n_w, n))
        return cls(K_w=K_w, X=X, B_w=np.zeros((n_w, n_u)), decay_rate=0.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class ControlledPlant:
    """What the loop has beside the controller.

    Parameters
    ----------
    plant : StateSpace
        From u to y.
    observer : StateSpace
        From (u, y) to (x_a hat, delta hat); without delta hat where it is not fed forward.
    regulated : tuple of int
        The regulated elements of y.
    h : float
        Communication step [s].
    u_held, y_held : bool
        Whether these have a zero-order hold over a step; else they are interpolated linearly.
    """

    plant: StateSpace
    observer: StateSpace
    regulated: tuple[int, ...]
    h: float
    u_held: bool = False
    y_held: bool = False


def stabilize(
    plant: RegulatedPlant,
    K: Matrix,
    model: InternalModel,
    box: ParameterBox,
    decay_rate: float | None = None,
) -> Stabilization:
    """Design the gain of the internal model, at the center of a box of theta.

    Parameters
    ----------
    plant : RegulatedPlant
    K : Matrix
        State feedback, shape ``(n_u, n)``.
    model : InternalModel
    box : ParameterBox
    decay_rate : float, optional
        At least that of the modes of the internal model [1/s]; by default half the slowest one of
        the state feedback.

    Raises
    ------
    AssumptionError
        If the decay rate is not positive, a transmission zero is at an eigenvalue of S for some
        theta of the box, or two components of the class are alike there.
    """
    if decay_rate is None:
        decay_rate = 0.5 * slowest_rate(K, plant)
    if not 0.0 < decay_rate < math.inf:
        raise AssumptionError(
            f"internal model: decay_rate = {decay_rate:g}; needed a positive finite rate [1/s]"
        )
    _check_zeros(plant, model, box)
    S = model.S(box.center)
    A_K = plant.A - plant.B @ K
    C_K = plant.C - plant.D @ K
    X = _sylvester(S, A_K, model.b @ C_K, balancing(plant.A))
    B_w = model.b @ plant.D - X @ plant.B
    K_w = _least_effort(S, B_w, 0.5 * decay_rate)
    return Stabilization(K_w=K_w, X=X, B_w=B_w, decay_rate=decay_rate)


def _sylvester(S: Matrix, A: Matrix, right: Matrix, units: Vector) -> Matrix:
    """Solve ``S X - X A + right = 0``, in units of the states that balance A."""
    from scipy.linalg import solve_sylvester  # takes long to import, and is rarely needed

    balanced = A * units / units[:, np.newaxis]
    scaled = right * units
    X = solve_sylvester(S, -balanced, -scaled)
    residual = S @ X - X @ balanced + scaled
    size = np.abs(S) @ np.abs(X) + np.abs(X) @ np.abs(balanced) + np.abs(scaled)
    if not np.isfinite(X).all() or np.abs(residual).max() > RESIDUAL * size.max():
        raise AssumptionError(
            "internal model: a mode of the disturbance is one of the state feedback, too; needed "
            "another state feedback"
        )
    return np.asarray(X / units, np.float64)


def _least_effort(S: Matrix, B: Matrix, shift: float) -> Matrix:
    """Compute the gain that mirrors the modes of S right of ``-shift`` about it, no others.

    It is the regulator of S + shift I without a weight of the state.
    """
    from scipy.linalg import solve_continuous_are  # takes long to import, and is rarely needed

    n, m = B.shape
    size = np.linalg.norm(B) or 1.0
    scaled = B / size
    try:
        P = solve_continuous_are(S + shift * np.eye(n), scaled, np.zeros((n, n)), np.eye(m))
    except (np.linalg.LinAlgError, ValueError) as error:
        raise AssumptionError(
            f"internal model: u does not reach all its modes, or two of them are alike ({error}); "
            "needed components of the disturbance whose intervals of theta are apart, or another "
            "decay_rate"
        ) from error
    gain: Matrix = scaled.T @ P / size
    return gain


def _check_zeros(plant: RegulatedPlant, model: InternalModel, box: ParameterBox) -> None:
    """Check that no transmission zero is an eigenvalue of S for a theta of the box."""
    for zero in plant.zeros:
        theta, mode = _closest(complex(zero), model, box)
        scale = max(abs(zero), float(np.linalg.norm(model.S(theta), 2)), 1e-300)
        if abs(mode - zero) <= NEAR * scale or plant.has_zero_at(mode):
            corners = [box.lower, box.upper]
            is_of_all = all(_nearest_mode(model, corner, mode) == mode for corner in corners)
            where = "" if is_of_all else f" at theta = {_numbers(theta)}"
            raise AssumptionError(
                f"internal model: the transmission zero {modes([mode])} from u to the regulated "
                f"outputs is a mode of the disturbance{where}, where no controller rejects it "
                "(TRANSMISSION_ZERO); needed an interval of theta without it, or other regulated "
                "outputs"
            )


def _nearest_mode(model: InternalModel, theta: Vector, s: complex) -> complex:
    """Return the eigenvalue of S closest to s."""
    eigenvalues = np.linalg.eigvals(model.S(theta))
    return complex(eigenvalues[np.abs(eigenvalues - s).argmin()])


def _closest(s: complex, model: InternalModel, box: ParameterBox) -> tuple[Vector, complex]:
    """Return the theta of a box with the eigenvalue of S closest to s, and that eigenvalue."""
    cell = box
    theta = box.center
    mode = complex(math.inf)
    points = 21 if len(theta) <= 1 else 9
    while True:
        for point in cell.grid(points):
            nearest = _nearest_mode(model, point, s)
            if abs(nearest - s) < abs(mode - s):
                mode = nearest
                theta = point
        width = cell.upper - cell.lower
        if (width <= 1e-9 * np.maximum(np.abs(theta), 1e-9)).all():
            return theta, mode
        lower = np.maximum(theta - width / (points - 1), box.lower)
        upper = np.minimum(theta + width / (points - 1), box.upper)
        cell = ParameterBox(lower, upper)


@dataclass(frozen=True, eq=False, kw_only=True)
class CompensatorGains:
    """The gains of a compensator ``u = -K x_hat + F delta_hat + N r``, and its internal model.

    Parameters
    ----------
    plant : RegulatedPlant
    K : Matrix, shape (n_u, n)
    F, N : SteadyGain
        Of delta_hat and r; F has no columns where delta is not fed forward.
    model : InternalModel
    box : ParameterBox
        What theta the internal model is for.
    internal : Stabilization or None
        None: there is no internal model in the loop.
    """

    plant: RegulatedPlant
    K: Matrix
    F: SteadyGain
    N: SteadyGain
    model: InternalModel
    box: ParameterBox
    internal: Stabilization | None

    @property
    def before(self) -> Matrix:
        """The gain of (x_hat, delta_hat, r) without the internal model."""
        return np.hstack([-self.K, self.F.gain, self.N.gain])

    @property
    def deviation(self) -> Matrix:
        """The deviation of x from its steady state, by (x, delta, r), shape ``(n, n + m)``."""
        n = self.K.shape[1]
        return np.hstack([np.eye(n), -self.F.states, -self.N.states])

    def after(self, internal: Stabilization) -> Matrix:
        """Return the gain of (x_hat, delta_hat, r) with the internal model."""
        correction = internal.K_w @ internal.X @ self.deviation
        total: Matrix = self.before + correction
        return total


def sampled_loop(
    system: ControlledPlant, gains: CompensatorGains, internal: Stabilization
) -> SampledLoop:
    """Write the loop with the internal model over one communication step.

    Its state is (x, observer, u, w), u that at the step's start.
    """
    n_w = len(internal.X)
    fixed, error = _outer_loop(system, gains, gains.after(internal), internal.K_w)
    select = np.zeros((n_w, len(fixed)))
    first = len(fixed) - n_w
    select[:, first:] = np.eye(n_w)
    return SampledLoop(
        fixed=fixed,
        first=first,
        taken=np.vstack([select, error]),
        model=gains.model,
        G=gains.model.b,
        h=system.h,
    )


def saturated_loop(model: InternalModel, gains: Stabilization, h: float) -> SampledLoop:
    """Write the internal model over one step where the actuator is at a limit."""
    n_w = len(gains.X)
    return SampledLoop(
        fixed=np.zeros((n_w, n_w)),
        first=0,
        taken=np.vstack([np.eye(n_w), gains.K_w]),
        model=model,
        G=-gains.B_w,
        h=h,
    )


def check_base_loop(system: ControlledPlant, gains: CompensatorGains) -> float:
    """Return the decay rate of the sampled loop without the internal model [1/s].

    Raises
    ------
    AssumptionError
        If it is not stable.
    """
    radius = _base_radius(system, gains, gains.before)
    if radius < 1.0:
        return -math.log(max(radius, 1e-300)) / system.h
    of_delta = slice(gains.K.shape[1], gains.K.shape[1] + gains.F.gain.shape[1])
    without = gains.before.copy()
    without[:, of_delta] = 0.0
    what = "state feedback"
    cure = "a shorter communication step, a slower state feedback, or other poles of the observer"
    if gains.F.gain.size and _base_radius(system, gains, without) < 1.0:
        what = "state feedback and feedforward"
        cure = (
            "feedforward = false: delta_hat answers to u itself, as its filter takes the "
            "derivative of y later than the part of it that u makes"
        )
    raise AssumptionError(
        f"the sampled loop of {what} is not stable: an eigenvalue of modulus {radius:.9g}, needed "
        f"below 1; needed {cure}"
    )


def _base_radius(system: ControlledPlant, gains: CompensatorGains, of_estimates: Matrix) -> float:
    no_model = np.zeros((len(gains.K), 0))
    Phi, _ = _outer_loop(system, gains, of_estimates, no_model)
    return float(np.abs(np.linalg.eigvals(Phi)).max())


def certified(loop: SampledLoop, box: ParameterBox, what: str) -> Certificate:
    """Prove that a loop is stable in a box.

    Raises
    ------
    AssumptionError
        If it is not, or that cannot be proven, with theta and the largest interval that would do.
    """
    certificate = certify(loop, box)
    if certificate.proven:
        return certificate
    factor = largest_factor(loop, box)
    cure = "no interval about its center"
    if factor > 0.0:
        cure = f"{box.scaled(factor).text}"
    state = f"decays at {certificate.rate:.3g} 1/s only, too little to prove it"
    if certificate.rate <= 0.0:
        state = f"grows at {-certificate.rate:.3g} 1/s"
    raise AssumptionError(
        f"{what} is not stable for every theta of {box.text}: at theta = "
        f"{_numbers(certificate.theta)} it {state}; the largest interval that would do is {cure}, "
        "or another decay_rate or state feedback (NOT_STABLE_IN_THE_INTERVAL)"
    )


def _outer_loop(
    system: ControlledPlant, gains: CompensatorGains, of_estimates: Matrix, K_w: Matrix
) -> tuple[Matrix, Matrix]:
    """Write the loop over one step but for the internal model, whose rows are zero.

    ``of_estimates`` is the gain of (x_hat, delta_hat, r); r is 0. Returns the matrix, shape
    ``(n, n)``, and the regulated outputs at the start, ``(p, n)``.
    """
    plant = system.plant
    observer = system.observer
    n_x = len(plant.A)
    n_o = len(observer.A)
    n_u, n_w = K_w.shape
    held_u = np.full(n_u, system.u_held)
    held_y = np.full(len(plant.C), system.y_held)
    held = np.concatenate([held_u, held_y])
    of_plant = first_order_hold(plant.A, plant.B, system.h, held_u)
    of_observer = first_order_hold(observer.A, observer.B, system.h, held)
    identity = np.eye(n_x + n_o + n_u + n_w)
    x, o, u, w = np.split(identity, np.cumsum([n_x, n_o, n_u]))
    y = plant.C @ x + plant.D @ u
    v = np.vstack([u, y])
    estimates = observer.C @ o + observer.D @ v
    used = gains.K.shape[1] + gains.F.gain.shape[1]
    new_u = of_estimates[:, :used] @ estimates - K_w @ w
    new_x = of_plant.Ad @ x + of_plant.B0 @ u + of_plant.B1 @ new_u
    new_y = plant.C @ new_x + plant.D @ new_u
    new_v = np.vstack([new_u, new_y])
    new_o = of_observer.Ad @ o + of_observer.B0 @ v + of_observer.B1 @ new_v
    Phi = np.vstack([new_x, new_o, new_u, np.zeros_like(w)])
    return Phi, y[list(system.regulated)]


def _numbers(theta: Sequence[float] | Vector) -> str:
    return ", ".join(f"{value:.6g}" for value in theta)


@dataclass(frozen=True, slots=True)
class CompensatorCertificate:
    """What is proven of the sampled loop.

    Parameters
    ----------
    base_rate : float
        At which the loop without the internal model decays [1/s].
    rate : float
        At which that with it decays, the least in the box of theta; NaN: it is not used.
    cells : int
        1: the proof holds for a theta that varies in the whole box, too.
    """

    base_rate: float
    rate: float
    cells: int


def certify_compensator(gains: CompensatorGains, system: ControlledPlant) -> CompensatorCertificate:
    """Prove that the loop of a compensator is stable, for every theta of its box.

    That is, without its internal model; with it; and the internal model alone, with the actuator at
    a limit.

    Raises
    ------
    AssumptionError
        If one is not.
    """
    base_rate = check_base_loop(system, gains)
    internal = gains.internal
    if internal is None:
        return CompensatorCertificate(base_rate, NAN, 0)
    loop = sampled_loop(system, gains, internal)
    certificate = certified(loop, gains.box, "the loop with the internal model")
    saturated = saturated_loop(gains.model, internal, system.h)
    certified(saturated, gains.box, "the internal model with u at a limit")
    return CompensatorCertificate(base_rate, certificate.rate, certificate.cells)
