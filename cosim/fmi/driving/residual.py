"""The residual form of a model exchange unit (FMI-LS-DAE), and the implicit Runge-Kutta method that integrates it.

::

    x' = f(t, x, z, u),   0 = g(t, x, z, u),   dg/dz regular (index 1)

Radau IIA with three stages is of order 5 for x and z (Hairer and Wanner, Solving Ordinary Differential Equations II, sections
IV.5, IV.8 and VI.1). A step goes from t_0 to t_0 + h. Unknown are the stages X_i = x_0 + Y_i and z_i at t_i = t_0 + c_i h::

    Y_i = h sum_j a_ij f(t_j, X_j, z_j),   0 = g(t_i, X_i, z_i)

The last stage is the end of the step (c_3 = 1), so that what is reached satisfies the algebraic equation. Newton's iteration uses
one matrix for all of its steps, and for the next communication steps as long as it converges fast with it; where it does not, the
derivatives are those of each stage at each iteration::

    [ I - h a (x) f_x    - h a (x) f_z ]
    [     I (x) g_x          I (x) g_z ]

The iteration ends where what is left is rounding: the only error is that of the method.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Final, Literal, NamedTuple, TypeAlias, final

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.errors import FmuError, RunError
from cosim.fmi.description import Dae, Description
from cosim.fmi.instance import ModelExchangeInstance
from cosim.fmi.reading.dae import MANIFEST
from cosim.fmi.references import ReferenceMap

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
PLATEAU: Final = 1e-11  # largest correction that may be rounding, where corrections do not become smaller any more
SLOW: Final = 0.05  # rate of convergence from which the matrix is computed anew
SAME: Final = 1e-8  # relative difference of two steps that can have one matrix
DIFFERENCE: Final = float(np.finfo(np.float64).eps) ** (
    1.0 / 3.0
)  # of central differences: error about its square

Equations: TypeAlias = Callable[[float, Vector], Vector]  # (t, (x, z)) -> (x', g)
Jacobian: TypeAlias = Callable[[float, Vector], Matrix]


def need_residual_form(description: Description) -> Dae:
    """Give the residual form of a unit, if it is one that can be integrated here.

    Raises
    ------
    FmuError
        If there is none or a broken one, or it is not semi-explicit of index 1: with derivatives of its equations beside them, or
        with equations for the derivatives of the states.
    """
    about, dae = f'{description.name}: dae = "residual"', description.dae
    if not description.version.startswith("3."):
        raise FmuError(
            f'{about}: FMI {description.version} has no residual form, the layered standard is on top of FMI 3; use "ode"'
        )
    if dae is None:
        raise FmuError(
            f'{about}: the FMU says nothing of a residual form, needed the manifest {MANIFEST}; use "ode"'
        )
    if dae.problems:
        raise FmuError("\n".join(f"{about}: {MANIFEST}: {problem}" for problem in dae.problems))
    missing = [
        name
        for name, found in (("AlgebraicVariables", dae.algebraic), ("Residual", dae.residuals))
        if not found
    ]
    if missing:
        raise FmuError(
            f'{about}: {MANIFEST} lists no {" and no ".join(missing)}, so that the form is not known; use "ode"'
        )
    derivatives = {v.name for v in description.variables if v.derivative_of is not None}
    for equation in dae.residuals:
        first = equation[0]
        if len(equation) > 1 or (first.index or 0) > 1:
            raise FmuError(
                f"{about}: {first.name!r} is an equation of higher index; needed index 1, without derivatives beside it"
            )
        if derivatives.intersection(first.dependencies or ()):
            raise FmuError(
                f"{about}: {first.name!r} depends on derivatives of states; needed them in explicit form"
            )
    return dae


@final
class ResidualForm:
    """f and g of a unit where it is, and the z that solves g = 0 there.

    Parameters
    ----------
    unit : ModelExchangeInstance

    Raises
    ------
    FmuError
        As ``need_residual_form``.
    """

    def __init__(self, instance: ModelExchangeInstance) -> None:
        description = instance.description
        dae = need_residual_form(description)
        derivative_of = {
            v.derivative_of: v.name for v in description.variables if v.derivative_of is not None
        }
        derivatives, residuals = (
            [derivative_of[name] for name in description.states],
            [one.name for (one,) in dae.residuals],
        )
        self._instance, self._name, self.n = instance, description.name, description.n_states
        self._algebraic, self._residuals = (
            description.references_of(dae.algebraic),
            description.references_of(residuals),
        )
        self._knowns = description.references_of([*description.states, *dae.algebraic])
        self._unknowns = description.references_of([*derivatives, *residuals])
        able = description.capabilities["me"].directional_derivatives
        self._tells = able and self._knowns.all_float64 and self._unknowns.all_float64
        elements = self._algebraic.elements
        self.nominals = np.array([abs(e.variable.nominal or 1.0) for e in elements])

    def put(self, w: Vector) -> None:
        """Set x and z."""
        if self.n:
            self._instance.set_continuous_states(w[: self.n])
        self._instance.set_float64(self._algebraic, w[self.n :])

    def values(self) -> Vector:
        """Give x' and g."""
        g = self._instance.get_float64(self._residuals)
        return np.concatenate([self._instance.get_derivatives(), g]) if self.n else g

    def jacobian(self, w: Vector, equations: Callable[[Vector], Vector], scale: Vector) -> Matrix:
        """Give the derivatives of x' and g by x and z at ``w``, which the unit has; from the unit, where it knows them."""
        if self._tells:
            return self._derivatives(self._unknowns, self._knowns)
        return differences(equations, w, scale)

    def solved(self, t: float, w: Vector) -> Vector:
        """Give the unit's states, and the z that solve the algebraic equation with them, from a ``w`` before; the unit has both.

        Raises
        ------
        RunError
            If Newton's iteration finds none.
        """
        x = self._instance.get_continuous_states() if self.n else np.empty(0)
        z = w[self.n :] if w.size else self._instance.get_float64(self._algebraic)

        def equations(z: Vector) -> Vector:
            self._instance.set_float64(self._algebraic, z)
            return self._instance.get_float64(self._residuals)

        def correction(z: Vector) -> Vector:
            g = equations(z)
            change: Vector = np.linalg.solve(self._by_z(z, equations), -g).astype(np.float64)
            return change

        found = newton(correction, z, self.nominals, MANY)
        if found.wrong:
            raise failure(self._name, t, equations(found.v), found)
        self._instance.set_float64(self._algebraic, found.v)
        return np.concatenate([x, found.v])

    def _by_z(self, z: Vector, equations: Callable[[Vector], Vector]) -> Matrix:
        if self._tells:
            return self._derivatives(self._residuals, self._algebraic)
        return differences(equations, z, np.maximum(np.abs(z), self.nominals))

    def _derivatives(self, unknowns: ReferenceMap, knowns: ReferenceMap) -> Matrix:
        seeds = np.eye(knowns.size)
        return np.column_stack(
            [self._instance.get_directional_derivative(unknowns, knowns, seed) for seed in seeds]
        )


def differences(f: Callable[[Vector], Vector], v: Vector, scale: Vector) -> Matrix:
    """Give the derivatives of f at ``v`` by central differences; an iteration corrects their error."""
    steps = np.diag(DIFFERENCE * scale)
    return np.column_stack(
        [(f(v + step) - f(v - step)) / ((v + step) - (v - step)).sum() for step in steps]
    )


class Solution(NamedTuple):
    """Where Newton's iteration ended. rate: of one correction to the one before, at worst; wrong: why it failed, if it did."""

    v: Vector
    rate: float = math.inf
    wrong: str = ""


def newton(
    correction: Callable[[Vector], Vector], v: Vector, nominals: Vector, iterations: int
) -> Solution:
    """Correct ``v`` until what is left is rounding; a correction counts relative to v, or to its nominal value if that is larger.

    The next corrections sum up to ``rate / (1 - rate)`` times the last (Hairer and Wanner II, section IV.8).
    """
    before, rate, size = math.nan, 0.0, math.nan
    for _ in range(iterations):
        try:
            change = correction(v)
        except np.linalg.LinAlgError:
            return Solution(v, wrong="its matrix is singular")
        size = float((np.abs(change) / np.maximum(np.abs(v), nominals)).max())
        if size <= EXACT:
            return Solution(v, rate)
        if not math.isfinite(size):
            return Solution(v, wrong="its corrections are not finite")
        v, ratio, before = v + change, size / before, size  # the first ratio is NaN: not known
        if ratio < 1.0 and ratio / (1.0 - ratio) * size <= EXACT:
            return Solution(v, max(rate, ratio))
        if ratio > 0.5 and size <= PLATEAU:
            return Solution(v, rate)
        rate = ratio if ratio > rate else rate
    return Solution(
        v, wrong=f"corrections do not vanish in {iterations} iterations, the last is {size:.3g}"
    )


def failure(name: str, t: float, g: Vector, found: Solution) -> RunError:
    """Say where no solution was found."""
    return RunError(
        f"{name}: no solution of the residual form at t = {t} s: largest residual {np.abs(g).max():.3g}; Newton's iteration: "
        f"{found.wrong}; smaller communication steps or other start values may help"
    )


@final
class RadauIIA:
    """Radau IIA of order 5: one step to wherever the step may end; the state within it, (x, z), is that of a shorter step.

    Parameters
    ----------
    name : str
        Of the unit.
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
        self._name, self._f, self._jacobian, self._n = name, equations, jacobian, n
        self._J: Matrix | None = None
        self._inverse: tuple[float, Matrix] | None = None  # of the matrix for a step of that length
        self.start(0.0, np.empty(0), np.empty(0))

    def start(self, t: float, x: Vector, nominals: Vector) -> None:
        """Begin at ``t`` with (x, z)."""
        self._begin = self._end = (t, x)
        self._nominals = nominals
        self._J = self._inverse = None

    def step(self, t_end: float) -> float:
        """Take one step to ``t_end``.

        Raises
        ------
        RunError
            If Newton's iteration does not converge.
        """
        self._begin = self._end
        self._end = t_end, self._reach(t_end)
        return t_end

    def at(self, t: float) -> Vector:
        """Give (x, z) at a time within the last step."""
        return self._end[1] if t == self._end[0] else self._reach(t)

    def save(self) -> object:
        """Copy the state: where it is, and the matrix."""
        return self._begin, self._end, self._nominals, self._J, self._inverse

    def restore(self, state: object) -> None:
        """Go back to a saved state."""
        self._begin, self._end, self._nominals, self._J, self._inverse = state  # type: ignore[misc]

    def _reach(self, t: float) -> Vector:
        """Solve for the stages of a step from its begin to ``t``."""
        found = self._stages(t, FEW)
        if found.wrong:
            self._J = self._inverse = None
            found = self._stages(t, MANY)
        last: Vector = found.v.reshape(len(WEIGHTS), -1)[-1].copy()
        last[: self._n] += self._begin[1][: self._n]
        if found.wrong:
            raise failure(self._name, t, self._f(t, last)[self._n :], found)
        if found.rate > SLOW:
            self._J = self._inverse = None
        return last

    def _stages(self, t: float, iterations: int) -> Solution:
        """Iterate for (Y_i, z_i), one stage after the other: few times with the matrix that is kept, or many with new ones."""
        (begin, w), n = self._begin, self._n
        h, base = t - begin, np.concatenate([w[:n], np.zeros(w.size - n)])
        times, scale = (begin + NODES[0] * h, begin + NODES[1] * h, t), self._scale(w)

        def correction(v: Vector) -> Vector:
            stages = base + v.reshape(len(times), -1)
            rest = np.array(
                [self._f(time, stage) for time, stage in zip(times, stages, strict=True)]
            )
            rest[:, :n] = v.reshape(len(times), -1)[:, :n] - h * (WEIGHTS @ rest[:, :n])
            if iterations == FEW:
                inverse = self._kept(h)
            else:
                inverse = _inverse(
                    [self._jacobian(*stage, scale) for stage in zip(times, stages, strict=True)],
                    n,
                    h,
                )
            change: Vector = inverse @ -rest.ravel()
            return change

        return newton(
            correction, np.tile(w - base, len(times)), np.tile(scale, len(times)), iterations
        )

    def _kept(self, h: float) -> Matrix:
        """Give the inverse for a step of length ``h``, with derivatives from where a step began."""
        if self._J is None:
            t, w = self._begin
            self._J, self._inverse = self._jacobian(t, w, self._scale(w)), None
        if self._inverse is None or abs(self._inverse[0] - h) > SAME * h:
            self._inverse = h, _inverse([self._J] * len(WEIGHTS), self._n, h)
        return self._inverse[1]

    def _scale(self, w: Vector) -> Vector:
        scale: Vector = np.maximum(np.abs(w), self._nominals)
        return scale


def _inverse(J: Sequence[Matrix], n: int, h: float) -> Matrix:
    """Give the inverse of the matrix of Newton's iteration for the derivatives at each stage."""
    size, eye, by = len(J[0]), np.eye(len(J)), np.array(J)
    matrix = np.einsum("ij,jkl->ikjl", eye, by)
    matrix[:, :n] = np.einsum("ij,kl->ikjl", eye, np.eye(n, size)) - h * np.einsum(
        "ij,jkl->ikjl", WEIGHTS, by[:, :n]
    )
    inverse: Matrix = np.linalg.inv(matrix.reshape(len(J) * size, -1)).astype(np.float64)
    return inverse
