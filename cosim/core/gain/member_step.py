"""One communication step of a linearized component, as matrices.

Where a component has steps of its own, the matrices depend on where in such a step it is, its
*phase*; its state then has the outputs that are held, and the inputs from the start of that step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.linearization import Linearized
from cosim.native.numerics.linear import DiscretizedDynamics, first_order_hold

Phase: TypeAlias = Literal["only", "first", "middle", "last"]


@dataclass(frozen=True, slots=True)
class MemberStep:
    """What a step does to a state s, held outputs included, and to the outputs.

    ::

        s1 = S s + S0 u0 + S1 u1         y1 = Y s + Y0 u0 + Y1 u1
        evaluated again for inputs u:    y1 = R s1 + R1 u, or as before (``keeps``)
        at the start of the step:        y0 = Q s + Q0 u0

    Parameters
    ----------
    S, S0, S1 : Matrix, shapes (n_s, n_s), (n_s, n_u), (n_s, n_u)
    Y, Y0, Y1 : Matrix, shapes (n_y, n_s), (n_y, n_u), (n_y, n_u)
    R, R1 : Matrix, shapes (n_y, n_s), (n_y, n_u)
    Q, Q0 : Matrix, shapes (n_y, n_s), (n_y, n_u)
        What the outputs are at the start of the step for the inputs there.
    keeps : Mask, shape (n_y,)
    """

    S: Matrix
    S0: Matrix
    S1: Matrix
    Y: Matrix
    Y0: Matrix
    Y1: Matrix
    R: Matrix
    R1: Matrix
    Q: Matrix
    Q0: Matrix
    keeps: Mask

    @property
    def n_s(self) -> int:
        """Number of elements of the state."""
        return len(self.S)

    def advance(self, s: Matrix, u0: Matrix, u1: Matrix) -> tuple[Matrix, Matrix]:
        """Return state and outputs at the end, for columns of states and inputs."""
        state = self.S @ s + self.S0 @ u0 + self.S1 @ u1
        y = self.Y @ s + self.Y0 @ u0 + self.Y1 @ u1
        return state, y

    def refresh(self, s: Matrix, u: Matrix, before: Matrix) -> Matrix:
        """Return the outputs at the end, evaluated again for other inputs."""
        evaluated = self.R @ s + self.R1 @ u
        return np.where(self.keeps[:, np.newaxis], before, evaluated)


@dataclass(frozen=True, slots=True)
class _Dynamics:
    """``x1 = Ad x + B0 u0 + B1 u1``, ``y1 = C x1 + D0 u0 + D1 u1``, evaluated again ``+ D u``."""

    linearized: Linearized
    discrete: DiscretizedDynamics
    D0: Matrix
    D1: Matrix

    @property
    def output(self) -> tuple[Matrix, Matrix, Matrix]:
        """The outputs at the end of the step, by x, u0 and u1 at its start."""
        C = self.linearized.C
        discrete = self.discrete
        of_x = C @ discrete.Ad
        of_u0 = C @ discrete.B0 + self.D0
        of_u1 = C @ discrete.B1 + self.D1
        return of_x, of_u0, of_u1


def phase_of(linearized: Linearized, step: int) -> Phase:
    """Return where in a step of its own a component is at a communication step."""
    period = linearized.period
    if period == 1:
        return "only"
    place = (step - linearized.offset) % period
    if place == 0:
        return "first"
    return "last" if place == period - 1 else "middle"


def member_step(linearized: Linearized, h: float, held: Mask, phase: Phase) -> MemberStep:
    """Return the step of a component.

    Parameters
    ----------
    linearized : Linearized
    h : float
        Communication step [s].
    held : Mask, shape (n_u,)
        Which inputs have a zero-order hold.
    phase : {"only", "first", "middle", "last"}
    """
    if linearized.delay:
        return _delayed(linearized)
    own_h = h * max(1, linearized.own_steps)
    dynamics = _dynamics(linearized, own_h, held)
    if phase == "only":
        return _direct(dynamics)
    if linearized.own_steps:
        return _sampled(dynamics, phase)
    return _decimated(dynamics, phase)


def _dynamics(linearized: Linearized, h: float, held: Mask) -> _Dynamics:
    at_start = held | (linearized.input_use == "start")
    moving = np.full(len(held), 0.5 if linearized.input_use == "mean" else 0.0)
    if linearized.latest is not None:
        moving[linearized.latest] = 0.0
    share = np.where(at_start, 1.0, moving)
    discrete = _discretized(linearized, h, at_start, share)
    D = linearized.D
    follows = linearized.follows[:, np.newaxis]
    # What does not follow belongs to the input that the step took.
    D0 = np.where(follows, 0.0, D * share)
    D1 = np.where(follows, D, D * (1.0 - share))
    return _Dynamics(linearized, discrete, D0, D1)


def _discretized(
    linearized: Linearized, h: float, at_start: Mask, share: Vector
) -> DiscretizedDynamics:
    A = linearized.A
    B = linearized.B
    if linearized.is_discrete:
        return DiscretizedDynamics(A, B, np.zeros(B.shape))
    if linearized.input_use != "mean":
        return first_order_hold(A, B, h, at_start)
    discrete = first_order_hold(A, B, h, np.ones(len(at_start), np.bool_))
    return DiscretizedDynamics(discrete.Ad, discrete.B0 * share, discrete.B0 * (1.0 - share))


def _direct(dynamics: _Dynamics) -> MemberStep:
    """Return a step without phases."""
    linearized = dynamics.linearized
    discrete = dynamics.discrete
    Y, Y0, Y1 = dynamics.output
    return MemberStep(
        discrete.Ad,
        discrete.B0,
        discrete.B1,
        Y,
        Y0,
        Y1,
        R=linearized.C,
        R1=linearized.D,
        Q=linearized.C,
        Q0=linearized.D,
        keeps=~linearized.follows,
    )


def _sampled(dynamics: _Dynamics, phase: Phase) -> MemberStep:
    """Return a step of a component with steps of its own; s = (x, u at their start, y held)."""
    linearized = dynamics.linearized
    discrete = dynamics.discrete
    shape = _State(len(linearized.A), linearized.D.shape)
    x = shape.x
    u_start = shape.u_start
    y_held = shape.y
    first = shape.kept()
    if phase == "first":
        first.S[u_start] = 0.0
        first.S0[u_start] = np.eye(shape.n_u)
        first.S[y_held] = 0.0
        first.S[y_held, x] = linearized.C
        first.S0[y_held] = linearized.D
        return first.step(held=y_held, at_start=(first.S[y_held], first.S0[y_held]))
    if phase == "middle":
        return first.step(held=y_held)
    Y, Y0, Y1 = dynamics.output
    first.S[x, x] = discrete.Ad
    first.S[x, u_start] = discrete.B0
    first.S1[x] = discrete.B1
    first.S[y_held] = 0.0
    first.S[y_held, x] = Y
    first.S[y_held, u_start] = Y0
    first.S1[y_held] = Y1
    R = np.zeros((shape.n_y, shape.size))
    R[:, x] = linearized.C
    return first.step(held=y_held, again=(R, linearized.D, ~linearized.follows))


def _decimated(dynamics: _Dynamics, phase: Phase) -> MemberStep:
    """Return a step of a component whose outputs are held; s = (x, u, y held), u is not used."""
    linearized = dynamics.linearized
    discrete = dynamics.discrete
    shape = _State(len(linearized.A), linearized.D.shape)
    x = shape.x
    y_held = shape.y
    step = shape.kept()
    step.S[shape.u_start] = 0.0
    step.S[x, x] = discrete.Ad
    step.S0[x] = discrete.B0
    step.S1[x] = discrete.B1
    if phase == "middle":
        return step.step(held=y_held)
    step.S[y_held] = 0.0
    if phase == "first":
        step.S[y_held, x] = linearized.C
        step.S0[y_held] = linearized.D
        return step.step(held=y_held, at_start=(step.S[y_held], step.S0[y_held]))
    Y, Y0, Y1 = dynamics.output
    step.S[y_held, x] = Y
    step.S0[y_held] = Y0
    step.S1[y_held] = Y1
    R = np.zeros((shape.n_y, shape.size))
    R[:, x] = linearized.C
    return step.step(held=y_held, again=(R, linearized.D, ~linearized.follows))


@dataclass(frozen=True, slots=True)
class _State:
    """Where the parts of the state of a component with phases stand."""

    n_x: int
    shape: tuple[int, int]  # of D

    @property
    def n_y(self) -> int:
        return self.shape[0]

    @property
    def n_u(self) -> int:
        return self.shape[1]

    @property
    def size(self) -> int:
        return self.n_x + self.n_u + self.n_y

    @property
    def x(self) -> slice:
        return slice(0, self.n_x)

    @property
    def u_start(self) -> slice:
        return slice(self.n_x, self.n_x + self.n_u)

    @property
    def y(self) -> slice:
        return slice(self.n_x + self.n_u, self.size)

    def kept(self) -> _Draft:
        """Return a step that changes nothing."""
        nothing = (self.size, self.n_u)
        return _Draft(np.eye(self.size), np.zeros(nothing), np.zeros(nothing))


@dataclass(slots=True)
class _Draft:
    """How a step changes the state, to be filled; the outputs are those held in it."""

    S: Matrix
    S0: Matrix
    S1: Matrix

    def step(
        self,
        *,
        held: slice,
        at_start: tuple[Matrix, Matrix] | None = None,
        again: tuple[Matrix, Matrix, Mask] | None = None,
    ) -> MemberStep:
        """Return the step; what is not given of its outputs is what is held."""
        kept = np.eye(len(self.S))[held]
        nothing = np.zeros((len(kept), self.S0.shape[1]))
        no_output = np.zeros(len(kept), np.bool_)
        Q, Q0 = at_start or (kept, nothing)
        R, R1, keeps = again or (kept, nothing, no_output)
        return MemberStep(
            self.S,
            self.S0,
            self.S1,
            self.S[held],
            self.S0[held],
            self.S1[held],
            R=R,
            R1=R1,
            Q=Q,
            Q0=Q0,
            keeps=keeps,
        )


def _delayed(linearized: Linearized) -> MemberStep:
    """Return a step of a delay; s = the inputs of the last steps, the oldest first."""
    n_y, n_u = linearized.D.shape
    size = linearized.delay * n_u
    S = np.eye(size, k=n_u)
    S0 = np.zeros((size, n_u))
    S0[size - n_u :] = np.eye(n_u)
    nothing = np.zeros((size, n_u))
    oldest = np.zeros((n_y, size))
    oldest[:, :n_u] = linearized.D
    no_input = np.zeros((n_y, n_u))
    return MemberStep(
        S,
        S0,
        nothing,
        oldest @ S,
        oldest @ S0,
        no_input,
        R=oldest,
        R1=no_input,
        Q=oldest,
        Q0=no_input,
        keeps=np.zeros(n_y, np.bool_),
    )
