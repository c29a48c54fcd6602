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

These gains are designed at the nodes of a grid over the interval of theta and interpolated between
them; the grid is refined until the loop is proven to be stable for all of it.

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
from contextlib import suppress
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np

from cosim.arrays import NAN, Matrix, Vector
from cosim.errors import AssumptionError
from cosim.native.numerics.linear import first_order_hold
from cosim.theory.compensation.certificate import (
    MOST_CORNERS,
    Certificate,
    SampledLoop,
    certify,
    is_stable_on_grid,
    rate_of_decay,
    spectral_radius,
)
from cosim.theory.compensation.internal_model import InternalModel, ParameterBox
from cosim.theory.compensation.schedule import Schedule, Stabilization, node_axes
from cosim.theory.compensation.state_feedback import (
    RegulatedPlant,
    SteadyGain,
    balancing,
    rescaled,
    slowest_rate,
)
from cosim.theory.observers.observer import StateSpace
from cosim.theory.observers.placement import modes

PARTS = (4, 16)  # into which the interval of each parameter is cut, until the proof succeeds
FEW_PARTS = (2, 1)  # of many parameters
MOST_NODES = 300
BISECTIONS = 8  # of an interval that would do
MARGINS = (0.02, 0.1, 0.3, 0.6, 0.9, 0.97, 0.99)  # by which it shrinks until it is proven
FEW_CORNERS = 240  # of cells of a proof that is tried while there are others to try
RESIDUAL = 1e-9  # of the Sylvester equation, relative to its terms
ROUNDING = 1e-12  # relative to S, of the real part of a mode that stays where it is
ALIKE = 1e-11  # of motions of length one: the least effort that tells them apart, over the largest
NEAR = 1e-6  # relative distance from an eigenvalue of S at which a zero counts as on it


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
    plant: RegulatedPlant, K: Matrix, model: InternalModel, theta: Vector, decay_rate: float
) -> Stabilization:
    """Design the gain of the internal model at one theta.

    Parameters
    ----------
    plant : RegulatedPlant
    K : Matrix
        State feedback, shape ``(n_u, n)``.
    model : InternalModel
    theta : Vector
    decay_rate : float
        At least that of the modes of the internal model [1/s].

    Raises
    ------
    AssumptionError
        If u does not reach a mode of the internal model, or two components of the class are alike.
    """
    S = model.S(theta)
    A_K = plant.A - plant.B @ K
    C_K = plant.C - plant.D @ K
    where = f"at theta = {_numbers(theta)} " if len(theta) else ""
    units = balancing(plant.A)
    driven = model.b @ C_K
    X = _sylvester(S, A_K, driven, units, where)
    directly = model.b @ plant.D
    B_w = directly - X @ plant.B
    shift = 0.5 * decay_rate
    K_w = _least_effort(S, B_w, shift, where)
    return Stabilization(K_w=K_w, X=X, B_w=B_w)


def decay_rate_of(plant: RegulatedPlant, K: Matrix, given: float | None) -> float:
    """Return the decay rate of the internal model: half the slowest one of the state feedback.

    Raises
    ------
    AssumptionError
        If another one is given that is not positive and finite.
    """
    rate = 0.5 * slowest_rate(K, plant) if given is None else given
    if not 0.0 < rate < math.inf:
        raise AssumptionError(
            f"internal model: decay_rate: expected a positive finite rate [1/s], got {rate:g}"
        )
    return rate


def _sylvester(S: Matrix, A: Matrix, right: Matrix, units: Vector, where: str) -> Matrix:
    """Solve ``S X - X A + right = 0``, in units of the states that balance A."""
    from scipy.linalg import solve_sylvester  # takes long to import, and is rarely needed

    balanced = rescaled(A, units)
    scaled = right * units
    X = solve_sylvester(S, -balanced, -scaled)
    of_S = S @ X
    of_A = X @ balanced
    residual = of_S - of_A + scaled
    size_of_X = np.abs(X)
    size_of_S = np.abs(S) @ size_of_X
    size_of_A = size_of_X @ np.abs(balanced)
    size = size_of_S + size_of_A + np.abs(scaled)
    is_finite = np.isfinite(X).all()
    error = np.abs(residual).max()
    if not is_finite or error > RESIDUAL * size.max():
        raise AssumptionError(
            f"internal model: {where}a mode of the disturbance is one of the state feedback, too",
            cure="choose another state feedback",
        )
    return np.asarray(X / units, np.float64)


def _least_effort(S: Matrix, B: Matrix, shift: float, where: str) -> Matrix:
    """Compute the gain that mirrors the modes of S right of ``-shift`` about it, no others.

    It is the regulator of A = S + shift I without a weight of the state. With orthonormal rows V'
    of the modes that grow, ``V' A = a V'``, it is ``V' B`` by the inverse of W, where
    ``a W + W a' = V' B B' V``: the effort that a motion takes is W^-1.
    """
    from scipy.linalg import schur, solve_continuous_lyapunov  # take long to import

    identity = np.eye(len(S))
    A = S + shift * identity
    size = np.linalg.norm(A, 2)
    least = ROUNDING * size
    T, Z, moved = schur(A.T, sort=lambda real, imaginary: real > least)
    a = T[:moved, :moved].T
    V = Z[:, :moved]
    b = V.T @ B
    W = solve_continuous_lyapunov(a, b @ b.T)
    squares = np.maximum(np.diag(W), np.finfo(np.float64).tiny)
    lengths = np.sqrt(squares)
    per_row = lengths[:, np.newaxis]
    correlation = W / lengths / per_row
    if moved and np.linalg.eigvalsh(correlation).min() < ALIKE:
        raise AssumptionError(
            f"internal model: {where}{_unreached(S, B)} (NOT_STABILIZABLE)",
            "NOT_STABILIZABLE",
            "choose an interval without that theta, components of the disturbance with separate "
            "intervals, or another decay_rate",
        )
    rows = V.T / per_row
    of_modes = np.linalg.solve(correlation, rows)
    inputs = b / per_row
    gain: Matrix = inputs.T @ of_modes
    return gain


def _unreached(S: Matrix, B: Matrix) -> str:
    """Return in words which mode of S the columns of B reach least (Popov, Belevitch, Hautus)."""
    n, m = B.shape
    least = math.inf
    mode = 0j
    alike = 0
    for eigenvalue in np.linalg.eigvals(S):
        shifted = S - eigenvalue * np.eye(n)
        values = np.linalg.svd(np.hstack([shifted, B]), compute_uv=False)
        if values[-1] < least:
            least = float(values[-1])
            mode = complex(eigenvalue)
            of_shifted = np.linalg.svd(shifted, compute_uv=False)
            alike = int((of_shifted <= NEAR * max(1.0, of_shifted[0])).sum())
    text = modes(np.array([mode]))
    if alike > m:
        return f"{alike} modes of it are alike, at {text}, and {m} input(s) cannot tell them apart"
    return f"u does not reach its mode {text}"


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
    decay_rate : float or None
        Of the internal model [1/s]; None: there is none in the loop.
    """

    plant: RegulatedPlant
    K: Matrix
    F: SteadyGain
    N: SteadyGain
    model: InternalModel
    box: ParameterBox
    decay_rate: float | None

    @property
    def before(self) -> Matrix:
        """The gain of (x_hat, delta_hat, r) without the internal model."""
        of_x = -self.K
        of_delta = self.F.gain
        of_r = self.N.gain
        return np.hstack([of_x, of_delta, of_r])

    @property
    def deviation(self) -> Matrix:
        """The deviation of x from its steady state, by (x, delta, r), shape ``(n, n + m)``."""
        n = self.K.shape[1]
        of_x = np.eye(n)
        of_delta = -self.F.states
        of_r = -self.N.states
        return np.hstack([of_x, of_delta, of_r])


def scheduled(gains: CompensatorGains, box: ParameterBox, parts: int) -> Schedule:
    """Design the gains of the internal model at the nodes of a grid with so many parts a side.

    Raises
    ------
    AssumptionError
        If there are none at a node.
    """
    assert gains.decay_rate is not None
    is_free = box.lower < box.upper
    cuts = np.where(is_free, parts, 0)
    counts = tuple(cuts.tolist())
    axes = node_axes(box, counts)
    nodes = []
    for point in product(*axes):
        theta = np.array(point)
        node = stabilize(gains.plant, gains.K, gains.model, theta, gains.decay_rate)
        nodes.append(node)
    K_w = np.stack([node.K_w for node in nodes])
    X = np.stack([node.X for node in nodes])
    B_w = np.stack([node.B_w for node in nodes])
    return Schedule(box=box, counts=counts, K_w=K_w, X=X, B_w=B_w)


def sampled_loop(
    system: ControlledPlant, gains: CompensatorGains, schedule: Schedule
) -> SampledLoop:
    """Write the loop with the internal model over one communication step.

    Its state is (x, observer, u, w), u that at the step's start.
    """
    n_w = len(gains.model.b)
    outer = _outer_loop(system, gains, gains.before, n_w)
    size = len(outer.Phi)
    first = size - n_w
    identity = np.eye(size)
    select = identity[first:]
    return SampledLoop(
        fixed=outer.Phi,
        of_u=outer.of_u,
        deviation=outer.deviation,
        w=select,
        error=outer.error,
        model=gains.model,
        schedule=schedule,
        h=system.h,
        at_limit=False,
    )


def saturated_loop(
    system: ControlledPlant, gains: CompensatorGains, schedule: Schedule
) -> SampledLoop:
    """Write the internal model over one step where the actuator is at a limit."""
    n_w = len(gains.model.b)
    n_u, n = gains.K.shape
    fixed = np.zeros((n_w, n_w))
    of_u = np.zeros((n_w, n_u))
    deviation = np.zeros((n, n_w))
    select = np.eye(n_w)
    no_error = np.zeros((0, n_w))
    return SampledLoop(
        fixed=fixed,
        of_u=of_u,
        deviation=deviation,
        w=select,
        error=no_error,
        model=gains.model,
        schedule=schedule,
        h=system.h,
        at_limit=True,
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
        return rate_of_decay(radius, system.h)
    n = gains.K.shape[1]
    of_delta = slice(n, n + gains.F.gain.shape[1])
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
        f"the sampled loop of {what} is not stable: expected eigenvalues of modulus below 1, got "
        f"{radius:.9g}",
        cure=f"choose {cure}",
    )


def _base_radius(system: ControlledPlant, gains: CompensatorGains, of_estimates: Matrix) -> float:
    outer = _outer_loop(system, gains, of_estimates, 0)
    return spectral_radius(outer.Phi)


class _OuterLoop(NamedTuple):
    """The loop over one step but for the internal model, whose rows are zero, by its state.

    ``of_u`` is what a change of the next u does, ``deviation`` that of x hat from its steady state,
    ``error`` the regulated outputs at the start.
    """

    Phi: Matrix
    of_u: Matrix
    deviation: Matrix
    error: Matrix


def _outer_loop(
    system: ControlledPlant, gains: CompensatorGains, of_estimates: Matrix, n_w: int
) -> _OuterLoop:
    """Write the loop with the gain ``of_estimates`` of (x_hat, delta_hat, r); r is 0."""
    plant = system.plant
    observer = system.observer
    h = system.h
    n_x = len(plant.A)
    n_o = len(observer.A)
    n_y, n_u = plant.D.shape
    held_u = np.full(n_u, system.u_held)
    held_y = np.full(n_y, system.y_held)
    held = np.concatenate([held_u, held_y])
    of_plant = first_order_hold(plant.A, plant.B, h, held_u)
    of_observer = first_order_hold(observer.A, observer.B, h, held)
    ends = np.cumsum([n_x, n_o, n_u, n_w])
    identity = np.eye(ends[-1])
    x, o, u, w, _ = np.split(identity, ends)
    # signals at the start of the step
    y = plant.C @ x + plant.D @ u
    v = np.vstack([u, y])
    estimates = observer.C @ o + observer.D @ v
    # what the next u does
    of_new_u = np.eye(n_u)
    new_y_of_u = plant.C @ of_plant.B1 + plant.D
    new_v_of_u = np.vstack([of_new_u, new_y_of_u])
    new_o_of_u = of_observer.B1 @ new_v_of_u
    no_w = np.zeros((n_w, n_u))
    of_u = np.vstack([of_plant.B1, new_o_of_u, of_new_u, no_w])
    # what there is without it
    no_u = np.zeros_like(u)
    free_x = of_plant.Ad @ x + of_plant.B0 @ u
    free_y = plant.C @ free_x
    free_v = np.vstack([no_u, free_y])
    driven_o = of_observer.B0 @ v + of_observer.B1 @ free_v
    free_o = of_observer.Ad @ o + driven_o
    free = np.vstack([free_x, free_o, no_u, np.zeros_like(w)])
    used = gains.K.shape[1] + gains.F.gain.shape[1]
    gain = of_estimates[:, :used]
    new_u = gain @ estimates
    of_deviation = gains.deviation[:, :used]
    regulated = list(system.regulated)
    return _OuterLoop(
        Phi=free + of_u @ new_u,
        of_u=of_u,
        deviation=of_deviation @ estimates,
        error=y[regulated],
    )


def _numbers(theta: Sequence[float] | Vector) -> str:
    formatted = [f"{value:.6g}" for value in theta]
    return ", ".join(formatted)


@dataclass(frozen=True, eq=False)
class CertifiedCompensator:
    """The gains of the internal model, and what is proven of the sampled loop.

    Parameters
    ----------
    schedule : Schedule or None
        None: there is no internal model in the loop.
    base_rate : float
        At which the loop without the internal model decays [1/s].
    rate : float
        At which that with it decays, the least in the box of theta; NaN: it is not used.
    theta : tuple of float
        Where that is.
    cells : int
        1: the proof holds for a theta that varies in the whole box, too.
    """

    schedule: Schedule | None
    base_rate: float
    rate: float
    theta: tuple[float, ...]
    cells: int


def certify_compensator(gains: CompensatorGains, system: ControlledPlant) -> CertifiedCompensator:
    """Design the internal model such that the loop is proven to be stable in the box of theta.

    That is, without the internal model; with it; and the internal model alone, with the actuator at
    a limit.

    Raises
    ------
    AssumptionError
        If one is not stable, or that cannot be proven; with theta and an interval that would do.
    """
    base_rate = check_base_loop(system, gains)
    if gains.decay_rate is None:
        return CertifiedCompensator(None, base_rate, NAN, (), 0)
    problem = ""
    loop = _Loop(gains, system)
    refinements = _refinements(gains.box)
    for parts in refinements:
        most_corners = MOST_CORNERS if parts == refinements[-1] else FEW_CORNERS
        attempt = loop.attempt(gains.box, parts, most_corners)
        problem = attempt.problem
        if attempt.schedule is not None:
            certificate = attempt.certificate
            return CertifiedCompensator(
                attempt.schedule, base_rate, certificate.rate, certificate.theta, certificate.cells
            )
    cure = "choose another decay_rate or state feedback"
    if len(gains.box.lower):
        factor = loop.largest_factor()
        largest = gains.box.scaled(factor).text if factor > 0.0 else "none"
        cure = (
            f"the largest interval about the same center that would do: {largest}; or one about "
            "the theta that is expected, another decay_rate or state feedback"
        )
    raise AssumptionError(
        f"{problem} (NOT_STABLE_IN_THE_INTERVAL)", "NOT_STABLE_IN_THE_INTERVAL", cure
    )


class _Attempt(NamedTuple):
    """What became of the gains of a box; ``problem`` is empty, and they are there, if proven."""

    problem: str
    schedule: Schedule | None
    certificate: Certificate


class _Loop(NamedTuple):
    """The gains of a compensator, and the plant that they are for."""

    gains: CompensatorGains
    system: ControlledPlant

    def attempt(self, box: ParameterBox, parts: int, most_corners: int) -> _Attempt:
        """Design the gains of a box, and try to prove both loops with them."""
        schedule = scheduled(self.gains, box, parts)
        certificate = certify(sampled_loop(self.system, self.gains, schedule), most_corners)
        if not certificate.proven:
            problem = _instability("the loop with the internal model", box, certificate)
            return _Attempt(problem, None, certificate)
        at_limit = certify(saturated_loop(self.system, self.gains, schedule), most_corners)
        if not at_limit.proven:
            problem = _instability("the internal model with u at a limit", box, at_limit)
            return _Attempt(problem, None, at_limit)
        return _Attempt("", schedule, certificate)

    def largest_factor(self) -> float:
        """Return by how much the box has to shrink about its center for a proof; 0: to nothing.

        That is where the loop becomes unstable, less what the proof needs as a margin.
        """
        box = self.gains.box
        parts = _refinements(box)[-1]
        low = 0.0
        high = 1.0
        for _ in range(BISECTIONS):
            middle = 0.5 * (low + high)
            if self._is_stable(box.scaled(middle), parts):
                low = middle
            else:
                high = middle
        for margin in MARGINS:
            factor = low * (1.0 - margin)
            with suppress(AssumptionError):  # there are no gains at a node of its own
                attempt = self.attempt(box.scaled(factor), parts, FEW_CORNERS)
                if attempt.schedule is not None:
                    return factor
        return 0.0

    def _is_stable(self, box: ParameterBox, parts: int) -> bool:
        """Return whether there are gains of a box, and the loop with them is stable on a grid."""
        try:
            schedule = scheduled(self.gains, box, parts)
        except AssumptionError:
            return False
        return is_stable_on_grid(sampled_loop(self.system, self.gains, schedule))


def _instability(what: str, box: ParameterBox, certificate: Certificate) -> str:
    """Return in words where a loop is not proven to be stable."""
    state = f"decays at {certificate.rate:.3g} 1/s, and near it that cannot be proven"
    if certificate.rate <= 0.0:
        state = f"grows at {-certificate.rate:.3g} 1/s"
    if not certificate.theta:
        return f"{what} is not proven to be stable: it {state}"
    return (
        f"{what} is not stable for every theta of {box.text}: at theta = "
        f"{_numbers(certificate.theta)} it {state}"
    )


def _refinements(box: ParameterBox) -> list[int]:
    """Return how finely the box is cut, with as many nodes as can be afforded."""
    is_free = box.lower < box.upper
    sides = max(int(is_free.sum()), 1)
    most = MOST_NODES ** (1.0 / sides) - 1.0
    affordable = [parts for parts in PARTS if parts <= most]
    few = [parts for parts in FEW_PARTS if parts <= most]
    return affordable or few[:1] or [1]
