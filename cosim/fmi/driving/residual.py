"""The residual form of a model exchange FMU (FMI-LS-DAE), and the method that integrates it.

::

    x' = f(t, x, z, u),   0 = g(t, x, z, u),   dg/dz regular (index 1)

The method is implicit Runge-Kutta: Radau IIA with three stages, of order 5 for x and z (Hairer and
Wanner, Solving Ordinary Differential Equations II, sections IV.5, IV.8 and VI.1). A step goes from
t_0 to t_0 + h. Unknown are the stages X_i = x_0 + Y_i and z_i at t_i = t_0 + c_i h::

    Y_i = h sum_j a_ij f(t_j, X_j, z_j),   0 = g(t_i, X_i, z_i)

The last stage is the end of the step (c_3 = 1), so that what is reached satisfies the algebraic
equation. Newton's iteration uses one matrix for all of its steps, and for the next communication
steps as long as it converges fast with it; where it does not, the derivatives are those of each
stage at each iteration::

    [ I - h a (x) f_x    - h a (x) f_z ]
    [     I (x) g_x          I (x) g_z ]

The iteration ends where what is left is rounding: the only error is that of the method. All sums
run in a fixed order, without BLAS and LAPACK, which give other bits on other processors.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Final, Literal, NamedTuple, TypeAlias, final

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.errors import FmuError, RunError
from cosim.fmi.description import Dae, Description, Formulation
from cosim.fmi.driving.solvers import SolutionPoint
from cosim.fmi.instance import ModelExchangeInstance
from cosim.fmi.references import ReferenceMap
from cosim.native.numerics.linear import affine, invert

DaeForm: TypeAlias = Literal["ode", "residual"]
FORMS: Final[tuple[DaeForm, ...]] = ("ode", "residual")
RADAU: Final = "Radau IIA"

ROOT: Final = math.sqrt(6.0)
NODES: Final = ((4.0 - ROOT) / 10.0, (4.0 + ROOT) / 10.0)  # c_1, c_2; c_3 = 1
WEIGHTS: Final = np.array(
    [
        [(88.0 - 7.0 * ROOT) / 360.0, (296.0 - 169.0 * ROOT) / 1800.0, (-2.0 + 3.0 * ROOT) / 225.0],
        [(296.0 + 169.0 * ROOT) / 1800.0, (88.0 + 7.0 * ROOT) / 360.0, (-2.0 - 3.0 * ROOT) / 225.0],
        [(16.0 - ROOT) / 36.0, (16.0 + ROOT) / 36.0, 1.0 / 9.0],
    ]
)
FEW: Final = 7  # iterations with one matrix
MANY: Final = 25  # iterations with a matrix of their own each
EXACT: Final = 1e-15  # correction, relative to the scale, that is rounding
# Largest correction that may be rounding, where corrections do not become smaller any more.
PLATEAU: Final = 1e-11
SLOW: Final = 0.05  # rate of convergence from which the matrix is computed anew
SAME: Final = 1e-8  # relative difference of two steps that can have one matrix
EPSILON: Final = float(np.finfo(np.float64).eps)
DIFFERENCE: Final = EPSILON ** (1.0 / 3.0)  # of central differences: error about its square

Equations: TypeAlias = Callable[[float, Vector], Vector]  # (t, (x, z)) -> (x', g)


def require_residual_form(description: Description) -> Dae:
    """Return the residual form of an FMU, if it is one that can be integrated here.

    Raises
    ------
    FmuError
        If there is none or a broken one, or it is not semi-explicit of index 1: with derivatives of
        its equations beside them, or with equations for the derivatives of the states.
    """
    from cosim.fmi.reading.dae import MANIFEST  # rarely needed

    subject = f'{description.name}: dae = "residual"'
    dae = description.dae
    if not description.version.startswith("3."):
        raise FmuError(
            f"{subject}: FMI {description.version} has no residual form, the layered standard is "
            'on top of FMI 3; use "ode"'
        )
    if dae is None:
        raise FmuError(
            f"{subject}: the FMU declares no residual form; expected the manifest {MANIFEST}; "
            'use "ode"'
        )
    if dae.problems:
        problems = [f"{subject}: {MANIFEST}: {problem}" for problem in dae.problems]
        raise FmuError("\n".join(problems))
    missing = []
    if not dae.algebraic:
        missing.append("no AlgebraicVariables")
    if not dae.residuals:
        missing.append("no Residual")
    if missing:
        raise FmuError(
            f"{subject}: {MANIFEST} lists {' and '.join(missing)}, so that the form is not known; "
            'use "ode"'
        )
    derivatives = {v.name for v in description.variables if v.derivative_of is not None}
    for equation in dae.residuals:
        _check_equation(subject, equation, derivatives)
    return dae


def _check_equation(subject: str, equation: Sequence[Formulation], derivatives: set[str]) -> None:
    """Refuse an equation that is not of index 1, or implicit in the derivatives of states."""
    first = equation[0]
    if len(equation) > 1 or (first.index or 0) > 1:
        raise FmuError(
            f"{subject}: {first.name!r} is an equation of higher index; expected index 1, without "
            "derivatives beside it"
        )
    if derivatives.intersection(first.dependencies or ()):
        raise FmuError(
            f"{subject}: {first.name!r} depends on derivatives of states; expected explicit "
            "equations for them"
        )


@final
class ResidualForm:
    """f and g of an FMU where it is, and the z that solves g = 0 there.

    Parameters
    ----------
    instance : ModelExchangeInstance

    Raises
    ------
    FmuError
        As ``require_residual_form``.
    """

    def __init__(self, instance: ModelExchangeInstance) -> None:
        description = instance.description
        dae = require_residual_form(description)
        derivative_of = {
            v.derivative_of: v.name for v in description.variables if v.derivative_of is not None
        }
        derivatives = [derivative_of[name] for name in description.states]
        residuals = [formulation.name for (formulation,) in dae.residuals]
        self._instance = instance
        self._name = description.name
        self._n_x = description.n_states
        self._algebraic = description.references_of(dae.algebraic)
        self._residuals = description.references_of(residuals)
        self._knowns = description.references_of([*description.states, *dae.algebraic])
        self._unknowns = description.references_of([*derivatives, *residuals])
        self._has_derivatives = (
            description.capabilities["me"].directional_derivatives
            and self._knowns.all_float64
            and self._unknowns.all_float64
        )
        elements = self._algebraic.elements
        self.nominals = np.array([abs(e.variable.nominal or 1.0) for e in elements])

    def set_variables(self, w: Vector) -> None:
        """Set x and z."""
        if self._n_x:
            self._instance.set_continuous_states(w[: self._n_x])
        self._instance.set_float64(self._algebraic, w[self._n_x :])

    def evaluate(self) -> Vector:
        """Return x' and g."""
        g = self._instance.get_float64(self._residuals)
        if not self._n_x:
            return g
        return np.concatenate([self._instance.get_derivatives(), g])

    def jacobian(self, w: Vector, equations: Callable[[Vector], Vector], scale: Vector) -> Matrix:
        """Return the derivatives of x' and g by x and z at ``w``, which the FMU has.

        They come from the FMU where it provides them, else from central differences.
        """
        if self._has_derivatives:
            return self._derivatives(self._unknowns, self._knowns)
        return differences(equations, w, scale)

    def solve(self, t: float, w: Vector) -> Vector:
        """Return the FMU's states, and the z that solve the algebraic equation with them.

        The iteration begins with the z of ``w``; afterwards the FMU has the solution.

        Raises
        ------
        RunError
            If Newton's iteration finds none.
        """
        x = self._instance.get_continuous_states() if self._n_x else np.empty(0)
        z = w[self._n_x :] if w.size else self._instance.get_float64(self._algebraic)

        def equations(z: Vector) -> Vector:
            self._instance.set_float64(self._algebraic, z)
            return self._instance.get_float64(self._residuals)

        def correction(z: Vector) -> Vector:
            g = equations(z)
            derivatives = self._by_z(z, equations)
            return affine([(invert(derivatives), -g)])

        solution = newton(correction, z, self.nominals, MANY)
        if solution.problem:
            raise _failure(self._name, t, equations(solution.v), solution)
        self._instance.set_float64(self._algebraic, solution.v)
        return np.concatenate([x, solution.v])

    def _by_z(self, z: Vector, equations: Callable[[Vector], Vector]) -> Matrix:
        """Return the derivatives of g by z."""
        if self._has_derivatives:
            return self._derivatives(self._residuals, self._algebraic)
        scale = np.maximum(np.abs(z), self.nominals)
        return differences(equations, z, scale)

    def _derivatives(self, unknowns: ReferenceMap, knowns: ReferenceMap) -> Matrix:
        seeds = np.eye(knowns.size)
        columns = [
            self._instance.get_directional_derivative(unknowns, knowns, seed) for seed in seeds
        ]
        return np.column_stack(columns)


def differences(f: Callable[[Vector], Vector], v: Vector, scale: Vector) -> Matrix:
    """Return the derivatives of f at ``v`` by central differences.

    Their error does not reach the solution: the iteration that uses them corrects it.
    """
    columns = []
    for step in np.diag(DIFFERENCE * scale):
        above = v + step
        below = v - step
        change = f(above) - f(below)
        columns.append(change / (above - below).sum())
    return np.column_stack(columns)


class Solution(NamedTuple):
    """Where Newton's iteration ended.

    Parameters
    ----------
    v : Vector
    rate : float
        Of one correction to the one before, at worst.
    problem : str
        Why it failed, if it did.
    """

    v: Vector
    rate: float = math.inf
    problem: str = ""


def newton(
    correction: Callable[[Vector], Vector], v: Vector, nominals: Vector, iterations: int
) -> Solution:
    """Correct ``v`` until what is left is rounding.

    A correction counts relative to v, or to its nominal value if that is larger. The next
    corrections sum up to ``rate / (1 - rate)`` times the last (Hairer and Wanner II, section IV.8).
    """
    rate = 0.0
    size = math.nan
    size_before = math.nan
    for _ in range(iterations):
        try:
            change = correction(v)
        except np.linalg.LinAlgError:
            return Solution(v, problem="its matrix is singular")
        scale = np.maximum(np.abs(v), nominals)
        size = float((np.abs(change) / scale).max())
        if size <= EXACT:
            return Solution(v, rate)
        if not math.isfinite(size):
            return Solution(v, problem="its corrections are not finite")
        v = v + change
        ratio = size / size_before  # NaN at first, so that every comparison with it is false
        size_before = size
        if ratio < 1.0 and ratio / (1.0 - ratio) * size <= EXACT:
            return Solution(v, max(rate, ratio))
        if ratio > 0.5 and size <= PLATEAU:
            return Solution(v, rate)
        if ratio > rate:
            rate = ratio
    return Solution(
        v,
        problem=f"corrections do not vanish in {iterations} iterations, the last is {size:.3g}",
    )


def _failure(name: str, t: float, g: Vector, solution: Solution) -> RunError:
    """Return the error for a time at which no solution was found."""
    return RunError(
        f"{name}: no solution of the residual form at t = {t} s: largest residual "
        f"{np.abs(g).max():.3g}; Newton's iteration: {solution.problem}; smaller communication "
        "steps or other start values may help"
    )


class RadauState(NamedTuple):
    """A copy of a ``RadauIIA``."""

    begin: SolutionPoint
    end: SolutionPoint
    nominals: Vector
    J: Matrix | None
    inverse: tuple[float, Matrix] | None


@final
class RadauIIA:
    """Radau IIA of order 5: one step to wherever the step may end.

    The state within it, (x, z), is that of a shorter step.

    Parameters
    ----------
    name : str
        Of the FMU.
    equations : callable
        x' and g at t and (x, z).
    jacobian : callable
        Their derivatives by (x, z), given the scale of (x, z).
    n : int
        Number of states x.
    """

    def __init__(
        self,
        name: str,
        equations: Equations,
        jacobian: Callable[[float, Vector, Vector], Matrix],
        n: int,
    ) -> None:
        self._name = name
        self._f = equations
        self._jacobian = jacobian
        self._n = n
        self.start(0.0, np.empty(0), np.empty(0))

    def start(self, t: float, x: Vector, nominals: Vector) -> None:
        """Begin at ``t`` with (x, z)."""
        self._begin: SolutionPoint = (t, x)
        self._end = self._begin
        self._nominals = nominals
        self._forget_matrix()

    def step(self, t_end: float) -> float:
        """Take one step to ``t_end``.

        Raises
        ------
        RunError
            If Newton's iteration does not converge.
        """
        self._begin = self._end
        self._end = (t_end, self._integrate_to(t_end))
        return t_end

    def at(self, t: float) -> Vector:
        """Return (x, z) at a time within the last step."""
        t_end, w_end = self._end
        return w_end if t == t_end else self._integrate_to(t)

    def save(self) -> RadauState:
        """Copy the state: where it is, and the matrix, as its age decides the last bits."""
        return RadauState(self._begin, self._end, self._nominals, self._J, self._inverse)

    def restore(self, state: RadauState) -> None:
        """Go back to a saved state."""
        self._begin = state.begin
        self._end = state.end
        self._nominals = state.nominals
        self._J = state.J
        self._inverse = state.inverse

    def _integrate_to(self, t: float) -> Vector:
        """Return (x, z) after one step from where the last one began."""
        n = self._n
        solution = self._solve_stages(t, FEW)
        if solution.problem:
            self._forget_matrix()
            solution = self._solve_stages(t, MANY)
        stages = solution.v.reshape(len(WEIGHTS), -1)
        last: Vector = stages[-1].copy()
        _, w_begin = self._begin
        last[:n] += w_begin[:n]
        if solution.problem:
            g = self._f(t, last)[n:]
            raise _failure(self._name, t, g, solution)
        if solution.rate > SLOW:
            self._forget_matrix()
        return last

    def _solve_stages(self, t: float, iterations: int) -> Solution:
        """Iterate for (Y_i, z_i), one stage after the other.

        There are few iterations with the matrix that is kept, or many with new ones.
        """
        t_begin, w_begin = self._begin
        n = self._n
        h = t - t_begin
        base = np.zeros(w_begin.size)
        base[:n] = w_begin[:n]
        c1, c2 = NODES
        times = (t_begin + c1 * h, t_begin + c2 * h, t)
        scale = self._scale(w_begin)

        def correction(v: Vector) -> Vector:
            increments = v.reshape(len(times), -1)
            stages = base + increments
            points = list(zip(times, stages, strict=True))
            residuals = np.array([self._f(time, stage) for time, stage in points])
            slopes = _weighted(residuals[:, :n])
            residuals[:, :n] = increments[:, :n] - h * slopes
            if iterations == FEW:
                inverse = self._kept_inverse(h)
            else:
                jacobians = [self._jacobian(time, stage, scale) for time, stage in points]
                inverse = _inverse(jacobians, n, h)
            return affine([(inverse, -residuals.ravel())])

        first_guess = np.tile(w_begin - base, len(times))
        return newton(correction, first_guess, np.tile(scale, len(times)), iterations)

    def _kept_inverse(self, h: float) -> Matrix:
        """Return the inverse for a step of length ``h``, with derivatives from where one began."""
        if self._J is None:
            t, w = self._begin
            self._J = self._jacobian(t, w, self._scale(w))
            self._inverse = None
        if self._inverse is None or abs(self._inverse[0] - h) > SAME * h:
            jacobians = [self._J] * len(WEIGHTS)
            self._inverse = (h, _inverse(jacobians, self._n, h))
        return self._inverse[1]

    def _forget_matrix(self) -> None:
        self._J = None
        self._inverse = None

    def _scale(self, w: Vector) -> Vector:
        scale: Vector = np.maximum(np.abs(w), self._nominals)
        return scale


def _weighted(slopes: Matrix) -> Matrix:
    """Return the sums of the stages' slopes, shape (3, n), for each stage; in a fixed order."""
    total = np.zeros(slopes.shape)
    for weights, slope in zip(WEIGHTS.T, slopes, strict=True):
        total += np.multiply.outer(weights, slope)
    return total


def _inverse(jacobians: Sequence[Matrix], n: int, h: float) -> Matrix:
    """Return the inverse of Newton's matrix for the derivatives at each stage."""
    stages = len(jacobians)
    size = len(jacobians[0])
    J = np.array(jacobians)
    matrix = np.einsum("ij,jkl->ikjl", np.eye(stages), J)
    identity = np.einsum("ij,kl->ikjl", np.eye(stages), np.eye(n, size))
    slopes = np.einsum("ij,jkl->ikjl", WEIGHTS, J[:, :n])
    matrix[:, :n] = identity - h * slopes
    return invert(matrix.reshape(stages * size, -1))
