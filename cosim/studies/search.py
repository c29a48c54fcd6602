"""Search the point of the least cost: keys between bounds, what was tried, methods that ask.

A method asks for the costs of points, and is told them. What was tried before, as a dataset has it,
is told again without being run: so a search that was stopped asks for the same, and goes on.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import Any, Final, TypeAlias, final

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.errors import UsageError, option, quoted
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
            low, high = self._logarithms
            value = math.exp(low + coordinate * (high - low))
        else:  # without the difference of the bounds, which may overflow
            value = (1.0 - coordinate) * self.lower + coordinate * self.upper
        return min(max(float(f"{value:.{DIGITS}g}"), self.lower), self.upper)

    def coordinate(self, value: float) -> float:
        """Return the coordinate of a value."""
        if self.logarithmic:
            low, high = self._logarithms
            return (math.log(value) - low) / (high - low)
        half_lower = 0.5 * self.lower  # the difference of the bounds may overflow
        return (0.5 * value - half_lower) / (0.5 * self.upper - half_lower)

    def slope(self, value: float) -> float:
        """Return by how much the value grows with its coordinate."""
        low, high = self._logarithms
        return value * (high - low) if self.logarithmic else self.upper - self.lower

    def has(self, value: Any) -> bool:
        """Return whether it is a number between the bounds."""
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        return is_number and self.lower <= value <= self.upper

    def check(self) -> None:
        """Raise UsageError unless a value can be between the bounds."""
        found = f"got {self.lower!r} to {self.upper!r}"
        name = option("vary", self.key)
        if not -math.inf < self.lower < self.upper < math.inf:
            raise UsageError(f"{name}: expected two finite bounds, the lower one first, {found}")
        if self.logarithmic and self.lower <= 0.0:
            raise UsageError(f"{name}: expected positive bounds with 'log:', {found}")

    @property
    def _logarithms(self) -> tuple[float, float]:
        return (math.log(self.lower), math.log(self.upper)) if self.logarithmic else (0.0, 0.0)


@dataclass(frozen=True, slots=True)
class ChoiceKey:
    """A key with one of some values, whose coordinates are 0, 1, 2, ..."""

    key: str
    choices: tuple[Any, ...]

    def value(self, coordinate: int) -> Any:
        """Return the value at a coordinate."""
        return self.choices[coordinate]

    def coordinate(self, value: Any) -> int:
        """Return the coordinate of a value."""
        return [value_name(each) for each in self.choices].index(value_name(value))

    def has(self, value: Any) -> bool:
        """Return whether it is one of the values."""
        return value_name(value) in map(value_name, self.choices)

    def check(self) -> None:
        """Raise UsageError unless there are values, each once."""
        if len(set(map(value_name, self.choices))) < max(len(self.choices), 1):
            found = f"got {quoted(list(self.choices))}"
            raise UsageError(f"{option('vary', self.key)}: expected distinct values, {found}")


SearchKey: TypeAlias = BoundedKey | ChoiceKey


@dataclass(frozen=True, slots=True)
class SearchSpace:
    """The keys that are searched."""

    keys: tuple[SearchKey, ...]

    @property
    def bounded(self) -> tuple[BoundedKey, ...]:
        """Those between bounds."""
        return tuple(key for key in self.keys if isinstance(key, BoundedKey))

    @property
    def choices(self) -> tuple[ChoiceKey, ...]:
        """Those with lists of values."""
        return tuple(key for key in self.keys if isinstance(key, ChoiceKey))

    def point(self, coordinates: Iterable[float]) -> dict[str, Any]:
        """Return the point at coordinates, of keys between bounds."""
        pairs = zip(self.bounded, coordinates, strict=True)
        return {key.key: key.value(float(coordinate)) for key, coordinate in pairs}

    def coordinates(self, point: Point) -> Vector:
        """Return the coordinates of a point, of keys between bounds."""
        return np.array([key.coordinate(point[key.key]) for key in self.bounded])


def value_name(value: Any) -> str:
    """Return a text that tells values apart as a dataset does: 1 is 1.0, and neither is True."""
    return json.dumps(_plain(value), sort_keys=True)


def _plain(value: Any) -> Any:
    match value:
        case bool() | float():
            return value
        case int():
            return float(value) if abs(value) <= 2**53 else value
        case Mapping():
            return {str(key): _plain(item) for key, item in value.items()}
        case list() | tuple():
            return [_plain(item) for item in value]
    return str(value)


# --- a search ---


@dataclass(frozen=True, slots=True)
class Search:
    """What is searched, and how.

    Parameters
    ----------
    space : SearchSpace
    expression : str
        The objective.
    maximize : bool
    method : {"cobyqa", "nelder-mead", "global", "optuna"}
    members : int
        Points that are tried, at most.
    starts : int
        Of local searches.
    seed : int
    is_rms : bool
        Whether the objective is the rms of one residual.
    with_errors : bool
        Whether standard errors are computed.
    samples : int or None
        Independent ones of the residual; None: as it says itself.
    first : mapping of key to value
        Of the point that is tried first; left out: the middle between the bounds.
    """

    space: SearchSpace
    expression: str = ""
    maximize: bool = False
    method: str = "cobyqa"
    members: int = 200
    starts: int = 4
    seed: int = 1
    is_rms: bool = False
    with_errors: bool = False
    samples: int | None = None
    first: Point = field(default_factory=dict)

    @property
    def inside(self) -> dict[str, Any]:
        """The first values that can be tried."""
        found = {}
        for key in self.space.keys:
            if key.key in self.first and key.has(self.first[key.key]):
                value = self.first[key.key]
                found[key.key] = float(value) if isinstance(key, BoundedKey) else value
        return found

    def check(self) -> None:
        """Raise UsageError if it is none."""
        keys = [key.key for key in self.space.keys]
        if not keys:
            raise UsageError(f"{option('vary')}: expected at least one key to tune, got none")
        for key in self.space.keys:
            if keys.count(key.key) > 1:
                raise UsageError(f"{option('vary', key.key)}: expected once, got twice")
            key.check()
        if self.method not in METHODS:
            found = f"expected one of {', '.join(METHODS)}, got {quoted(self.method)}"
            raise UsageError(f"{option('method')}: {found}")
        for name, least in (("members", 1), ("starts", 1), ("seed", 0), ("samples", 1)):
            number = getattr(self, name)
            if number is not None and number < least:
                raise UsageError(f"{option(name)}: expected {least} or more, got {number}")
        self._check_kind()

    def _check_kind(self) -> None:
        """Check that the method, and standard errors, can do with the keys and the objective."""
        if self.method == "optuna":
            _optuna()
        elif self.space.choices:
            bounds = f"expected bounds for the method {self.method!r}, got a list of values"
            key = self.space.choices[0].key
            raise UsageError(f"{option('vary', key)}: {bounds}; 'optuna' also takes lists")
        name = option("standard_errors")
        if self.with_errors and self.space.choices:
            raise UsageError(f"{name}: expected bounds for all keys, got a list of values")
        if self.with_errors and (self.maximize or not self.is_rms):
            such = "such as 'rms(plant.y - measured.y)'"
            raise UsageError(f"{name}: expected to minimize the rms of one residual, {such}")


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


RunPoints: TypeAlias = Callable[[Mapping[int, Point]], Iterable[MemberOutcome]]


@final
class Trials:
    """The points that were tried, each once.

    Parameters
    ----------
    run : callable
        Runs points, given by the numbers of their members, and yields outcomes as they come.
    search : Search
    recorded : sequence of (point, MemberOutcome)
        Which are there already.
    progress : callable, optional
        Called with how many members are done, of how many, and how many of these failed.

    Attributes
    ----------
    members : int
        It may be raised or lowered.
    best : SearchTrial or None
    """

    def __init__(
        self,
        run: RunPoints,
        search: Search,
        recorded: Iterable[tuple[Point, MemberOutcome]] = (),
        progress: Callable[[int, int, int], None] | None = None,
    ) -> None:
        self._run = run
        self.members = self._places = search.members
        self._sign = -1.0 if search.maximize else 1.0
        self._outcomes = {value_name(point): outcome for point, outcome in recorded}
        taken = {outcome.number for outcome in self._outcomes.values()}
        self._free = (number for number in range(search.members) if number not in taken)
        self._progress = progress
        self._failed: dict[int, bool] = {}  # by member
        self._trials: dict[str, SearchTrial] = {}
        self._repeated = 0
        self.best: SearchTrial | None = None

    @property
    def all(self) -> tuple[SearchTrial, ...]:
        """In the order in which they were asked for."""
        return tuple(self._trials.values())

    def trial(self, point: Point) -> SearchTrial:
        """Return that of a point that was tried."""
        return self._trials[value_name(point)]

    def costs(self, points: Sequence[Point]) -> list[float]:
        """Return the costs of points; those that were not tried are.

        Raises
        ------
        SearchEnded
            If all members are used, or no point is new any more.
        """
        named = {value_name(point): point for point in points}
        new = {name: point for name, point in named.items() if name not in self._trials}
        self._repeated = 0 if new else self._repeated + len(points)
        if self._repeated > 1000:  # it goes round in circles
            raise SearchEnded("the search asked for no new point any more")
        left = max(self.members - len(self._trials), 0)
        if new and left:
            self._try(dict(islice(new.items(), left)))
        if left < len(new):
            raise SearchEnded("all members were used")
        return [self.trial(point).cost for point in points]

    def _try(self, points: Mapping[str, Point]) -> None:
        names = {}
        for name in points:
            if name in self._outcomes:
                self._note(self._outcomes[name])
            else:
                names[self._next_number()] = name
        members = list(names)
        parts = [members] if self._outcomes else [members[:1], members[1:]]  # the first one alone
        for part in filter(None, parts):
            for outcome in self._run({number: points[names[number]] for number in part}):
                self._outcomes[names[outcome.number]] = outcome
                self._note(outcome)
        for name, point in points.items():
            trial = self._trials[name] = self._trial(point, self._outcomes[name])
            if trial.cost < (math.inf if self.best is None else self.best.cost):
                self.best = trial

    def _next_number(self) -> int:
        for number in self._free:
            return number
        raise SearchEnded("all members of the dataset were used")

    def _note(self, outcome: MemberOutcome) -> None:
        self._failed[outcome.number] = outcome.status != COMPLETE
        if self._progress is not None:
            self._progress(len(self._failed), self._places, sum(self._failed.values()))

    def _trial(self, point: Point, outcome: MemberOutcome) -> SearchTrial:
        value = outcome.metrics.get(OBJECTIVE)
        found, cost = None, math.inf
        problem = "" if outcome.status == COMPLETE else outcome.reason or "failed"
        if not problem and isinstance(value, float) and math.isfinite(value):
            found, cost = value, self._sign * value
        elif not problem:
            problem = f"the objective is {value}, expected a finite number"
        samples = int(outcome.metrics.get(SAMPLES) or 0)
        own = (samples, outcome.warnings)
        return SearchTrial(outcome.number, dict(point), found, problem, cost, *own)


# --- methods ---


@dataclass(frozen=True, slots=True)
class SearchEnd:
    """Where a local search ended.

    Parameters
    ----------
    start, point : mapping of key to value
        Where it began, and the best that it found.
    cost : float
    converged : bool
    reason : str
        Why it ended.
    """

    start: Point
    point: Point
    cost: float
    converged: bool
    reason: str


def search_points(search: Search, trials: Trials, ends: list[SearchEnd]) -> str:
    """Ask for points until a method ends, and return why; ``ends`` takes those of local searches.

    Raises
    ------
    SearchEnded
        If the trials end it.
    """
    if search.method == "optuna":
        return _with_optuna(search, trials)
    known = search.inside
    keys = search.space.bounded
    start = [key.coordinate(known[key.key]) if key.key in known else 0.5 for key in keys]
    first = np.clip(start, 0.0, 1.0)
    if search.method == "global":
        return _globally(search, trials, first, ends)
    return _locally(search, trials, first, ends)


def _locally(search: Search, trials: Trials, first: Vector, ends: list[SearchEnd]) -> str:
    """Search from the first point, and from those of a balanced sequence that do not fail."""
    space = search.space
    if math.isfinite(trials.costs([space.point(first)])[0]):
        ends.append(_from_point(search, trials, first, FIRST_RADIUS))
    count = search.starts - 1
    sequence = _sequence(search, 1 << (count - 1).bit_length())  # balanced in powers of two
    starts: list[Vector] = []
    for _ in range(MOST_FAILING_STARTS):
        points = list(islice(sequence, count - len(starts)))
        costs = trials.costs([space.point(point) for point in points])
        starts += [p for p, cost in zip(points, costs, strict=True) if math.isfinite(cost)]
    for start in starts:
        ends.append(_from_point(search, trials, start, FIRST_RADIUS))
    return "the searches from all starts ended"


def _sequence(search: Search, number: int) -> Iterator[Vector]:
    from scipy.stats import qmc  # takes long to import

    rng = np.random.default_rng(search.seed)
    sequence = qmc.Sobol(len(search.space.keys), rng=rng)
    while True:
        yield from sequence.random(number)


def _from_point(search: Search, trials: Trials, start: Vector, radius: float) -> SearchEnd:
    """Search locally: with COBYQA, or Nelder and Mead's simplex."""
    from scipy.optimize import minimize

    is_simplex = search.method == "nelder-mead"
    cost = _ShapedCost(search, trials, worst=math.inf if is_simplex else 0.0)
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
    problem = ""
    try:
        with np.errstate(invalid="ignore", over="ignore"):
            found = minimize(cost, start, method=name, bounds=bounds, options=options)
        problem = "" if found.success else found.message
    except np.linalg.LinAlgError as error:
        problem = str(error)
    reason = f"{name} converged: {size} {TOLERANCE:g} of the bounds"
    return SearchEnd(
        search.space.point(start),
        search.space.point(cost.best_at),
        cost.best,
        not problem,
        f"{name} stopped: {problem}" if problem else reason,
    )


@final
class _ShapedCost:
    """The cost of coordinates, of the order of one; where it fails, the worst so far.

    An rms that is minimized is squared: so it is smooth at zero, and a parabola of what is linear.
    """

    def __init__(self, search: Search, trials: Trials, *, worst: float) -> None:
        self._space = search.space
        self._trials = trials
        self._squared = search.is_rms and not search.maximize
        self._scale = 0.0
        self._worst = worst
        self.best = math.inf
        self.best_at: Vector = np.empty(0)

    def __call__(self, coordinates: Vector) -> float:
        inside = np.clip(coordinates, 0.0, 1.0)  # beyond a bound by rounding
        (cost,) = self._trials.costs([self._space.point(inside)])
        if cost < self.best or not self.best_at.size:
            self.best, self.best_at = cost, inside
        if not math.isfinite(cost):
            return self._worst
        self._scale = self._scale or abs(cost)
        shaped = cost / (self._scale or 1.0)
        shaped = shaped * shaped if self._squared else shaped
        if math.isfinite(shaped):
            self._worst = max(self._worst, shaped)
            return shaped
        return self._worst


def _globally(search: Search, trials: Trials, first: Vector, ends: list[SearchEnd]) -> str:
    """Search with differential evolution, then locally from its best point."""
    from scipy.optimize import differential_evolution

    space = search.space
    close = 0.01  # of the range between the bounds
    trials.costs([space.point(first)])

    def costs(population: Matrix) -> Vector:
        return np.array(trials.costs([space.point(column) for column in population.T]))

    def close_together(intermediate_result: Any) -> bool:
        return bool((np.ptp(intermediate_result.population, axis=0) <= close).all())

    with np.errstate(invalid="ignore"):  # differences of infinite costs
        found = differential_evolution(
            costs,
            [(0.0, 1.0)] * len(space.keys),
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
        ends.append(_from_point(search, trials, np.clip(found.x, 0.0, 1.0), close))
    return "the population converged, and the local search from its best member ended"


def _optuna() -> Any:
    try:
        import optuna  # it is optional
    except ImportError as error:
        missing = "the method 'optuna' needs optuna, which is not installed"
        raise UsageError(f"{missing}: pip install optuna") from error
    return optuna


def _with_optuna(search: Search, trials: Trials) -> str:
    """Search with tree-structured Parzen estimators, some points at a time."""
    optuna = _optuna()
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    sampler = optuna.samplers.TPESampler(seed=search.seed, constant_liar=True)
    study = optuna.create_study(sampler=sampler)
    keys = {key.key: key for key in search.space.keys}
    spaces = {
        name: optuna.distributions.FloatDistribution(0.0, 1.0)
        if isinstance(key, BoundedKey)
        else optuna.distributions.CategoricalDistribution(range(len(key.choices)))
        for name, key in keys.items()
    }
    study.enqueue_trial({name: keys[name].coordinate(v) for name, v in search.inside.items()})
    lists = [len(key.choices) for key in search.space.choices]
    most = math.prod(lists) if len(lists) == len(keys) else math.inf
    while len(trials.all) < most:
        asked = [study.ask(spaces) for _ in range(4)]
        found = [each.params for each in asked]
        points = [{name: key.value(each[name]) for name, key in keys.items()} for each in found]
        for each, cost in zip(asked, trials.costs(points), strict=True):
            study.tell(each, cost)
    return "all combinations of the values were tried"
