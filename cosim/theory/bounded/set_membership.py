r"""The interval of every theta that recorded data allow: set-membership estimation.

The *feasible set* holds every theta for which some nuisance parameters, some irregular part with
`|delta_0| <= d` and some noise within its bound give the recorded outputs exactly (see
``worst_case`` for the model). The truth is one of its points if the bounds are true, so
the smallest and the largest theta_i of the set enclose it: no statistics, no first order.

Why no interval around the estimate
-----------------------------------
What an estimate alone says about the truth - all p that some admissible delta_0 turns into this
estimate - is the same problem with as many functionals of the data as there are unknowns, so it is
never narrower than the feasible set; in the example with d = 0.02 it has no end at all from an
unlucky estimate. In a linear problem the half width of the feasible set is for no data larger than
the radius of information, the least worst error of any estimator, so that of least squares bounds
it. The estimate may lie outside of the interval: then it is the estimate that is wrong.

Beyond the linear program
-------------------------
For fixed theta everything else is linear. In theta the program is linearized at the current point
and solved again until the point does not move; there the linearization is exact, so the point is in
the set, and a local extremum.

The set may have several pieces, each around a local minimum of `least_bound`, the smallest multiple
of d for which a theta is in the set. They occur: for one of 140 random bang-bang signals in the
example with d = 0.02 the search for a feasible point from the estimate ended in a piece that is
feasible only from 1.001 d on. An interval is guaranteed only if a search begins near every piece;
`starts_around` begins at the estimate and at points around it, and whatever any of them reaches is
enclosed. For fixed theta `least_bound` is a convex problem without local minima, so that any theta
outside of the interval can be excluded by a value above 1, one by one or along a profile.

Reference: M. Milanese, G. Belforte, "Estimation theory and uncertainty intervals evaluation in
presence of unknown but bounded errors", IEEE Trans. Automatic Control 27 (1982).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from cosim.arrays import NAN, Mask, Matrix, Vector
from cosim.errors import AssumptionError
from cosim.theory.bounded.feasible_program import (
    FeasibleProgram,
    ProgramSolution,
    RecordedOutputs,
    Watch,
)
from cosim.theory.bounded.worst_case import (
    REACH,
    BoundedDisturbance,
    first_order,
)

VIOLATED = 1e-6  # relative violation from which on a point is outside
MOST_PROGRAMS = 60  # linear programs of one search
MOST_RETURNS = 8  # of one search, to the set that its steps left
SEARCH_CHANGE = 1e-6  # change by one linear program, in first-order half widths, that ends a search
LINEAR = 1e-3  # change, the same, of which the second order is as little
MISSED = 1e-5  # first-order half widths by which a search may end too early; added to every end
MOST_COMBINED = 3  # theta of which starts combine steps
STATED = np.array([1.0, 1.0])  # limits of the multiple of the bound: as it is
POSITIVE = np.array([0.0, np.inf])


@dataclass(frozen=True, eq=False)
class FeasibleInterval:
    """The extent of the feasible set in each theta.

    Attributes
    ----------
    lower, upper : Vector
        Shape ``(n_theta,)``; infinite where no end was found, NaN where no theta is feasible.
    vertices : Matrix
        The feasible theta that the searches reached, shape ``(k, n_theta)``; none where the bounds
        do not explain the data.
    unsolved : int
        Starts from which a linear program could not be solved, or not within those that an interval
        may take. Nothing is known of what is around them, so there is no end where there are any.
    """

    lower: Vector
    upper: Vector
    vertices: Matrix
    unsolved: int = 0

    @property
    def feasible(self) -> bool:
        """Whether a theta was found with which the bounds explain the data."""
        return len(self.vertices) > 0


@dataclass(frozen=True, eq=False)
class LeastBound:
    """The least irregular part that explains the data.

    Attributes
    ----------
    factor : float
        In multiples of the stated bound; infinite where none does.
    p : Vector
        Where, shape ``(n_p,)``.
    """

    factor: float
    p: Vector


def feasible_interval(
    problem: BoundedDisturbance,
    recorded: RecordedOutputs,
    starts: Matrix,
    watch: Watch | None = None,
) -> FeasibleInterval:
    """Compute the interval of each theta that the data and the bounds allow.

    Parameters
    ----------
    problem : BoundedDisturbance
    recorded : RecordedOutputs
    starts : Matrix
        Where the searches begin, shape ``(k, n_p)``, as of `starts_around` the estimate. The first
        one sets the scale of the steps.
    watch : callable, optional
        Is told after every linear program how many have been solved.
    """
    n_theta = problem.n_theta
    program = FeasibleProgram(problem, recorded, watch)
    anywhere = np.tile([-np.inf, np.inf], (n_theta, 1))
    half_width = _half_width(problem, recorded, starts[0])
    vertices = np.zeros((0, n_theta))
    unsolved = 0
    for start in starts:
        search = _Search(program, start, anywhere, half_width)
        is_feasible = search.restore()
        unsolved += search.is_unsolved
        if is_feasible and not _encloses(vertices, search.origin[:n_theta]):
            vertices = _with_ends(vertices, search, n_theta)
    if unsolved:
        return FeasibleInterval(anywhere[:, 0], anywhere[:, 1], vertices, unsolved)
    if not len(vertices):
        nothing = np.full(n_theta, NAN)
        return FeasibleInterval(nothing, nothing.copy(), vertices)
    missed = MISSED * half_width
    lower = vertices.min(axis=0) - missed
    return FeasibleInterval(lower, vertices.max(axis=0) + missed, vertices)


def _with_ends(vertices: Matrix, search: _Search, n_theta: int) -> Matrix:
    """Return vertices with the ends that a search reaches; where there is none none is searched."""
    for parameter, direction in product(range(n_theta), (-1, 1)):
        if direction * np.inf in vertices[:, parameter]:
            continue
        end = search.extreme(parameter, direction)
        vertices = np.concatenate([vertices, end[np.newaxis, :n_theta]])
    return vertices


def starts_around(problem: BoundedDisturbance, recorded: RecordedOutputs, p: Vector) -> Matrix:
    """Return p and points around it, one first-order half width away in some of the theta.

    Returns
    -------
    Matrix
        Shape ``(k, n_p)``: all combinations of -1, 0 and 1 half widths for up to three theta, one
        theta at a time for more; p itself first. The nuisance parameters are those of least squares
        at each.
    """
    n_theta = problem.n_theta
    half_width = _half_width(problem, recorded, p)
    signs = np.concatenate([np.eye(n_theta), -np.eye(n_theta)])
    if n_theta <= MOST_COMBINED:
        signs = np.array(list(product((0.0, -1.0, 1.0), repeat=n_theta)))[1:]
    starts = np.tile(p, (1 + len(signs), 1))
    starts[1:, :n_theta] += signs * half_width
    balanced = [_balanced(problem, recorded.y, start) for start in starts[1:]]
    return np.array([p, *balanced])


def least_bound(
    problem: BoundedDisturbance,
    recorded: RecordedOutputs,
    start: Vector,
    fixed: Mask | None = None,
) -> LeastBound:
    """Compute the least multiple of the bound of delta_0 that explains the data.

    Above 1 no theta near ``start`` is feasible: the bound is too small, or the model is wrong.

    Parameters
    ----------
    problem : BoundedDisturbance
        At least one bound is positive.
    recorded : RecordedOutputs
    start : Vector
        Shape ``(n_p,)``.
    fixed : Mask, optional
        Which theta stay as they are in ``start``, shape ``(n_theta,)``. With all of them the result
        is the global minimum, with some a point of the profile of those.
    """
    if not problem.bound.any():
        raise AssumptionError("bounds of delta_0: expected a positive one, got only zeros")
    program = FeasibleProgram(problem, recorded)
    limits = np.tile([-np.inf, np.inf], (problem.n_theta, 1))
    if fixed is not None:
        theta = start[: problem.n_theta]
        limits[fixed] = theta[fixed, None]
    search = _Search(program, start, limits, _half_width(problem, recorded, start))
    return search.least_bound()


def _balanced(problem: BoundedDisturbance, y: Matrix, p: Vector) -> Vector:
    """Replace the nuisance parameters by those of least squares at theta, where these are finite.

    A growing exponential with the amplitude of a decaying one has no digit left of y.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        jacobian = problem.model(p).jacobian
    n_theta = problem.n_theta
    columns = jacobian[:, :, n_theta:].reshape(y.size, -1)
    largest = np.abs(columns).max(axis=0, initial=0.0)
    if not np.isfinite(largest).all():
        return p
    unit = np.where(largest > 0.0, largest, 1.0)
    solution = np.linalg.lstsq(columns / unit, y.ravel())
    balanced = p.copy()
    balanced[n_theta:] = solution[0] / unit
    return balanced


@dataclass(frozen=True, eq=False)
class _Rest:
    """Where a sequence of linear programs ended, and whether theta had come to rest there."""

    p: Vector
    settled: bool


def _encloses(vertices: Matrix, theta: Vector) -> bool:
    """Return whether theta lies in the box around the vertices."""
    if not len(vertices):
        return False
    above = theta >= vertices.min(axis=0)
    below = theta <= vertices.max(axis=0)
    return bool(np.all(above & below))


def _half_width(problem: BoundedDisturbance, recorded: RecordedOutputs, p: Vector) -> Vector:
    """Compute the largest first-order error of theta, from delta_0 and noise, ``(n_theta,)``."""
    linear = first_order(problem, p)
    from_noise = np.abs(linear.functional).sum(axis=1) @ recorded.noise
    half_width: Vector = linear.half_width(problem.bound) + from_noise
    return half_width


class _Search:
    """Sequential linear programs from one start."""

    def __init__(
        self, program: FeasibleProgram, start: Vector, box: Matrix, half_width: Vector
    ) -> None:
        self.program = program
        self.origin = start
        self.box = box
        self.half_width = half_width
        self.is_unsolved = False

    def restore(self) -> bool:
        """Move the origin of the searches to a feasible point; return whether there is one.

        ``is_unsolved`` tells afterwards whether there may be one that could not be computed.
        """
        problem = self.program.problem
        for _ in range(MOST_PROGRAMS):
            here = None
            if not self.program.is_exhausted:
                here = self._least_violation(radius=0.0)
            if here is None:
                self.is_unsolved = True
                break
            if here.violation <= VIOLATED:
                self.origin = self.origin + here.step
                return True
            near = self._least_violation(radius=1.0)
            if near is None:
                self.is_unsolved = True
                break
            if self._size(near.step) <= SEARCH_CHANGE:
                break
            y = self.program.recorded.y
            self.origin = _balanced(problem, y, self.origin + near.step)
        return False

    def _least_violation(self, radius: float) -> ProgramSolution | None:
        prediction = self.program.predict(self.origin)
        if not np.isfinite(prediction.jacobian).all():
            return None
        limits = self._limits(self.origin, radius, STATED)
        return self.program.restore(prediction, limits)

    def extreme(self, parameter: int, direction: int) -> Vector:
        """Find the feasible p with the largest or smallest theta, infinite where there is no end.

        Also a search that does not come to rest gives infinity: it has shown no end.
        """
        objective = np.zeros(len(self.origin) + 1)
        objective[1 + parameter] = -direction / self.half_width[parameter]
        rest = self._settle(objective, STATED)
        if not rest.settled:
            rest.p[parameter] = direction * np.inf
        return rest.p

    def least_bound(self) -> LeastBound:
        """Find the p with the least multiple of the bound."""
        objective = np.zeros(len(self.origin) + 1)
        objective[0] = 1.0
        p = self._settle(objective, POSITIVE).p
        prediction = self.program.predict(p)
        exact = self.program.solve(prediction, objective, self._limits(p, 0.0, POSITIVE))
        if exact is None:
            return LeastBound(np.inf, p)
        return LeastBound(exact.multiple, p + exact.step)

    def _settle(self, objective: Vector, multiple: Vector) -> _Rest:
        """Solve linear programs until theta does not move, runs away or never rests."""
        p = self.origin.copy()
        n_theta = len(self.half_width)
        radius = 1.0  # trust region, in half widths
        last = np.zeros(n_theta)
        returns = 0
        for _ in range(MOST_PROGRAMS):
            prediction = self.program.predict(p)
            if self.program.is_exhausted or not np.isfinite(prediction.jacobian).all():
                break
            limits = self._limits(p, radius, multiple)
            solution = self.program.solve(prediction, objective, limits)
            if solution is None and returns < MOST_RETURNS:
                # the last step left the set by its second order
                solution = self.program.restore(prediction, limits)
                returns += 1
            elif solution is not None and self._rests(solution.step, objective):
                return _Rest(p + solution.step, settled=True)
            if solution is None or self._size(p - self.origin) > REACH:
                break
            p = p + solution.step
            step = solution.step[:n_theta]
            size = self._size(step)
            if step @ last < 0.0:  # around an end that is no vertex
                radius = size / 4.0
            elif size >= radius:
                radius *= 2.0
            last = step
        return _Rest(p, settled=False)

    def _rests(self, step: Vector, objective: Vector) -> bool:
        """Return whether a step gains nothing and is small enough for its linearization."""
        gain = abs(float(objective[1:] @ step))
        size = self._size(step)
        return size <= SEARCH_CHANGE or (
            objective[0] == 0.0 and gain <= SEARCH_CHANGE and size <= LINEAR
        )

    def _size(self, step: Vector) -> float:
        """Return the largest step of a theta, in half widths."""
        theta = step[: len(self.half_width)] / self.half_width
        return float(np.abs(theta).max())

    def _limits(self, p: Vector, radius: float, multiple: Vector) -> Matrix:
        n_theta = len(self.half_width)
        trust = radius * self.half_width
        to_box = self.box - p[:n_theta, None]
        lower = np.clip(to_box[:, 0], -trust, 0.0)
        upper = np.clip(to_box[:, 1], 0.0, trust)
        limits = np.tile([-np.inf, np.inf], (1 + len(p), 1))
        limits[0] = multiple
        limits[1 : 1 + n_theta, 0] = lower
        limits[1 : 1 + n_theta, 1] = upper
        return limits
