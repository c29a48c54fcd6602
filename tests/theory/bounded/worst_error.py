"""The largest error of an estimate of theta that a search finds: for bounds to be held against.

The error of the nonlinear estimate is a smooth function of delta_0 on a box. Where it is largest,
each node stands at the end of its range that the gradient points to, unless the gradient is zero
there: a maximum is a fixed point of `delta_0 = d sign(s(delta_0))`, s the sensitivity at the
estimate from `g(p) + L delta_0`, now with the curvature of g in place of `J' W J` alone.
`worst_error` iterates this map, a refit each time, from any initial signal.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.errors import AssumptionError
from cosim.theory.bounded.worst_case import (
    BoundedDisturbance,
    Prediction,
    _root,
    _whitened,
    first_order,
)

MOST_STEPS = 60  # refits of one search, and Gauss-Newton steps of one refit
HALVINGS = 30  # of a Gauss-Newton step that does not lower the residual
REFIT_CHANGE = 1e-10  # change of the output by a step, relative to the residual, that ends a refit
ROUNDING = 1e-14  # the same, relative to the output
# relative, of a residual that counts as none: rounding hides the fall of the last steps
RISE = 1e-10
DIFFERENCE = 1e-5  # relative step of the differences that give the curvature


@dataclass(frozen=True, eq=False)
class WorstError:
    """The largest error found of one theta of the nonlinear estimate.

    Attributes
    ----------
    error : float
        Estimate minus truth, signed.
    delta_0 : Matrix
        What causes it, shape ``(N, n_d)``.
    estimate : Vector
        p estimated under it.
    """

    error: float
    delta_0: Matrix
    estimate: Vector


def refit(problem: BoundedDisturbance, y: Matrix, start: Vector) -> Vector:
    """Estimate p from y by weighted least squares, Gauss-Newton from ``start``.

    Raises
    ------
    AssumptionError
        If it does not converge.
    """
    root = _root(problem.weight)
    p = start
    prediction = problem.model(p)
    rounding = ROUNDING * float(np.linalg.norm(y @ root))
    for _ in range(MOST_STEPS):
        residual = (y - prediction.output) @ root
        J = _whitened(prediction.jacobian, root)
        solution = np.linalg.lstsq(J, residual.ravel())
        step: Vector = solution[0].astype(np.float64)
        change = float(np.linalg.norm(J @ step))
        if change <= REFIT_CHANGE * float(np.linalg.norm(residual)) + rounding:
            return p + step
        cost = _cost(problem, y, prediction)
        p, prediction = _descend(problem, y, p, step, cost)
    raise AssumptionError(
        f"output error from p = {start.tolist()} did not converge in {MOST_STEPS} steps"
    )


def worst_error(
    problem: BoundedDisturbance,
    p: Vector,
    parameter: int,
    direction: int,
    start: Matrix | None = None,
) -> WorstError:
    """Search the delta_0 under which the estimate of one theta errs most.

    A local search: a lower bound of the largest error, whatever it starts from.

    Parameters
    ----------
    problem : BoundedDisturbance
    p : Vector
        The truth, shape ``(n_p,)``.
    parameter : int
        Index of theta.
    direction : int
        1 for the largest, -1 for the smallest estimate.
    start : Matrix, optional
        First delta_0, shape ``(N, n_d)``; by default the first-order worst.
    """
    exact = problem.model(p).output
    delta_0 = start
    if delta_0 is None:
        delta_0 = (
            direction * problem.bound * np.sign(first_order(problem, p).sensitivity[parameter])
        )
    worst = _error_under(problem, p, parameter, delta_0)
    for _ in range(MOST_STEPS):
        y = exact + problem.response.respond(worst.delta_0)
        sensitivity = _curved_sensitivity(problem, y, worst.estimate, parameter)
        delta_0 = direction * problem.bound * np.sign(sensitivity)
        candidate = _error_under(problem, p, parameter, delta_0)
        if direction * candidate.error <= direction * worst.error:
            return worst
        worst = candidate
    return worst


def departure(problem: BoundedDisturbance, p: Vector) -> Vector:
    """Compute by how much the first order is wrong for each theta, ``(n_theta,)``.

    The largest relative difference of the nonlinear worst error, in both directions, from the
    first-order half width at p.
    """
    half_width = first_order(problem, p).half_width(problem.bound)
    departures = np.zeros(problem.n_theta)
    for parameter in range(problem.n_theta):
        up = worst_error(problem, p, parameter, 1).error
        down = worst_error(problem, p, parameter, -1).error
        ratios = np.array([up, -down]) / half_width[parameter]
        departures[parameter] = np.abs(ratios - 1.0).max()
    return departures


def _descend(
    problem: BoundedDisturbance, y: Matrix, p: Vector, step: Vector, cost: float
) -> tuple[Vector, Prediction]:
    """Take a step, or as much of it as does not raise the weighted residual."""
    for _ in range(HALVINGS):
        trial = p + step
        with np.errstate(over="ignore", invalid="ignore"):
            prediction = problem.model(trial)
            reached = _cost(problem, y, prediction)
        if reached <= cost * (1.0 + RISE):
            break
        step = step / 2.0
    return trial, prediction


def _cost(problem: BoundedDisturbance, y: Matrix, prediction: Prediction) -> float:
    residual = y - prediction.output
    weighted = residual @ problem.weight
    return float(np.vdot(residual, weighted))


def _error_under(
    problem: BoundedDisturbance, p: Vector, parameter: int, delta_0: Matrix
) -> WorstError:
    exact = problem.model(p).output
    y = exact + problem.response.respond(delta_0)
    estimate = refit(problem, y, p)
    error = float(estimate[parameter] - p[parameter])
    return WorstError(error, delta_0, estimate)


def _curved_sensitivity(
    problem: BoundedDisturbance, y: Matrix, estimate: Vector, parameter: int
) -> Matrix:
    """Compute the derivative of one theta of the estimate by delta_0, shape ``(N, n_d)``.

    The gradient `-J' W (y - g)` vanishes at the estimate; its derivative by p is
    `J' W J - sum r W d2g`, the implicit function theorem gives the rest.
    """
    prediction = problem.model(estimate)
    J = prediction.jacobian
    weighted_J = np.einsum("kyp,yw->kwp", J, problem.weight)
    normal = np.einsum("kyp,kyq->pq", weighted_J, J)
    residual_size = np.sqrt(_cost(problem, y, prediction))
    like_residual = residual_size / np.sqrt(np.diag(normal))
    scale = np.maximum(np.abs(estimate), like_residual)
    weighted_residual = (y - prediction.output) @ problem.weight
    curvature = _curvature(problem, estimate, weighted_residual, DIFFERENCE * scale)
    unit = np.zeros(len(estimate))
    unit[parameter] = 1.0
    direction = np.linalg.solve(normal - curvature, unit)
    functional = weighted_J @ direction
    return problem.response.adjoint(functional)


def _curvature(problem: BoundedDisturbance, p: Vector, functional: Matrix, steps: Vector) -> Matrix:
    """Compute the second derivatives of `functional' g` by central differences of the Jacobian.

    g is linear in the nuisance parameters, so that only the rows and columns of theta are not zero.
    """
    curvature = np.zeros((len(p), len(p)))
    for column in range(problem.n_theta):
        shift = np.zeros_like(p)
        shift[column] = steps[column]
        ahead = problem.model(p + shift).jacobian
        behind = problem.model(p - shift).jacobian
        change = (ahead - behind) / (2.0 * steps[column])
        curved = np.einsum("kyp,ky->p", change, functional)
        curvature[:, column] = curved
        curvature[column, :] = curved
    return curvature
