"""Search the point of the least cost: keys between bounds, what was tried, methods that ask.

A method asks for the costs of points, and is told them. What was tried before, as a dataset has it,
is told again without being run: so a search that was stopped asks for the same, and goes on.
"""

from __future__ import annotations

import ast
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, Final, TypeAlias, final

import numpy as np

from cosim.arrays import Vector
from cosim.errors import UsageError, option, optional_library, quoted
from cosim.studies.contracts import COMPLETE, MemberOutcome

METHODS: Final = ("cobyqa", "nelder-mead", "global", "optuna")
BATCHES: Final = ("global", "optuna")  # methods that try many points at a time
OBJECTIVE: Final = "objective"  # the name of its column
SAMPLES: Final = "samples"  # the metric that counts those of a residual
DIGITS: Final = 12  # of a value between bounds
TOLERANCE: Final = 1e-5  # of the range between the bounds
FIRST_RADIUS: Final = 0.1  # of the range between the bounds
MOST_FAILING_STARTS: Final = 10  # tried for each start
_ENDLESS: Final = 10**6  # evaluations, generations; the trials end the search

Point: TypeAlias = Mapping[str, Any]  # a value for each key
RunPoints: TypeAlias = Callable[[Mapping[int, Point]], Iterable[MemberOutcome]]


# --- keys ---


@dataclass(frozen=True, slots=True)
class BoundedKey:
    """A key between two bounds, which are its coordinates 0 and 1.

    Parameters
    ----------
    key : str
    lower, upper : float
    logarithmic : bool
        The coordinate is linear in the logarithm.
    """

    key: str
    lower: float
    upper: float
    logarithmic: bool = False

    def value(self, coordinate: float) -> float:
        """Return the value at a coordinate, of 12 digits; beyond a bound that bound."""
        if coordinate <= 0.0 or coordinate >= 1.0:
            return self.lower if coordinate <= 0.0 else self.upper
        if self.logarithmic:
            value = math.exp(math.log(self.lower) + coordinate * self.slope(1.0))
        else:  # without the difference of the bounds, which may overflow
            value = (1.0 - coordinate) * self.lower + coordinate * self.upper
        return min(max(float(f"{value:.{DIGITS}g}"), self.lower), self.upper)

    def coordinate(self, value: float) -> float:
        """Return the coordinate of a value."""
        if self.logarithmic:
            return (math.log(value) - math.log(self.lower)) / self.slope(1.0)
        half_lower = 0.5 * self.lower  # the difference of the bounds may overflow
        return (0.5 * value - half_lower) / (0.5 * self.upper - half_lower)

    def slope(self, value: float) -> float:
        """Return by how much the value grows with its coordinate."""
        if self.logarithmic:
            return value * (math.log(self.upper) - math.log(self.lower))
        return self.upper - self.lower

    def has(self, value: Any) -> bool:
        """Return whether it is a number between the bounds."""
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        return is_number and self.lower <= value <= self.upper


@dataclass(frozen=True, slots=True)
class ChoiceKey:
    """A key with one of some values, whose coordinates are 0, 1, 2, ..."""

    key: str
    choices: tuple[Any, ...]

    @property
    def names(self) -> list[str]:
        """What tells the values apart."""
        return list(map(value_name, self.choices))

    def value(self, coordinate: int) -> Any:
        """Return the value at a coordinate."""
        return self.choices[coordinate]

    def coordinate(self, value: Any) -> int:
        """Return the coordinate of a value."""
        return self.names.index(value_name(value))

    def has(self, value: Any) -> bool:
        """Return whether it is one of the values."""
        return value_name(value) in self.names


SearchKey: TypeAlias = BoundedKey | ChoiceKey


def value_name(value: Any) -> str:
    """Return a text that tells values apart as a dataset does: 1 is 1.0, and neither is True."""
    is_exact = type(value) is int and abs(value) <= 2**53
    return json.dumps(float(value) if is_exact else value, sort_keys=True, default=str)


# --- a search ---


@dataclass(frozen=True, slots=True)
class Search:
    """What is searched, and how, as a dataset has it.

    Parameters
    ----------
    metric : str
        The name of the objective.
    expression : str
        The objective.
    maximize : bool
    method : {"cobyqa", "nelder-mead", "global", "optuna"}
    members : int
        Points that are tried, at most.
    starts : int
        Of local searches.
    seed : int
    keys : tuple of BoundedKey or ChoiceKey
    """

    metric: str
    expression: str
    maximize: bool
    method: str
    members: int
    starts: int
    seed: int
    keys: tuple[BoundedKey | ChoiceKey, ...]

    @property
    def goal(self) -> str:
        """What is searched, in words."""
        return f"{'maximize' if self.maximize else 'minimize'} {self.expression}"

    @property
    def is_rms(self) -> bool:
        """Whether the objective is the rms of one residual, and nothing else."""
        try:
            node = ast.parse(self.expression.strip(), mode="eval").body
        except (SyntaxError, ValueError, RecursionError, MemoryError):
            return False
        return (
            isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "rms"
        )

    @property
    def bounded(self) -> tuple[BoundedKey, ...]:
        """The keys between bounds."""
        return tuple(key for key in self.keys if isinstance(key, BoundedKey))

    @property
    def choices(self) -> tuple[ChoiceKey, ...]:
        """The keys with lists of values."""
        return tuple(key for key in self.keys if isinstance(key, ChoiceKey))

    def point(self, coordinates: Iterable[float]) -> dict[str, Any]:
        """Return the point at coordinates, of keys between bounds."""
        pairs = zip(self.bounded, coordinates, strict=True)
        return {key.key: key.value(float(coordinate)) for key, coordinate in pairs}

    def coordinates(self, point: Point) -> Vector:
        """Return the coordinates of a point, of keys between bounds."""
        return np.array([key.coordinate(point[key.key]) for key in self.bounded])

    def distance(self, one: Point, other: Point) -> float:
        """Return the largest difference of coordinates."""
        return float(np.abs(self.coordinates(one) - self.coordinates(other)).max())

    def check(self, *, with_errors: bool = False, samples: int | None = None) -> None:
        """Raise UsageError if it is none, or standard errors of so many samples cannot be."""
        if self.method not in METHODS:
            found = f"expected one of {', '.join(METHODS)}, got {quoted(self.method)}"
            raise UsageError(f"{option('method')}: {found}")
        numbers = {"members": self.members, "starts": self.starts, "seed": self.seed}
        for name, number in {**numbers, "samples": samples}.items():
            least = 0 if name == "seed" else 1
            if number is not None and number < least:
                raise UsageError(f"{option(name)}: expected {least} or more, got {number}")
        if not self.keys:
            raise UsageError(f"{option('vary')}: expected at least one key to tune, got none")
        for key in self.keys:
            problem = _problem(key, self)
            if problem:
                raise UsageError(f"{option('vary', key.key)}: {problem}")
        if self.method == "optuna":
            _optuna()
        name = option("standard_errors")
        if with_errors and self.choices:
            raise UsageError(f"{name}: expected bounds for all keys, got a list of values")
        if with_errors and (self.maximize or not self.is_rms):
            such = "such as 'rms(plant.y - measured.y)'"
            raise UsageError(f"{name}: expected to minimize the rms of one residual, {such}")


def _problem(key: SearchKey, search: Search) -> str:
    """Return why a key cannot be searched; empty: it can."""
    if [each.key for each in search.keys].count(key.key) > 1:
        return "expected once, got twice"
    if isinstance(key, ChoiceKey):
        if not key.choices or len(set(key.names)) < len(key.choices):
            return f"expected distinct values, got {quoted(list(key.choices))}"
        only = f"expected bounds for the method {search.method!r}, got a list of values"
        return "" if search.method == "optuna" else f"{only}; 'optuna' also takes lists"
    found = f"got {key.lower!r} to {key.upper!r}"
    if not -math.inf < key.lower < key.upper < math.inf:
        return f"expected two finite bounds, the lower one first, {found}"
    is_wrong = key.logarithmic and key.lower <= 0.0
    return f"expected positive bounds with 'log:', {found}" if is_wrong else ""


# --- what was tried ---


class SearchEnded(Exception):
    """A search cannot ask for more points; its text says why."""


@dataclass(frozen=True, slots=True)
class SearchTrial:
    """A point that was tried.

    Parameters
    ----------
    number : int
        Of its member.
    point : mapping of key to value
    objective : float or None
        None: there is none.
    problem : str
        Why there is none.
    cost : float
        What is minimized: infinite without an objective.
    samples : int
        Of the residual that the objective is the rms of.
    warnings : sequence of str
    """

    number: int
    point: Point
    objective: float | None
    problem: str
    cost: float
    samples: int = 0
    warnings: Sequence[str] = ()


@dataclass(frozen=True, slots=True)
class SearchEnd:
    """Where a local search ended.

    Parameters
    ----------
    point : mapping of key to value
        The best that it found.
    cost : float
    converged : bool
    reason : str
        Why it ended.
    """

    point: Point
    cost: float
    converged: bool
    reason: str


@final
class Trials:
    """The points that were tried, each once.

    Parameters
    ----------
    run : callable
        Runs points, given by the numbers of their members, and yields outcomes as they come.
    search : Search
    recorded : iterable of (point, MemberOutcome)
        Which are there already.
    progress : callable, optional
        Called with how many members are done, of how many, and how many of these failed.

    Attributes
    ----------
    search : Search
    members : int
        It may be raised or lowered.
    ends : list of SearchEnd
        Of local searches.
    """

    def __init__(
        self,
        run: RunPoints,
        search: Search,
        recorded: Iterable[tuple[Point, MemberOutcome]] = (),
        progress: Callable[[int, int, int], None] | None = None,
    ) -> None:
        self._run = run
        self.search = search
        self._progress = progress
        self.members = search.members
        self.ends: list[SearchEnd] = []
        self._outcomes = {self._name(point): outcome for point, outcome in recorded}
        taken = {outcome.number for outcome in self._outcomes.values()}
        self._free = (number for number in range(search.members) if number not in taken)
        self._trials: dict[tuple[str, ...], SearchTrial] = {}
        self._failed: list[bool] = []
        self._repeated = 0

    @property
    def all(self) -> tuple[SearchTrial, ...]:
        """In the order in which they were asked for."""
        return tuple(self._trials.values())

    @property
    def best(self) -> SearchTrial | None:
        """The first one with the least cost; None: no member has an objective."""
        best = min(self.all, key=lambda trial: trial.cost, default=None)
        return best if best is not None and best.cost < math.inf else None

    def try_points(self, points: Sequence[Point]) -> list[SearchTrial]:
        """Return the trials of points; those that were not tried are.

        Raises
        ------
        SearchEnded
            If all members are used, or no point is new any more.
        """
        named = {self._name(point): point for point in points}
        new = [name for name in named if name not in self._trials]
        self._repeated = 0 if new else self._repeated + len(points)
        if self._repeated > 1000:  # it goes round in circles
            raise SearchEnded("the search asked for no new point any more")
        left = max(self.members - len(self._trials), 0)
        self._try({name: named[name] for name in new[:left]})
        if left < len(new):
            raise SearchEnded("all members were used")
        return [self._trials[self._name(point)] for point in points]

    def costs(self, points: Iterable[Iterable[float]]) -> list[float]:
        """Return the costs at coordinates, which are tried."""
        tried = self.try_points([self.search.point(each) for each in points])
        return [trial.cost for trial in tried]

    def _try(self, points: Mapping[tuple[str, ...], Point]) -> None:
        new = [name for name in points if name not in self._outcomes]
        names = dict(zip(islice(self._free, len(new)), new, strict=False))  # by member
        if len(names) < len(new):
            raise SearchEnded("all members of the dataset were used")
        for name in points:
            if name in self._outcomes:
                self._note(self._outcomes[name])
        members = list(names)
        alone = 0 if self._outcomes else 1  # the first one of all
        for part in filter(None, (members[:alone], members[alone:])):
            for outcome in self._run({number: points[names[number]] for number in part}):
                self._outcomes[names[outcome.number]] = outcome
                self._note(outcome)
        for name, point in points.items():
            self._trials[name] = self._trial(point, self._outcomes[name])

    def _name(self, point: Point) -> tuple[str, ...]:
        return tuple(value_name(point[key.key]) for key in self.search.keys)

    def _note(self, outcome: MemberOutcome) -> None:
        self._failed.append(outcome.status != COMPLETE)
        if self._progress is not None:
            self._progress(len(self._failed), self.search.members, sum(self._failed))

    def _trial(self, point: Point, outcome: MemberOutcome) -> SearchTrial:
        value = outcome.metrics.get(OBJECTIVE)
        objective, cost, problem = None, math.inf, ""
        if outcome.status != COMPLETE:
            problem = outcome.reason or "failed"
        elif isinstance(value, float) and math.isfinite(value):
            objective, cost = value, -value if self.search.maximize else value
        else:
            problem = f"the objective is {value}, expected a finite number"
        samples = int(outcome.metrics.get(SAMPLES) or 0)
        own = (samples, outcome.warnings)
        return SearchTrial(outcome.number, dict(point), objective, problem, cost, *own)


# --- methods ---


def search_points(trials: Trials, known: Point) -> str:
    """Ask for points until a method ends, and return why.

    Parameters
    ----------
    trials : Trials
    known : mapping of key to value
        Of the point that is tried first; left out: the middle between the bounds.

    Raises
    ------
    SearchEnded
        If the trials end it.
    """
    search = trials.search
    if search.method == "optuna":
        return _with_optuna(trials, known)
    start = [k.coordinate(known[k.key]) if k.key in known else 0.5 for k in search.bounded]
    first = np.clip(start, 0.0, 1.0)
    return _globally(trials, first) if search.method == "global" else _locally(trials, first)


def _locally(trials: Trials, first: Vector) -> str:
    """Search from the first point, and from those of a balanced sequence that do not fail."""
    from scipy.stats import qmc  # takes long to import

    search = trials.search
    if math.isfinite(trials.costs([first])[0]):
        _from_point(trials, first, FIRST_RADIUS)
    count = search.starts - 1
    sequence = qmc.Sobol(len(search.keys), rng=np.random.default_rng(search.seed))
    points = iter(sequence.random_base2((MOST_FAILING_STARTS * count).bit_length()))
    starts: list[Vector] = []
    for _ in range(MOST_FAILING_STARTS):
        tried = list(islice(points, count - len(starts)))
        costs = trials.costs(tried)
        starts += [p for p, cost in zip(tried, costs, strict=True) if math.isfinite(cost)]
    for start in starts:
        _from_point(trials, start, FIRST_RADIUS)
    return "the searches from all starts ended"


def _from_point(trials: Trials, start: Vector, radius: float) -> None:
    """Search locally: with COBYQA, or Nelder and Mead's simplex.

    The cost is of the order of one; where it fails, the worst so far. An rms that is minimized is
    squared: so it is smooth at zero, and a parabola of what is linear.
    """
    from scipy.optimize import minimize

    search = trials.search
    is_simplex = search.method == "nelder-mead"
    is_squared = search.is_rms and not search.maximize
    scale, worst = 0.0, math.inf if is_simplex else 0.0
    best, best_at = math.inf, start

    def cost_at(coordinates: Vector) -> float:
        nonlocal scale, worst, best, best_at
        inside = np.clip(coordinates, 0.0, 1.0)  # beyond a bound by rounding
        (cost,) = trials.costs([inside])
        if cost < best:
            best, best_at = cost, inside
        if math.isfinite(cost):
            scale = scale or abs(cost)
            shaped = cost / (scale or 1.0)
            shaped = shaped * shaped if is_squared else shaped
            if math.isfinite(shaped):
                worst = max(worst, shaped)
                return shaped
        return worst

    options: dict[str, Any] = {"maxfev": _ENDLESS, "maxiter": _ENDLESS}
    if is_simplex:
        name, size = "Nelder-Mead", "simplex"
        corners = start + np.diag(np.where(start < 0.5, radius, -radius))
        options |= {"initial_simplex": np.vstack([start, corners])}
        options |= {"xatol": TOLERANCE, "fatol": math.inf}
    else:
        name, size = "COBYQA", "trust region"
        options |= {"initial_tr_radius": max(radius, TOLERANCE), "final_tr_radius": TOLERANCE}
    bounds = [(0.0, 1.0)] * start.size
    try:
        with np.errstate(invalid="ignore", over="ignore"):
            found = minimize(cost_at, start, method=name, bounds=bounds, options=options)
        problem = "" if found.success else found.message
    except np.linalg.LinAlgError as error:
        problem = str(error)
    reason = f"{name} converged: {size} {TOLERANCE:g} of the bounds"
    if problem:
        reason = f"{name} stopped: {problem}"
    trials.ends.append(SearchEnd(search.point(best_at), best, not problem, reason))


def _globally(trials: Trials, first: Vector) -> str:
    """Search with differential evolution, then locally from its best point."""
    from scipy.optimize import differential_evolution

    search = trials.search
    close = 0.01  # of the range between the bounds
    trials.costs([first])

    def close_together(intermediate_result: Any) -> bool:
        return bool((np.ptp(intermediate_result.population, axis=0) <= close).all())

    with np.errstate(invalid="ignore"):  # differences of infinite costs
        found = differential_evolution(
            lambda population: np.array(trials.costs(population.T)),
            [(0.0, 1.0)] * len(search.keys),
            popsize=10,  # for every key
            maxiter=_ENDLESS,
            tol=0.0,
            atol=-1.0,  # equal costs far from each other are no end
            polish=False,
            updating="deferred",
            vectorized=True,
            rng=np.random.default_rng(search.seed),
            callback=close_together,
        )
    if np.isfinite(found.fun):
        _from_point(trials, np.clip(found.x, 0.0, 1.0), close)
    return "the population converged, and the local search from its best member ended"


def _optuna() -> Any:
    return optional_library("optuna", "the method 'optuna' needs", "optuna")


def _with_optuna(trials: Trials, known: Point) -> str:
    """Search with tree-structured Parzen estimators, some points at a time."""
    search = trials.search
    optuna = _optuna()
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    sampler = optuna.samplers.TPESampler(seed=search.seed, constant_liar=True)
    study = optuna.create_study(sampler=sampler)
    spaces = {
        key.key: optuna.distributions.FloatDistribution(0.0, 1.0)
        if isinstance(key, BoundedKey)
        else optuna.distributions.CategoricalDistribution(range(len(key.choices)))
        for key in search.keys
    }
    study.enqueue_trial({k.key: k.coordinate(known[k.key]) for k in search.keys if k.key in known})
    most = math.inf if search.bounded else math.prod(len(key.choices) for key in search.choices)
    while len(trials.all) < most:
        asked = [study.ask(spaces) for _ in range(4)]
        points = [{k.key: k.value(each.params[k.key]) for k in search.keys} for each in asked]
        for each, trial in zip(asked, trials.try_points(points), strict=True):
            study.tell(each, trial.cost)
    return "all combinations of the values were tried"
