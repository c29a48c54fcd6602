"""A tuning: one search, then what is said of its best values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal, TypeAlias

import numpy as np

from cosim.arrays import Vector
from cosim.errors import UsageError, option, quoted
from cosim.studies.tuning.bayesian import need_optuna, search_with_optuna
from cosim.studies.tuning.local import LocalSearch, SearchEnd
from cosim.studies.tuning.population import search_globally
from cosim.studies.tuning.result import TuningResult, converged_end
from cosim.studies.tuning.space import BoundedKey, SearchSpace, check_space
from cosim.studies.tuning.standard_errors import (
    NoStandardErrors,
    StandardErrors,
    members_of_errors,
    standard_errors,
)
from cosim.studies.tuning.trials import Evaluate, SearchEnded, Trials

TuningMethod: TypeAlias = Literal["cobyqa", "nelder-mead", "global", "optuna"]

METHODS: Final[tuple[TuningMethod, ...]] = ("cobyqa", "nelder-mead", "global", "optuna")


@dataclass(frozen=True, slots=True)
class TuningSearch:
    """What is searched, and how.

    Parameters
    ----------
    space : SearchSpace
    objective : str
        The name of the metric.
    maximize : bool
    method : {"cobyqa", "nelder-mead", "global", "optuna"}
    members : int
        How many there may be.
    starts : int
        Of a local method.
    seed : int
    first : mapping of key to value
        The values that the scenario has, where they are known; tried first.
    is_rms : bool
        The objective is the rms of one residual.
    with_errors : bool
        Find the standard errors of the best values, too.
    samples : int or None
        Of that residual; None: the metric ``samples`` of the best member has their number.
    """

    space: SearchSpace
    objective: str
    maximize: bool = False
    method: TuningMethod = "cobyqa"
    members: int = 200
    starts: int = 4
    seed: int = 1
    first: Mapping[str, Any] | None = None
    is_rms: bool = False
    with_errors: bool = False
    samples: int | None = None

    def inside(self) -> dict[str, Any]:
        """Return the first values that are between their bounds, or in their list."""
        found: dict[str, Any] = {}
        first = self.first or {}
        for key in self.space.keys:
            if key.key not in first:
                continue
            value = first[key.key]
            if not isinstance(key, BoundedKey):
                found[key.key] = value
            elif _is_number(value) and key.lower <= value <= key.upper:
                found[key.key] = float(value)
        return found


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def check_search(search: TuningSearch) -> None:
    """Check a search before anything runs.

    Raises
    ------
    UsageError
        If a key, the method, a number or the wish for standard errors is wrong.
    """
    check_space(search.space)
    if search.method not in METHODS:
        raise UsageError(
            f"{option('method')}: expected one of {', '.join(METHODS)}, got {quoted(search.method)}"
        )
    if search.members < 1:
        raise UsageError(f"{option('members')}: expected 1 or more, got {search.members}")
    if search.starts < 1:
        raise UsageError(f"{option('starts')}: expected 1 or more, got {search.starts}")
    if search.seed < 0:
        raise UsageError(f"{option('seed')}: expected 0 or more, got {search.seed}")
    if search.method == "optuna":
        need_optuna()
    elif search.space.choices:
        key = search.space.choices[0].key
        raise UsageError(
            f"{option('vary', key)}: expected bounds for the method {search.method!r}, got a list "
            "of values; 'optuna' also takes lists"
        )
    if search.with_errors:
        _check_errors(search)


def _check_errors(search: TuningSearch) -> None:
    name = option("standard_errors")
    if search.samples is not None and search.samples < 1:
        raise UsageError(f"{option('samples')}: expected 1 or more, got {search.samples}")
    if search.space.choices:
        raise UsageError(f"{name}: expected bounds for all keys, got a list of values")
    if search.maximize or not search.is_rms:
        raise UsageError(
            f"{name}: expected an objective that is the rms of one residual and is minimized, "
            "such as 'rms(plant.y - measured.y)'"
        )


def search_best(evaluate: Evaluate, search: TuningSearch) -> TuningResult:
    """Search the best values.

    Parameters
    ----------
    evaluate : callable
        Runs points as members, all at a time, and returns their outcomes in their order; what it
        ran in an earlier call of this function it may take from there.
    search : TuningSearch

    Raises
    ------
    UsageError
        As from :func:`check_search`.
    """
    check_search(search)
    trials = Trials(
        evaluate,
        objective=search.objective,
        members=search.members - _reserve(search),
        maximize=search.maximize,
    )
    ends: list[SearchEnd] = []
    finished = False
    try:
        stop_reason = _run(search, trials, ends)
        finished = True
    except SearchEnded as ended:
        stop_reason = ended.reason
    end = converged_end(search.space, trials.best, ends)
    trials.members = search.members
    errors, problem = _errors(search, trials)
    return TuningResult(
        space=search.space,
        objective=search.objective,
        method=search.method,
        maximize=search.maximize,
        trials=trials.all,
        best=trials.best,
        finished=finished,
        stop_reason=stop_reason,
        ends=tuple(ends),
        best_end=end,
        starts=search.starts if search.method in ("cobyqa", "nelder-mead") else 0,
        errors=errors,
        errors_problem=problem,
    )


def _reserve(search: TuningSearch) -> int:
    """Return how many members are kept for standard errors: they are worth more than a last start.

    At most half.
    """
    if not search.with_errors:
        return 0
    return min(members_of_errors(len(search.space.keys)), search.members // 2)


def _run(search: TuningSearch, trials: Trials, ends: list[SearchEnd]) -> str:
    """Run a search to its own end, and return why it ended."""
    space = search.space
    if search.method == "optuna":
        return search_with_optuna(space, trials, search.inside(), search.seed)
    squared = search.is_rms and not search.maximize
    method = search.method if search.method == "nelder-mead" else "cobyqa"
    local = LocalSearch(space, trials, method, squared, ends)
    if search.method == "global":
        trials.costs([space.point(_first(search))])
        search_globally(space, trials, local, search.seed)
        return "the population converged, and the local search from its best member ended"
    local.from_starts(_first(search), search.starts, search.seed)
    return "the searches from all starts ended"


def _first(search: TuningSearch) -> Vector:
    """Return the coordinates of the first start; the middle where no value is known."""
    start = search.space.center()
    inside = search.inside()
    for number, key in enumerate(search.space.bounded):
        if key.key in inside:
            start[number] = key.coordinate(inside[key.key])
    return np.clip(start, 0.0, 1.0)


def _errors(search: TuningSearch, trials: Trials) -> tuple[StandardErrors | None, str]:
    """Return the standard errors, and why there are none."""
    if not search.with_errors:
        return None, ""
    best = trials.best
    if best is None:
        return None, "no member has an objective"
    samples = best.samples if search.samples is None else search.samples
    try:
        found = standard_errors(search.space, trials, best.point, samples)
    except NoStandardErrors as problem:
        return None, str(problem)
    except SearchEnded as ended:
        return None, ended.reason
    return found, ""
