r"""A linear program that encloses all that recorded outputs allow, around a point p.

The time axis is divided into cells. Of each cell the data enter by the mean of its last samples,
one number an output: the fewer data the larger the set, never the smaller. What delta_0 does within
a cell to the state at its end and to this mean is a zonotope, the image of the box `|delta_0| <= d`
over all samples of the cell. It is enclosed by the polytope with its exact support in the principal
directions and in some between the first and each other one; the first is nearly the mean of
delta_0 over the cell. So every delta_0 that is a straight line between *samples* has its point in
the linear program, however coarse the cells.

What the cells cost is width, never the truth: neighboring cells share their node in the signal, not
in the program; the polytope is larger than the zonotope by an amount of second order in the cell;
and what happens between the ends of cells is not seen. In the example 200 cells give theta2 to
+-0.054 for d = 0.02 where all samples give +-0.047; 80 cells give +-0.064.

Noise is a bound on the mean of the averaged samples. `gaussian_noise_bound` gives one that holds
with a stated probability in all cells at once; then the interval holds with this probability.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.errors import AssumptionError
from cosim.theory.bounded.worst_case import BoundedDisturbance, IrregularResponse, Prediction
from cosim.theory.quantiles import GUARANTEED_CONFIDENCE, normal_two_sided

SparseMatrix: TypeAlias = Any  # of scipy, which is loaded late

CELLS = 200  # in which `cells_of` divides a recording
BETWEEN = 0.5  # slope of the directions between the first principal one and each other one
NEGLIGIBLE = 1e-12  # relative size of a principal direction without influence
MARGIN = 1e-6  # relative, on every bound: ten times the feasibility tolerance of the solver
# Of the solver. Where the set is far larger than the first order says, the programs are so badly
# conditioned that the simplex method takes minutes for one of them, and ends without an answer; an
# interior point needs the same 10 to 40 iterations for all. Presolve loses digits.
ATTEMPTS = (("highs-ipm", False), ("highs", True))
SOLVED = 0  # status of linprog
INFEASIBLE = 2
PIVOTS = 5  # most of them, a variable
MOST_PROGRAMS_IN_ALL = 400  # of one interval; about a second each for 200 cells

Watch: TypeAlias = Callable[[int], None]  # is told how many programs have been solved


@dataclass(frozen=True)
class Cells:
    """How the samples after the first one are divided into cells.

    Attributes
    ----------
    samples : int
        Number of samples in a cell; those after the last whole cell are not used.
    averaged : int
        How many of them, the last ones, are averaged.
    """

    samples: int
    averaged: int

    def __post_init__(self) -> None:
        if not 1 <= self.averaged <= self.samples:
            raise AssumptionError(
                f"averaged: expected 1 to {self.samples}, the samples of a cell, got "
                f"{self.averaged}"
            )

    def count(self, recorded: int) -> int:
        """Return the number of whole cells in so many recorded samples."""
        return (recorded - 1) // self.samples

    def means(self, values: Matrix) -> Matrix:
        """Average the last samples of each cell, ``(N, ...)`` to ``(cells, ...)``."""
        count = self.count(len(values))
        whole = values[1 : 1 + count * self.samples]
        cells = whole.reshape(count, self.samples, *values.shape[1:])
        means: Matrix = cells[:, -self.averaged :].mean(axis=1)
        return means


@dataclass(frozen=True, eq=False)
class RecordedOutputs:
    """Recorded outputs and what is known of their noise.

    Attributes
    ----------
    y : Matrix
        Shape ``(N, n_y)``.
    cells : Cells
    noise : Vector
        Largest magnitude of the mean noise of the averaged samples of any cell, ``(n_y,)``; zero
        for exact data.
    """

    y: Matrix
    cells: Cells
    noise: Vector

    def __post_init__(self) -> None:
        n_y = self.y.shape[1]
        if self.noise.shape != (n_y,) or not np.all(self.noise >= 0.0):
            raise AssumptionError(
                f"bounds of the noise: expected {n_y}, none negative, got {self.noise.tolist()}"
            )
        if not np.isfinite(self.y).all():
            raise AssumptionError("outputs: expected a finite number at every sample")
        if self.cells.count(len(self.y)) < 1:
            raise AssumptionError(
                f"samples: expected at least {1 + self.cells.samples}, one cell after the first "
                f"sample, got {len(self.y)}"
            )


def cells_of(recorded: int, noisy: bool) -> Cells:
    """Divide a recording into about 200 cells; average all samples of a cell if they are noisy.

    The last sample alone is best for exact data: it leaves delta_0 the least freedom in a cell.
    """
    samples = max((recorded - 1) // CELLS, 1)
    return Cells(samples, averaged=samples if noisy else 1)


def gaussian_noise_bound(
    sigma: Vector, cells: Cells, recorded: int, confidence: float = GUARANTEED_CONFIDENCE
) -> Vector:
    """Bound the mean noise of every cell and output at once, with probability ``confidence``.

    Parameters
    ----------
    sigma : Vector
        Standard deviation of the white Gaussian noise of each output, shape ``(n_y,)``.
    cells : Cells
    recorded : int
        Number of recorded samples.
    confidence : float
        In (0, 1). By the inequality of Bonferroni.
    """
    means = cells.count(recorded) * len(sigma)
    bound: Vector = normal_two_sided(confidence, means) * sigma / np.sqrt(cells.averaged)
    return bound


@dataclass(frozen=True, eq=False)
class ProgramSolution:
    """What a linear program gives: the step of p, the multiple of the bound, the violation."""

    step: Vector
    multiple: float
    violation: float


class FeasibleProgram:
    """The linear program around a point p.

    Its unknowns are the states at the ends of the cells from rest and the coordinates of the cells
    (*inner* unknowns), the multiple of the bound of delta_0, the violation of the output bounds,
    and the step of p. States and outputs are in units of what delta_0 and the noise can do to them.
    """

    def __init__(
        self, problem: BoundedDisturbance, recorded: RecordedOutputs, watch: Watch | None = None
    ) -> None:
        from scipy import sparse

        self._watch = watch
        self._solved = 0
        self.problem = problem
        self.recorded = recorded
        count = recorded.cells.count(len(recorded.y))
        unscaled = _cell_response(problem.response, problem.bound, recorded.cells)
        state_unit = _state_reach(unscaled, count)
        output_unit = _output_reach(unscaled, state_unit) + recorded.noise
        self.output_unit = _or_one(output_unit)
        cell = _scaled(unscaled, _or_one(state_unit), self.output_unit)
        n = len(cell.end)
        same = sparse.identity(count)
        previous = sparse.eye(count, k=-1)
        state_change = sparse.kron(same, np.eye(n)) - sparse.kron(previous, cell.end)
        from_axes = sparse.kron(same, cell.end_axes)
        outputs = [sparse.kron(previous, cell.mean), sparse.kron(same, cell.mean_axes)]
        supports = sparse.kron(same, cell.supports)
        no_states = sparse.csr_matrix((supports.shape[0], n * count))
        dynamics = _with_columns(sparse.hstack([state_change, -from_axes]), 0.0, 0.0)
        self._dynamics = dynamics.tocsc()
        self._rows = _both_sides(
            _with_columns(sparse.hstack(outputs), 0.0, -1.0),
            _with_columns(sparse.hstack([no_states, supports]), -1.0 - MARGIN, 0.0),
        )

    @property
    def is_exhausted(self) -> bool:
        """Whether as many programs have been solved as one interval may take."""
        return self._solved >= MOST_PROGRAMS_IN_ALL

    def predict(self, p: Vector) -> Prediction:
        """Compute the model's output; infinities and NaN show a p out of its range."""
        with np.errstate(over="ignore", invalid="ignore"):
            return self.problem.model(p)

    def solve(
        self, prediction: Prediction, objective: Vector, limits: Matrix
    ) -> ProgramSolution | None:
        """Minimize over the step of p and the multiple of the bound, within the output bounds.

        Parameters
        ----------
        prediction : Prediction
            At p.
        objective : Vector
            Costs of the multiple and of the step, shape ``(1 + n_p,)``.
        limits : Matrix
            Of the multiple and of the step, shape ``(1 + n_p, 2)``.

        Returns
        -------
        ProgramSolution or None
            None where there is no solution within the bounds, or the solver fails.
        """
        costs = np.insert(objective, 1, 0.0)
        return self._minimize(prediction, costs, np.insert(limits, 1, 0.0, axis=0))

    def restore(self, prediction: Prediction, limits: Matrix) -> ProgramSolution | None:
        """Minimize the violation of the output bounds; None only where the solver fails."""
        costs = np.zeros(len(limits) + 1)
        costs[1] = 1.0
        any_violation = [0.0, np.inf]
        return self._minimize(prediction, costs, np.insert(limits, 1, any_violation, axis=0))

    def _minimize(
        self, prediction: Prediction, costs: Vector, limits: Matrix
    ) -> ProgramSolution | None:
        """Solve for multiple, violation and step, whose costs and limits are given."""
        columns = self._columns(prediction)
        n_p = columns.shape[1]
        unit = np.ones(2 + n_p)
        unit[2:] = 1.0 / _or_one(np.abs(columns).max(axis=0))
        n_inner = self._dynamics.shape[1] - 2
        unbounded = np.tile([-np.inf, np.inf], (n_inner, 1))
        minimum = self._solve_scaled(
            np.concatenate([np.zeros(n_inner), costs * unit]),
            np.concatenate([unbounded, limits / unit[:, None]]),
            columns * unit[2:],
            self._sides(prediction),
        )
        self._solved += 1
        if self._watch is not None:
            self._watch(self._solved)
        if minimum is None:
            return None
        outer = minimum[n_inner:] * unit
        return ProgramSolution(outer[2:], multiple=float(outer[0]), violation=float(outer[1]))

    def _columns(self, prediction: Prediction) -> Matrix:
        """Return the derivatives of the rows of the outputs by p."""
        means = self.recorded.cells.means(prediction.jacobian) / self.output_unit[:, None]
        return means.reshape(-1, means.shape[-1])

    def _sides(self, prediction: Prediction) -> Vector:
        """Return the right sides of the rows of the outputs, from above and from below."""
        recorded = self.recorded
        residual = recorded.cells.means(recorded.y - prediction.output) / self.output_unit
        noise = recorded.noise / self.output_unit + MARGIN
        above = noise + residual
        below = noise - residual
        return np.concatenate([above.ravel(), below.ravel()])

    def _solve_scaled(
        self, cost: Vector, bounds: Matrix, columns: Matrix, sides: Vector
    ) -> Vector | None:
        from scipy import sparse
        from scipy.optimize import linprog

        n_rows = self._rows.shape[0]
        n_p = columns.shape[1]
        of_supports = n_rows - len(sides)
        effect = np.concatenate([columns, -columns, np.zeros((of_supports, n_p))])
        A_ub = sparse.hstack([self._rows, sparse.csc_matrix(effect)])
        b_ub = np.concatenate([sides, np.zeros(of_supports)])
        n_equations = self._dynamics.shape[0]
        A_eq = sparse.hstack([self._dynamics, sparse.csc_matrix((n_equations, n_p))])
        constraints = (A_ub, b_ub, A_eq, np.zeros(n_equations), bounds)
        for method, presolve in ATTEMPTS:
            options = {"maxiter": PIVOTS * len(cost), "presolve": presolve}
            result = linprog(cost, *constraints, method=method, options=options)
            if result.status == SOLVED:
                minimum: Vector = result.x
                return minimum
            if result.status == INFEASIBLE:
                return None
        return None


@dataclass(frozen=True, eq=False)
class CellResponse:
    """How one cell follows from the state at its start and delta_0 within it.

    ``end (n, n)`` and ``mean (n_y, n)`` multiply the state; ``end_axes (n, r)`` and
    ``mean_axes (n_y, r)`` multiply the coordinates zeta of the effect of delta_0 in its principal
    directions; ``supports (k, r)`` are the rows with `|supports zeta| <= 1`.
    """

    end: Matrix
    mean: Matrix
    end_axes: Matrix
    mean_axes: Matrix
    supports: Matrix


def _cell_response(response: IrregularResponse, bound: Vector, cells: Cells) -> CellResponse:
    discrete = response.discrete
    n_y, n = response.C.shape
    nodes = cells.samples + 1
    state_by_node = np.zeros((n, nodes, len(bound)))
    mean_by_node = np.zeros((n_y, nodes, len(bound)))
    end = np.eye(n)
    mean = np.zeros((n_y, n))
    for sample in range(1, nodes):
        state_by_node = np.tensordot(discrete.Ad, state_by_node, axes=1)
        state_by_node[:, sample - 1] += discrete.B0
        state_by_node[:, sample] += discrete.B1
        end = discrete.Ad @ end
        if sample >= nodes - cells.averaged:
            mean_by_node += np.tensordot(response.C, state_by_node, axes=1)
            mean_by_node[:, sample] += response.D
            mean += response.C @ end
    effects = np.concatenate([state_by_node, mean_by_node / cells.averaged])
    generators = (effects * bound).reshape(n + n_y, -1)
    axes, coordinates = _principal_axes(generators)
    supports = _supports(coordinates)
    return CellResponse(end, mean / cells.averaged, axes[:n], axes[n:], supports)


def _principal_axes(generators: Matrix) -> tuple[Matrix, Matrix]:
    """Factor `generators = axes coordinates`, every row of the coordinates of absolute sum 1."""
    reach = _or_one(np.abs(generators).sum(axis=1))
    left, values, right = np.linalg.svd(generators / reach[:, None], full_matrices=False)
    kept = values > NEGLIGIBLE * values.max(initial=0.0)
    weighted = values[kept, None] * right[kept]
    extent = np.abs(weighted).sum(axis=1)
    coordinates = weighted / extent[:, None]
    directions = left[:, kept] * extent
    axes: Matrix = reach[:, None] * directions
    return axes, coordinates


def _supports(coordinates: Matrix) -> Matrix:
    """Return directions divided by the support of the zonotope in them, shape ``(k, r)``."""
    r = len(coordinates)
    directions = [*np.eye(r)]
    for other in range(1, r):
        for slope in (BETWEEN, -BETWEEN):
            direction = np.zeros(r)
            direction[0] = 1.0
            direction[other] = slope
            directions.append(direction)
    rows = np.array(directions).reshape(len(directions), r)
    support = np.abs(rows @ coordinates).sum(axis=1)
    scaled: Matrix = rows / support[:, None]
    return scaled


def _state_reach(cell: CellResponse, count: int) -> Vector:
    """Bound what delta_0 can do to each state in so many cells, shape ``(n,)``."""
    effect = cell.end_axes
    reach = np.zeros(len(cell.end))
    for _ in range(count):
        reach += np.abs(effect).sum(axis=1)
        effect = cell.end @ effect
    return reach


def _output_reach(cell: CellResponse, state_reach: Vector) -> Vector:
    """Bound what delta_0 can do to the mean outputs of a cell, shape ``(n_y,)``."""
    from_states = np.abs(cell.mean) @ state_reach
    within = np.abs(cell.mean_axes).sum(axis=1)
    reach: Vector = from_states + within
    return reach


def _scaled(cell: CellResponse, state_unit: Vector, output_unit: Vector) -> CellResponse:
    per_state = state_unit[:, None]
    per_output = output_unit[:, None]
    end = cell.end * state_unit / per_state
    mean = cell.mean * state_unit / per_output
    return CellResponse(
        end, mean, cell.end_axes / per_state, cell.mean_axes / per_output, cell.supports
    )


def _with_columns(matrix: SparseMatrix, multiple: float, violation: float) -> SparseMatrix:
    """Append the columns of the multiple of the bound and of the violation."""
    from scipy import sparse

    rows = matrix.shape[0]
    columns = np.tile([multiple, violation], (rows, 1))
    return sparse.hstack([matrix, sparse.csr_matrix(columns)])


def _both_sides(outputs: SparseMatrix, supports: SparseMatrix) -> SparseMatrix:
    """Stack the rows of both, from above and from below; the last two columns keep their sign."""
    from scipy import sparse

    signs = -np.ones(outputs.shape[1])
    signs[-2:] = 1.0
    mirror = sparse.diags(signs)
    return sparse.vstack([outputs, outputs @ mirror, supports, supports @ mirror]).tocsc()


def _or_one(unit: Vector) -> Vector:
    """Return the units with 1 in place of zero."""
    return np.where(unit > 0.0, unit, 1.0)
