r"""What a bounded irregular part of the disturbance can do to an estimate of theta.

The disturbance is a signal of the class (4) plus an irregular part of which only a bound is known,
`|delta_0(t)| <= d` (an *unknown-but-bounded* disturbance). The recorded output is

    y = g(p) + L delta_0 + noise,        p = (theta, nuisance),

g the output of the model, linear in the nuisance parameters (amplitudes and phases beta(0), initial
state, offset), L the response of the plant to delta_0 from rest. Between two samples delta_0 is a
straight line, as every continuous signal of this package.

First order
-----------
Weighted least squares on y is to first order a linear functional of it: its error is
`F (L delta_0 + noise)` with `F = (J' W J)^-1 J' W`, `J = dg/dp`. The sensitivity of theta_i to the
node delta_0(tau) is the entry of `s_i = L' F_i`, which one simulation of the adjoint system gives
for all tau. The largest error is `d sum |s_i|`, reached by the bang-bang signal `d sign(s_i)`.

That is no statement about a given estimate: the error belongs to a truth. Nor is it the largest
one: in the example (40 s, 1 ms) it is 3.86 d for theta2, and an error was found that exceeds it by
0.1 % for d = 0.0002, 1.1 % for 0.002 and 41 % for 0.02.

From an estimate back to the truth
----------------------------------
An estimate p_hat satisfies `F (y - g(p_hat)) = 0` with F at p_hat, so the truth is one of the p
with `F (g(p) + L delta_0 - g(p_hat)) = 0` for an admissible delta_0. `interval_around` finds the
largest and the smallest theta_i of these p: bang-bang by the sign of
`L' F' (F J(p))^-T e_i`, then p by Newton's method, until neither changes, for a bound that grows
from none: delta_0 = 0 is admissible, so the estimate is one of these p. It contains the truth
where the first order, evaluated at the estimate instead of at the truth, misses it by a little;
noise moves it by its effect on the estimate. With d = 0.02 it has no end in the example from an
unlucky estimate: then the estimate says too little, and only all the data bound theta
(`cosim.theory.bounded.set_membership`).

Reference: M. Milanese, A. Vicino, "Optimal estimation theory for dynamic systems with set
membership uncertainty: an overview", Automatica 27 (1991).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.errors import AssumptionError
from cosim.native.numerics.linear import DiscretizedDynamics, first_order_hold, linear_step

MOST_STEPS = 60  # of the search of an end, and of Newton's method in each
NEWTON_CHANGE = 1e-10  # relative change of the output by a step that ends Newton's method
REACH = 100.0  # first-order half widths; what goes further has no end
GROWTH_STEPS = 4  # of the bound, from none to all, in which an end is followed
MATCHED = 1e-8  # of the reach; gain that ends the search of an end, and is added to it
SINGULAR = 1e13  # condition
INDEPENDENT = 1e-13  # least relative pivot of the Jacobian with columns of length 1


@dataclass(frozen=True, eq=False)
class Prediction:
    """The model's output and its derivatives at one p.

    Attributes
    ----------
    output : Matrix
        `g(p)` at the samples, shape ``(N, n_y)``.
    jacobian : ndarray
        `dg/dp`, shape ``(N, n_y, n_p)``.
    """

    output: Matrix
    jacobian: NDArray[np.float64]


class OutputModel(Protocol):
    """The output without irregular part and noise as a function of p = (theta, nuisance)."""

    def __call__(self, p: Vector) -> Prediction:
        """Compute output and Jacobian at p, shape ``(n_p,)``; theta comes first in it."""


@dataclass(frozen=True, eq=False)
class IrregularResponse:
    """The response L of the sampled outputs to delta_0, from rest.

    Attributes
    ----------
    discrete : DiscretizedDynamics
        From delta_0 to the state, linear interpolation between samples.
    C : Matrix
        Outputs of the state, shape ``(n_y, n)``.
    D : Matrix
        Direct feedthrough of delta_0, shape ``(n_y, n_d)``.
    """

    discrete: DiscretizedDynamics
    C: Matrix
    D: Matrix

    def respond(self, delta_0: Matrix) -> Matrix:
        """Compute `L delta_0`, shape ``(N, n_y)``, from the values ``(N, n_d)`` at the samples."""
        step = linear_step(self.discrete, self.C, self.D)
        first = delta_0[:1] @ self.D.T
        steps = np.arange(len(delta_0), dtype=np.float64)
        rest = step.advance(steps, 1.0, delta_0)
        return np.concatenate([first, rest])

    def adjoint(self, functional: Matrix) -> Matrix:
        """Compute `L' a`, shape ``(N, n_d)``, for a functional a of the outputs ``(N, n_y)``.

        The costate runs backwards, `lambda_k = Ad' lambda_k+1 + C' a_k`.
        """
        discrete = self.discrete
        n = len(discrete.Ad)
        no_input = np.zeros((n, len(self.C)))
        backwards = DiscretizedDynamics(discrete.Ad.T, no_input, self.C.T)
        costate_step = linear_step(backwards, np.eye(n), no_input)
        at_rest = np.zeros((1, len(self.C)))
        reversed_functional = np.concatenate([at_rest, functional[::-1]])
        steps = np.arange(len(reversed_functional), dtype=np.float64)
        costate = costate_step.advance(steps, 1.0, reversed_functional)[::-1]
        sensitivity = functional @ self.D
        sensitivity[:-1] += costate[1:] @ discrete.B0
        sensitivity[1:] += costate[1:] @ discrete.B1
        return sensitivity


def irregular_response(A: Matrix, Bd: Matrix, C: Matrix, Dd: Matrix, h: float) -> IrregularResponse:
    """Build the response of `x' = A x + Bd delta_0, y = C x + Dd delta_0`, sampled every h [s]."""
    interpolated = np.zeros(Bd.shape[1], dtype=np.bool_)
    discrete = first_order_hold(A, Bd, h, held=interpolated)
    return IrregularResponse(discrete, C, Dd)


@dataclass(frozen=True, eq=False)
class BoundedDisturbance:
    """An estimation problem with an unknown-but-bounded irregular part.

    Attributes
    ----------
    model : OutputModel
        `g` of p.
    response : IrregularResponse
        `L`.
    bound : Vector
        Largest magnitude of each channel of delta_0, shape ``(n_d,)``.
    weight : Matrix
        Inverse covariance of the noise of one sample, up to a factor, shape ``(n_y, n_y)``.
    n_theta : int
        How many entries of p are theta.
    """

    model: OutputModel
    response: IrregularResponse
    bound: Vector
    weight: Matrix
    n_theta: int

    def __post_init__(self) -> None:
        n_y, n_d = self.response.D.shape
        if self.bound.shape != (n_d,) or not np.all(self.bound >= 0.0):
            raise AssumptionError(
                f"bounds of delta_0: expected {n_d}, none negative, got {self.bound.tolist()}"
            )
        if self.weight.shape != (n_y, n_y):
            raise AssumptionError(
                f"weight: expected shape {(n_y, n_y)}, a row an output, got {self.weight.shape}"
            )
        eigenvalues = np.linalg.eigvalsh(self.weight)
        if not eigenvalues.min() > 0.0:
            raise AssumptionError(
                f"weight: expected positive eigenvalues, got {eigenvalues.min():g}"
            )


@dataclass(frozen=True, eq=False)
class FirstOrder:
    """What moves the least-squares theta, to first order.

    Attributes
    ----------
    sensitivity : ndarray
        To delta_0 at each node, shape ``(n_theta, N, n_d)``.
    functional : ndarray
        To y, shape ``(n_theta, N, n_y)``.
    """

    sensitivity: NDArray[np.float64]
    functional: NDArray[np.float64]

    def half_width(self, bound: Vector) -> Vector:
        """Compute the largest error of each theta for ``|delta_0| <= bound``, ``(n_theta,)``."""
        magnitudes = np.abs(self.sensitivity)
        by_channel = magnitudes.sum(axis=1)
        half_width: Vector = by_channel @ bound
        return half_width


def least_squares_functional(
    jacobian: NDArray[np.float64], weight: Matrix, count: int
) -> NDArray[np.float64]:
    """Compute the first rows of `F = (J' W J)^-1 J' W`.

    Parameters
    ----------
    jacobian : ndarray
        `dg/dp`, shape ``(N, n_y, n_p)``.
    weight : Matrix
        Shape ``(n_y, n_y)``.
    count : int
        How many rows.

    Returns
    -------
    ndarray
        Shape ``(count, N, n_y)``.

    Raises
    ------
    AssumptionError
        If the columns of the Jacobian are dependent.
    """
    samples, n_y, n_p = jacobian.shape
    root = _root(weight)
    J = _whitened(jacobian, root)
    length = np.linalg.norm(J, axis=0)
    length[length == 0.0] = 1.0
    Q, R = np.linalg.qr(J / length)
    pivots = np.abs(np.diag(R))
    if len(J) < n_p or not pivots.min() > INDEPENDENT:
        raise AssumptionError(
            f"the outputs do not determine the {n_p} unknowns: expected pivots of the Jacobian "
            f"above {INDEPENDENT:g}, got {pivots.min():.2g}"
        )
    rows = np.linalg.solve(R, Q.T) / length[:, None]
    whitened_rows = rows[:count].reshape(count, samples, n_y)
    functional: NDArray[np.float64] = whitened_rows @ root.T
    return functional


def first_order(problem: BoundedDisturbance, p: Vector) -> FirstOrder:
    """Compute the sensitivity of the least-squares theta at p to delta_0, by the adjoint."""
    prediction = problem.model(p)
    functionals = least_squares_functional(prediction.jacobian, problem.weight, problem.n_theta)
    sensitivities = [problem.response.adjoint(row) for row in functionals]
    return FirstOrder(np.array(sensitivities), functionals)


def interval_around(problem: BoundedDisturbance, estimate: Vector) -> Matrix:
    """Compute the least and the largest theta that may be the truth behind an estimate.

    Parameters
    ----------
    problem : BoundedDisturbance
    estimate : Vector
        p by weighted least squares, shape ``(n_p,)``.

    Returns
    -------
    Matrix
        Shape ``(n_theta, 2)``; infinite where there is no end.
    """
    prediction = problem.model(estimate)
    half_width = first_order(problem, estimate).half_width(problem.bound)
    interval = np.empty((problem.n_theta, 2))
    for parameter in range(problem.n_theta):
        reach = REACH * half_width[parameter]
        for side, direction in enumerate((-1, 1)):
            end = _end_around(problem, estimate, prediction, parameter, direction, reach)
            interval[parameter, side] = end
    return interval


def _end_around(
    problem: BoundedDisturbance,
    estimate: Vector,
    prediction: Prediction,
    parameter: int,
    direction: int,
    reach: float,
) -> float:
    """Follow the end of theta as the bound grows; infinite where nothing shows an end.

    The end of a larger bound is farther out, and p a continuous function of delta_0 as long as
    `normal J` is not singular: what goes back or changes its orientation is of another branch.
    """
    normal = np.einsum("kyp,yw->pkw", prediction.jacobian, problem.weight)
    no_end = direction * np.inf
    ended = MATCHED * reach
    p = estimate
    for step in range(MOST_STEPS):
        rows = _theta_rows(normal, problem.model(p).jacobian)
        if rows is None:
            return no_end
        share = min((step + 1) / GROWTH_STEPS, 1.0)
        sensitivity = problem.response.adjoint(rows[parameter])
        delta_0 = -direction * share * problem.bound * np.sign(sensitivity)
        y = prediction.output - problem.response.respond(delta_0)
        matched = _matched(problem, normal, y, p)
        if matched is None or not _keeps_orientation(normal, problem.model(matched).jacobian):
            return no_end
        gain = direction * (matched[parameter] - p[parameter])
        if gain < -ended or abs(matched[parameter] - estimate[parameter]) > reach:
            return no_end
        p = matched
        if share == 1.0 and gain <= ended:
            return float(p[parameter]) + direction * ended
    return no_end


def _keeps_orientation(normal: NDArray[np.float64], jacobian: NDArray[np.float64]) -> bool:
    """Return whether `normal J` has the positive determinant that it has at the estimate."""
    product: Matrix = np.einsum("pky,kyq->pq", normal, jacobian)
    sign: float = np.linalg.slogdet(product)[0]
    return sign > 0.0


def _matched(
    problem: BoundedDisturbance, normal: NDArray[np.float64], y: Matrix, start: Vector
) -> Vector | None:
    """Solve `normal (g(p) - y) = 0` by Newton's method; None where it does not converge."""
    p = start
    for _ in range(MOST_STEPS):
        with np.errstate(over="ignore", invalid="ignore"):
            prediction = problem.model(p)
        rows = _theta_rows(normal, prediction.jacobian)
        if rows is None:
            return None
        step: Vector = np.einsum("pky,ky->p", rows, y - prediction.output)
        p = p + step
        change = prediction.jacobian @ step
        if np.linalg.norm(change) <= NEWTON_CHANGE * np.linalg.norm(prediction.output):
            return p
    return None


def _theta_rows(
    normal: NDArray[np.float64], jacobian: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Compute `(normal J)^-1 normal`, shape ``(n_p, N, n_y)``; None where it is singular."""
    product: Matrix = np.einsum("pky,kyq->pq", normal, jacobian)
    if not np.isfinite(product).all():
        return None
    size = np.sqrt(np.abs(np.diag(product)))
    if not size.min() > 0.0 or np.linalg.cond(product / np.outer(size, size)) > SINGULAR:
        return None
    inverse = np.linalg.inv(product)
    return np.asarray(np.tensordot(inverse, normal, axes=1), np.float64)


def _root(weight: Matrix) -> Matrix:
    """Factor `weight = root root'`."""
    root = np.linalg.cholesky(weight)
    return root.astype(np.float64)


def _whitened(jacobian: NDArray[np.float64], root: Matrix) -> Matrix:
    n_p = jacobian.shape[2]
    rows: Matrix = np.einsum("kyp,yw->kwp", jacobian, root)
    return rows.reshape(-1, n_p)
