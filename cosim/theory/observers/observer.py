"""Unknown-input observer (13)-(18), its realization (19)-(20), and the time T_id (36)-(38).

Any number of inputs, disturbances and outputs. With `w = y - C4 u` and `G = (C3 B_2a)^+`::

    delta = G (w' - C3 A_a x_a - C3 B_1a u)
    F = B_2a G,    M = (I - F C3) A_a,    N = (I - F C3) B_1a

What of delta reaches y directly (C5) needs no derivative: it is ``direct (w - C3 x_a)``. Put into
(9) it leaves `A = A_a - B_2a direct C3` in place of A_a, w as one more known signal, and for the
rest of delta the outputs that delta does not reach directly (:class:`.conditions.Decoupling`)::

    x_a' = A x_a + B_1a u + B_2a direct w + B_2a (delta - direct (w - C3 x_a))

The derivatives of y and u are needed only together, in w', so **one** filter on w gives what two
filters on y and u give (19)::

    q' = filter_rate (w - q),    w' is taken as filter_rate (w - q)

``cosim.theory.reconstruction.filters`` has two other ways to w', which the realizations below have
too.

The modes of (M, C3) that C3 does not see are the invariant zeros of (A_a, B_2a, C3); no L moves
them. In coordinates `[W, V]`, V the unobservable subspace and W its complement, `M - L C3` is block
triangular: `W'M W - W'L C3 W` and `V'M V`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from cosim.arrays import Matrix, Vector, frozen
from cosim.errors import AssumptionError
from cosim.theory.observers.conditions import (
    ROUNDING_OF_EIGENVALUES,
    Decoupling,
    check_detectable,
    check_hurwitz,
    decouple,
)
from cosim.theory.observers.placement import place
from cosim.theory.plants.descriptor import (
    ComplexVector,
    ReducedSystem,
    StateMap,
    in_units,
    reduced_scales,
    state_maps,
)
from cosim.theory.plants.geometry import (
    RANK_TOLERANCE,
    orthogonal_complement,
    output_nulling,
    without_rounding,
)
from cosim.theory.plants.scaling import within_range


@dataclass(frozen=True, eq=False, kw_only=True)
class ObserverDesign:
    """The matrices of the observer (16)-(18).

    Shapes: ``F (n_a, n_y)``, ``M (n_a, n_a)``, ``N (n_a, n_u)``, ``L (n_a, n_y)``,
    ``G (n_d, n_y)``, ``H (n_a, n_y)``, ``direct (n_d, n_y)``, ``outputs (k, n_y)``. H w is what w
    adds to z', ``outputs`` are the combinations of w that delta does not reach directly, which
    L works on. ``eigenvalues`` are those of `M - L C3` [1/s], shape ``(n_a,)``, ``fixed_modes``
    those of them that no L can move; ``filter_rate`` is `lambda_f` (19) [rad/s], None where there
    is no such filter.
    """

    F: Matrix
    M: Matrix
    N: Matrix
    L: Matrix
    G: Matrix
    H: Matrix
    direct: Matrix
    outputs: Matrix
    eigenvalues: ComplexVector
    fixed_modes: ComplexVector
    filter_rate: float | None

    def __post_init__(self) -> None:
        """Freeze the matrices."""
        _freeze(self, ("F", "M", "N", "L", "G", "H", "direct", "outputs"))

    @property
    def is_direct(self) -> bool:
        """Whether all of delta follows from y without a derivative."""
        return not self.G.any()

    @property
    def lambda_obs(self) -> float:
        """The slowest rate (37) of the error [1/s]."""
        rates = np.abs(self.eigenvalues.real)
        return float(rates.min())


@dataclass(frozen=True, eq=False)
class StateSpace:
    """The linear system `x' = A x + B u, y = C x + D u`.

    Shapes: ``A (n, n)``, ``B (n, m)``, ``C (p, n)``, ``D (p, m)``.
    """

    A: Matrix
    B: Matrix
    C: Matrix
    D: Matrix

    def __post_init__(self) -> None:
        """Freeze the matrices."""
        _freeze(self, ("A", "B", "C", "D"))


@dataclass(frozen=True)
class IdentificationStartTime:
    """The identification start time `T_id` (36)-(38) and its parts, all [s]."""

    T_obs: float
    T_f: float
    D_max: float
    T_id: float


@within_range()
def design(
    reduced: ReducedSystem,
    *,
    L: ArrayLike | None = None,
    poles: Sequence[complex] | None = None,
    filter_rate: float | None = None,
) -> ObserverDesign:
    """Design the observer (14)-(18) with a given gain or with given poles.

    Parameters
    ----------
    reduced : ReducedSystem
        The design model.
    L : ArrayLike, optional
        Gain, shape ``(n_a, n_y)`` or, with one output, ``(n_a,)``.
    poles : sequence of complex, optional
        Eigenvalues [1/s] of `M - L C3` on the observable part: as many as are not fixed. Exactly
        one of ``L`` and ``poles``.
    filter_rate : float, optional
        `lambda_f` of the derivative filter (19) [rad/s]; not needed for a window, or where delta
        follows from y without a derivative.

    Raises
    ------
    AssumptionError
        If (11) or (14) does not hold, a fixed mode is not stable, L or the poles do not fit or
        leave `M - L C3` not Hurwitz, or the filter rate is not positive and finite.
    """
    _check_options(L, poles, filter_rate)
    scales = reduced_scales(reduced)
    given = None
    if L is not None:
        gain = _given_gain(L, reduced.C3.T.shape)
        given = gain * scales.outputs / scales.states[:, np.newaxis]
    scaled = _designed(in_units(reduced, scales), scales.outputs, given, poles)
    n_u = reduced.B_1a.shape[1]
    x = scales.states[:, np.newaxis]
    u = scales.inputs[:n_u]
    delta = scales.inputs[n_u:, np.newaxis]
    y = scales.outputs
    return replace(
        scaled,
        F=scaled.F * x / y,
        M=scaled.M * x / scales.states,
        N=scaled.N * x / u,
        L=scaled.L * x / y,
        G=scaled.G * delta / y,
        H=scaled.H * x / y,
        direct=scaled.direct * delta / y,
        outputs=scaled.outputs / y,
        filter_rate=None if filter_rate is None else float(filter_rate),
    )


@dataclass(frozen=True, eq=False)
class ErrorDynamics:
    """The dynamics of the error (16) before a gain is chosen, where all is of size one.

    ``V`` is a basis of the states that L does not reach, ``fixed_modes`` [1/s] are their modes;
    ``magnitudes`` are of every entry of M the sum of the absolute values of its terms, larger where
    these are less accurate than by rounding.
    """

    decoupling: Decoupling
    F: Matrix
    M: Matrix
    N: Matrix
    H: Matrix
    V: Matrix
    fixed_modes: ComplexVector
    magnitudes: Matrix


def error_dynamics(reduced: ReducedSystem) -> ErrorDynamics:
    """Compute the error dynamics of an observer for any gain, in units of size one.

    Raises
    ------
    AssumptionError
        If the disturbance is not decoupled (14).
    """
    scales = reduced_scales(reduced)
    return _error_dynamics(in_units(reduced, scales), scales.outputs)


def _error_dynamics(reduced: ReducedSystem, weights: Vector) -> ErrorDynamics:
    C3 = reduced.C3
    decoupling = decouple(reduced, weights)
    direct = decoupling.direct
    F = reduced.B_2a @ decoupling.G
    of_w = reduced.B_2a @ direct
    A = reduced.A_a - of_w @ C3
    M = A - F @ (C3 @ A)
    N = reduced.B_1a - F @ (C3 @ reduced.B_1a)
    H = of_w - F @ (C3 @ of_w)
    size_of_A = np.abs(reduced.A_a) + np.abs(of_w) @ np.abs(C3)
    terms = size_of_A + np.abs(F) @ (np.abs(C3) @ size_of_A)
    # accuracy is a bound, of which errors that go either way reach a tenth
    magnitudes = terms * max(1.0, 0.1 * reduced.accuracy / ROUNDING_OF_EIGENVALUES)
    V = _unobservable_subspace(M, decoupling.outputs @ C3)
    fixed_modes = _sorted_eigenvalues(V.T @ M @ V)
    return ErrorDynamics(decoupling, F, M, N, H, V, fixed_modes, magnitudes)


def _designed(
    reduced: ReducedSystem,
    weights: Vector,
    given: Matrix | None,
    poles: Sequence[complex] | None,
) -> ObserverDesign:
    """Design an observer in units in which all is of size one; without its filter."""
    C3 = reduced.C3
    error = _error_dynamics(reduced, weights)
    decoupling = error.decoupling
    M = error.M
    C = decoupling.outputs @ C3
    W = orthogonal_complement(error.V)
    fixed_modes = error.fixed_modes
    check_detectable(fixed_modes, error.magnitudes)
    observable = W.T @ M @ W
    C_observable = C @ W
    if given is not None:
        gain = given - (given @ reduced.C5) @ decoupling.direct
    else:
        assert poles is not None
        gain = W @ place(observable, C_observable, poles, fixed_modes) @ decoupling.outputs
    correction = W.T @ gain @ C3 @ W
    movable = _sorted_eigenvalues(observable - correction)
    size_of_feedback = np.abs(gain) @ np.abs(C3)
    check_hurwitz(movable, error.magnitudes + size_of_feedback, fixed_modes)
    eigenvalues = np.sort_complex(np.concatenate([movable, fixed_modes]))
    return ObserverDesign(
        F=error.F,
        M=M,
        N=error.N,
        L=gain,
        G=decoupling.G,
        H=error.H,
        direct=decoupling.direct,
        outputs=decoupling.outputs,
        eigenvalues=eigenvalues,
        fixed_modes=fixed_modes,
        filter_rate=None,
    )


@dataclass(frozen=True, eq=False)
class _LinearMap:
    """A signal `of_x x + of_v v` of a realization with states x, inputs v = (u, y)."""

    of_x: Matrix
    of_v: Matrix


@dataclass(frozen=True, eq=False)
class _ObserverSignals:
    """What all realizations have: x_a hat, z' (18), u of v, and the drift, a sum of two parts.

    These are `C3 A x_a` and, of v, `C3 B_1a u + C3 B_2a direct w`. ``direct`` is what of delta
    needs no derivative.
    """

    x_a: _LinearMap
    z_dot: _LinearMap
    U: Matrix
    drift_of_state: _LinearMap
    drift_of_v: Matrix
    direct: _LinearMap

    @property
    def drift(self) -> _LinearMap:
        """The drift, `C3 A x_a + C3 B_1a u + C3 B_2a direct w`."""
        of_v = self.drift_of_state.of_v + self.drift_of_v
        return _LinearMap(self.drift_of_state.of_x, of_v)


def _signals_of(reduced: ReducedSystem, observer: ObserverDesign, Z: Matrix) -> _ObserverSignals:
    """Compute the signals of a realization; ``Z`` is z of its states."""
    Y = _w_of_inputs(reduced)
    n_u = reduced.B_1a.shape[1]
    U = np.eye(n_u, Y.shape[1])  # u of (u, y)
    F = observer.F
    L = observer.L
    C3 = reduced.C3
    magnitudes = np.abs(F) @ np.abs(Y)
    x_a = _LinearMap(Z, without_rounding(F @ Y, magnitudes))
    of_w = reduced.B_2a @ observer.direct
    C3_A = C3 @ (reduced.A_a - of_w @ C3)
    C3_B = C3 @ reduced.B_1a
    drift_of_state = _LinearMap(C3_A @ x_a.of_x, C3_A @ x_a.of_v)
    drift_of_v = C3_B @ U + (C3 @ of_w) @ Y
    closed = observer.M - L @ C3
    from_u = observer.N @ U
    z_dot_of_x = closed @ x_a.of_x
    z_dot_of_v = closed @ x_a.of_v + from_u + (L + observer.H) @ Y
    z_dot = _LinearMap(z_dot_of_x, z_dot_of_v)
    direct_of_x = -observer.direct @ (C3 @ x_a.of_x)
    direct_of_v = observer.direct @ (Y - C3 @ x_a.of_v)
    direct = _LinearMap(direct_of_x, direct_of_v)
    return _ObserverSignals(x_a, z_dot, U, drift_of_state, drift_of_v, direct)


def realize(reduced: ReducedSystem, observer: ObserverDesign) -> StateSpace:
    """Write observer, filter and reconstruction (18)-(20), (8) as one linear system.

    Returns
    -------
    StateSpace
        Inputs (u, y), states (z, q) with q of the size of y, outputs (x_a hat or x hat, delta hat,
        x_b hat, z, q). Without a filter there is no q.

    Raises
    ------
    AssumptionError
        If the observer is designed without a filter, and delta needs a derivative.
    """
    rate = observer.filter_rate
    if rate is None and not observer.is_direct:
        raise AssumptionError("filter_rate: expected a positive rate [rad/s], got none")
    n_y, n_a = reduced.C3.shape
    n_q = 0 if rate is None else n_y
    identity = np.eye(n_a + n_q)
    Z = identity[:n_a]  # z of (z, q)
    Q = identity[n_a:]  # q of (z, q)
    signals = _signals_of(reduced, observer, Z)
    Y = _w_of_inputs(reduced)
    w_dot = _LinearMap(np.zeros((n_y, n_a)), np.zeros_like(Y))
    if rate is not None:
        w_dot = _LinearMap(-rate * Q, rate * Y)
    delta = _reconstruction(observer.G, w_dot, signals)
    first, *others = [_state_estimate(state, signals, delta) for state in state_maps(reduced)]
    estimates = [first, delta, *others]
    no_feedthrough = np.zeros((n_a + n_q, Y.shape[1]))
    A = np.vstack([signals.z_dot.of_x, w_dot.of_x[:n_q]])
    B = np.vstack([signals.z_dot.of_v, w_dot.of_v[:n_q]])
    C = np.vstack([*(estimate.of_x for estimate in estimates), Z, Q])
    D = np.vstack([*(estimate.of_v for estimate in estimates), no_feedthrough])
    return StateSpace(A, B, C, D)


def delta_rows(reduced: ReducedSystem) -> slice:
    """Return the outputs of :func:`realize` that are delta."""
    first, *_ = state_maps(reduced)
    begin = len(first.of_x_a)
    return slice(begin, begin + reduced.B_2a.shape[1])


@dataclass(frozen=True, eq=False)
class AveragedRealization:
    """An observer whose delta, and the states that depend on it, are to be averaged.

    These are signals s that are known by parts: ``s = rate + level'``. Over a step the integral of
    s is that of ``rate`` plus the increment of ``level``.

    Parameters
    ----------
    system : StateSpace
        Inputs (u, y), states z, outputs (the states that do not depend on delta, z), then ``rate``
        and ``level``, each ``width`` rows.
    width : int
        Elements of delta, and of the states that depend on it.
    """

    system: StateSpace
    width: int


def lagging_states(reduced: ReducedSystem) -> list[StateMap]:
    """Return the states that depend on delta, and so are averaged as it is."""
    return [state for state in state_maps(reduced) if state.of_delta.any()]


def realize_averages(reduced: ReducedSystem, observer: ObserverDesign) -> AveragedRealization:
    """Write the observer (18) and the parts of (20) and (8) that are averaged.

    ``delta = direct (w - C3 x_a) + G (w' - drift)`` has the level `G w`, and the rest as rate.
    """
    n_a = len(reduced.A_a)
    signals = _signals_of(reduced, observer, np.eye(n_a))
    Y = _w_of_inputs(reduced)
    n_v = Y.shape[1]
    G = observer.G
    drift = signals.drift
    direct_part = signals.direct
    of_x = direct_part.of_x - G @ drift.of_x
    of_v = direct_part.of_v - G @ drift.of_v
    rates = [_LinearMap(of_x, of_v)]
    levels = [G @ Y]
    for state in lagging_states(reduced):
        rates.append(_state_estimate(state, signals, rates[0]))
        levels.append(state.of_delta @ levels[0])
    width = sum(len(level) for level in levels)
    no_delta = _LinearMap(np.zeros((len(G), n_a)), np.zeros((len(G), n_v)))
    shown = [
        _state_estimate(state, signals, no_delta)
        for state in state_maps(reduced)
        if not state.of_delta.any()
    ]
    shown.append(_LinearMap(np.eye(n_a), np.zeros((n_a, n_v))))
    no_state = np.zeros((width, n_a))
    outputs = [*shown, *rates]
    C = np.vstack([*(output.of_x for output in outputs), no_state])
    D = np.vstack([*(output.of_v for output in outputs), *levels])
    system = StateSpace(signals.z_dot.of_x, signals.z_dot.of_v, C, D)
    return AveragedRealization(system, width)


def initial_state_map(
    reduced: ReducedSystem,
    observer: ObserverDesign,
    *,
    x_a0: ArrayLike | None = None,
    q0: ArrayLike | None = None,
) -> tuple[Vector, Matrix]:
    """Compute the initial state of the realized observer as `x(0) = X0 + Xw [u(0); y(0)]`.

    The states are those of :func:`realize` with a filter; the first ``n_a`` are those without one,
    and those of :func:`realize_averages`.

    Parameters
    ----------
    reduced, observer : ReducedSystem, ObserverDesign
        The design model and the design.
    x_a0 : ArrayLike, optional
        `x_a hat(0)`, shape ``(n_a,)``; by default the shortest one with
        `C3 x_a hat(0) = y(0) - C4 u(0)`, as far as delta does not reach that directly.
    q0 : ArrayLike, optional
        Filter state q(0), shape ``(n_y,)``; by default `y(0) - C4 u(0)`, so that the filter starts
        without a transient.

    Returns
    -------
    tuple of Vector and Matrix
        X0, shape ``(n_a + n_y,)``, and Xw, shape ``(n_a + n_y, n_u + n_y)``.

    Raises
    ------
    AssumptionError
        If a given initial value has the wrong size or is not finite.
    """
    n = len(reduced.A_a)
    n_y = len(reduced.C3)
    Y = _w_of_inputs(reduced)
    if x_a0 is None:
        x_a = np.zeros(n)
        states = reduced_scales(reduced).states
        C = observer.outputs @ reduced.C3 * states
        from_w = (
            states[:, np.newaxis]
            * np.linalg.pinv(C, rcond=max(RANK_TOLERANCE, reduced.accuracy))
            @ observer.outputs
        )
    else:
        x_a = _initial_vector("x_a0", x_a0, n)
        from_w = np.zeros((n, n_y))
    if q0 is None:
        q = np.zeros(n_y)
        q_map = Y
    else:
        q = _initial_vector("q0", q0, n_y)
        q_map = np.zeros_like(Y)
    z_map = (from_w - observer.F) @ Y
    X0 = np.concatenate([x_a, q])
    Xw = np.vstack([z_map, q_map])
    return frozen(X0, 1), frozen(Xw, 2)


def identification_start_time(
    *,
    lambda_obs: float,
    filter_rate: float | None = None,
    window: float | None = None,
    delays: Sequence[float],
    epsilon_observer: float,
    epsilon_filter: float,
) -> IdentificationStartTime:
    """Compute the identification start time `T_id = T_obs + T_f + D_max` (36)-(38).

    From then on the transients of observer and filter have left the regression.

    Parameters
    ----------
    lambda_obs : float
        Slowest observer rate (37) [1/s].
    filter_rate : float, optional
        Filter rate (19) [rad/s].
    window : float, optional
        In place of a filter, the length of the window that delta is summed up over [s]: T_f, for
        what is older has no weight. Without both T_f is 0: delta follows from y at once.
    delays : sequence of float
        `D_j` [s].
    epsilon_observer, epsilon_filter : float
        Fractions of the initial errors that may remain, each in (0, 1).

    Raises
    ------
    AssumptionError
        If a rate or the window is not positive, a fraction not in (0, 1), or there is no delay.
    """
    if filter_rate is not None and window is not None:
        raise AssumptionError("expected filter_rate or window, got both")
    _check_positive("rate", {"lambda_obs": lambda_obs, "filter_rate": filter_rate})
    _check_positive("time", {"window": window})
    _check_fractions({"epsilon_observer": epsilon_observer, "epsilon_filter": epsilon_filter})
    if not delays:
        raise AssumptionError("delays: expected at least one, got none")
    T_obs = math.log(1.0 / epsilon_observer) / lambda_obs
    T_f = window or 0.0
    if filter_rate is not None:
        T_f = math.log(1.0 / epsilon_filter) / filter_rate
    D_max = max(delays)
    T_id = T_obs + T_f + D_max
    return IdentificationStartTime(T_obs, T_f, D_max, T_id)


def _check_positive(quantity: str, values: Mapping[str, float | None]) -> None:
    """Check that those that are given are positive and finite."""
    for name, value in values.items():
        if value is not None and not 0.0 < value < math.inf:
            raise AssumptionError(f"{name}: expected a positive finite {quantity}, got {value:g}")


def _check_fractions(fractions: Mapping[str, float]) -> None:
    """Check that all of them are in (0, 1)."""
    for name, fraction in fractions.items():
        if not 0.0 < fraction < 1.0:
            raise AssumptionError(f"{name}: expected a fraction in (0, 1), got {fraction:g}")


def _freeze(matrices: ObserverDesign | StateSpace, names: Sequence[str]) -> None:
    for name in names:
        matrix = frozen(getattr(matrices, name), 2)
        object.__setattr__(matrices, name, matrix)


def _check_options(
    L: ArrayLike | None, poles: Sequence[complex] | None, filter_rate: float | None
) -> None:
    if filter_rate is not None and not 0.0 < filter_rate < math.inf:
        raise AssumptionError(
            f"filter_rate: expected a positive finite rate [rad/s], got {filter_rate:g}"
        )
    if L is None and poles is None:
        raise AssumptionError("observer: expected L or poles, got neither")
    if L is not None and poles is not None:
        raise AssumptionError("observer: expected L or poles, got both")


def _unobservable_subspace(M: Matrix, C3: Matrix) -> Matrix:
    """Compute an orthonormal basis V of the states of (M, C3) that C3 does not see."""
    no_inputs = np.zeros((len(M), 0))
    no_feedthrough = np.zeros((len(C3), 0))
    return output_nulling(M, no_inputs, C3, no_feedthrough)


def _w_of_inputs(reduced: ReducedSystem) -> Matrix:
    """Return the matrix of `w = y - C4 u` in terms of (u, y), shape ``(n_y, n_u + n_y)``."""
    n_y = len(reduced.C3)
    return np.hstack([-reduced.C4, np.eye(n_y)])


def _reconstruction(G: Matrix, w_dot: _LinearMap, signals: _ObserverSignals) -> _LinearMap:
    """Compute `delta = direct (w - C3 x_a) + G (w' - C3 A_a x_a - C3 B_1a u)` (20)."""
    of_x = w_dot.of_x - signals.drift_of_state.of_x
    of_v = w_dot.of_v - signals.drift_of_state.of_v - signals.drift_of_v
    direct = signals.direct
    return _LinearMap(G @ of_x + direct.of_x, G @ of_v + direct.of_v)


def _state_estimate(state: StateMap, signals: _ObserverSignals, delta: _LinearMap) -> _LinearMap:
    """Compute states that the user sees, such as `x_b = Kx x_a + Ku u + Kd delta` (8)."""
    x_a = signals.x_a
    Kx = state.of_x_a
    Ku = state.of_u
    Kd = state.of_delta
    of_x = Kx @ x_a.of_x + Kd @ delta.of_x
    from_x_a = Kx @ x_a.of_v
    from_u = Ku @ signals.U
    from_delta = Kd @ delta.of_v
    of_v = from_x_a + from_u + from_delta
    size_from_x_a = np.abs(Kx) @ np.abs(x_a.of_v)
    size_from_u = np.abs(Ku) @ signals.U
    size_from_delta = np.abs(Kd) @ np.abs(delta.of_v)
    magnitudes = size_from_x_a + size_from_u + size_from_delta
    return _LinearMap(of_x, without_rounding(of_v, magnitudes))


def _given_gain(L: ArrayLike | None, shape: tuple[int, ...]) -> Matrix:
    gain = np.asarray(L, dtype=np.float64)
    if gain.ndim == 1 and shape[1] == 1:
        gain = gain[:, None]
    if gain.shape != shape:
        raise AssumptionError(
            f"L: expected shape {shape}, one row per dynamic state, one column per output, got "
            f"{gain.shape}"
        )
    if not np.isfinite(gain).all():
        raise AssumptionError(f"L: expected finite numbers, got {gain.tolist()}")
    return gain


def _sorted_eigenvalues(matrix: Matrix) -> ComplexVector:
    if not matrix.size:
        return np.zeros(0, dtype=np.complex128)
    eigenvalues = np.linalg.eigvals(matrix).astype(np.complex128)
    return np.sort_complex(eigenvalues)


def _initial_vector(name: str, values: ArrayLike, size: int) -> Vector:
    vector = np.atleast_1d(np.asarray(values, dtype=np.float64))
    if vector.shape != (size,):
        raise AssumptionError(f"{name}: expected shape ({size},), got {vector.shape}")
    if not np.isfinite(vector).all():
        raise AssumptionError(f"{name}: expected finite numbers, got {vector.tolist()}")
    return vector
