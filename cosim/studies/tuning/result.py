"""The result of a tuning, and the sentences that say what it is worth."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Final

import numpy as np

from cosim.arrays import Matrix
from cosim.errors import listing, option
from cosim.studies.statistics import grouped, warning_lines
from cosim.studies.tuning.local import SearchEnd
from cosim.studies.tuning.space import SearchSpace
from cosim.studies.tuning.standard_errors import NoStandardErrors, StandardErrors, of_samples
from cosim.studies.tuning.trials import SearchTrial
from cosim.studies.tuning.whiteness import ResidualCheck

AT_BOUND: Final = 1e-4  # of the range between the bounds
CONVERGED: Final = 1e-3  # of the range between the bounds
SAME_PLACE: Final = 0.01  # of the range between the bounds
SAME_COST: Final = 1e-6  # relative
FLAT: Final = 1e-9  # relative; rounding alone differs by less


@dataclass(frozen=True, slots=True, repr=False)
class TuningResult:
    """What a tuning found.

    Parameters
    ----------
    space : SearchSpace
    objective : str
        The name of the metric.
    method : str
    maximize : bool
    trials : tuple of SearchTrial
        All members, in the order in which they were asked for.
    best : SearchTrial or None
        None: no member has an objective.
    finished : bool
        The search ended by itself, not because the members were used up.
    stop_reason : str
    ends : tuple of SearchEnd
        Of local searches that ended by themselves.
    best_end : SearchEnd or None
        Of the search that converged at the best values; None: none did.
    starts : int
        Of local searches that were wanted; 0: the method has no starts.
    errors : StandardErrors or None
    errors_problem : str
        Why there are no standard errors; empty: they were not wanted, or are there.
    residual : ResidualCheck or None
        What noise the residual is at the best values; None: that is not known.
    expression : str
        The metric.
    command : str
        The line for a shell that runs the best member alone, bit for bit; empty: it is not known.
    """

    space: SearchSpace
    objective: str
    method: str
    maximize: bool
    trials: tuple[SearchTrial, ...]
    best: SearchTrial | None
    finished: bool
    stop_reason: str
    ends: tuple[SearchEnd, ...]
    best_end: SearchEnd | None
    starts: int
    errors: StandardErrors | None
    errors_problem: str
    residual: ResidualCheck | None = None
    expression: str = ""
    command: str = ""

    def __repr__(self) -> str:
        best = self.best
        found = "none" if best is None else f"{best.objective:.6g} at {values_text(best.point)}"
        return f"<TuningResult {self.expression or self.objective}: {found}>"

    @property
    def estimate(self) -> dict[str, Any]:
        """The best values by key; empty where no member has an objective."""
        return {} if self.best is None else dict(self.best.point)

    @property
    def standard_errors(self) -> dict[str, float] | None:
        """The standard errors of the best values by key; None: there are none."""
        return None if self.errors is None else dict(self.errors.errors)

    @property
    def history(self) -> list[dict[str, Any]]:
        """All members in the order in which they were asked for: number, values, objective."""
        return [_trial_dict(trial) for trial in self.trials]

    @property
    def statements(self) -> list[str]:
        """What is to be said of the result, a sentence each."""
        return statements(self)

    @property
    def warnings(self) -> list[str]:
        """How many members warn of what, a line each."""
        pairs = [(trial.number, line) for trial in self.trials for line in trial.warnings]
        return warning_lines(grouped(pairs), len(self.trials))

    @property
    def failed(self) -> tuple[SearchTrial, ...]:
        """The members without an objective."""
        return tuple(trial for trial in self.trials if trial.objective is None)

    @property
    def at_bounds(self) -> dict[str, str]:
        """The keys whose best value is at a bound: ``lower`` or ``upper``."""
        found: dict[str, str] = {}
        if self.best is None:
            return found
        for key in self.space.bounded:
            coordinate = key.coordinate(self.best.point[key.key])
            if coordinate <= AT_BOUND:
                found[key.key] = "lower"
            elif coordinate >= 1.0 - AT_BOUND:
                found[key.key] = "upper"
        return found

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        best = self.best
        return {
            "objective": self.objective,
            "maximize": self.maximize,
            "method": self.method,
            "best": None if best is None else _trial_dict(best),
            "members": len(self.trials),
            "failed": [
                {"member": trial.number, "values": dict(trial.point), "problem": trial.problem}
                for trial in self.failed
            ],
            "finished": self.finished,
            "converged": self.best_end is not None,
            "stop_reason": self.stop_reason,
            "at_bounds": self.at_bounds,
            "statements": self.statements,
            "warnings": self.warnings,
            "standard_errors": None if self.errors is None else self.errors.to_dict(),
            "residual": None if self.residual is None else asdict(self.residual),
            "command": self.command,
        }

    def ended_here(self, end: SearchEnd) -> bool:
        """Return whether a search ended at the best values."""
        return self.best is not None and _distance(self.space, self.best, end) <= SAME_PLACE


def converged_end(
    space: SearchSpace, best: SearchTrial | None, ends: Sequence[SearchEnd]
) -> SearchEnd | None:
    """Return the end of a search that converged at the best values; None: there is none."""
    for end in ends:
        if best is not None and end.converged and _distance(space, best, end) <= CONVERGED:
            return end
    return None


def _distance(space: SearchSpace, best: SearchTrial, end: SearchEnd) -> float:
    """Return the largest difference between the coordinates of two places."""
    return float(np.abs(space.coordinates(end.point) - space.coordinates(best.point)).max())


def _trial_dict(trial: SearchTrial) -> dict[str, Any]:
    return {"member": trial.number, "values": dict(trial.point), "objective": trial.objective}


def values_text(point: Mapping[str, Any]) -> str:
    """Return values in one line: ``plant.R = 1.5, plant.C = 0.2``."""
    return ", ".join(
        f"{key} = {value:.6g}" if isinstance(value, float) else f"{key} = {value}"
        for key, value in point.items()
    )


def statements(result: TuningResult) -> list[str]:
    """Return what is to be said of a result, a sentence each."""
    said = [_ending(result)]
    if result.failed:
        said.append(_failures(result))
    said += result.warnings
    if result.best is None:
        return said
    if _is_flat(result):
        said.append(
            "all members have the same objective: the varied keys have no effect on it here"
        )
        return said
    said += [
        f"{key} is at its {side} bound: values beyond it may be better"
        for key, side in result.at_bounds.items()
    ]
    said += _elsewhere(result)
    said += _of_errors(result)
    return said


def _ending(result: TuningResult) -> str:
    """Return why the search ended, and whether it converged at the best values."""
    end = result.best_end
    if end is not None:
        text = end.reason
        return text if result.finished else f"{text}; then {result.stop_reason}"
    if result.best is not None and not result.finished and result.method != "optuna":
        return f"{result.stop_reason} before a search converged at these values"
    return result.stop_reason


def _failures(result: TuningResult) -> str:
    failed = result.failed
    count = len(failed)
    problems = dict.fromkeys(trial.problem for trial in failed)
    numbers = listing([str(trial.number) for trial in failed])
    members = "member has" if count == 1 else "members have"
    return f"{count} {members} no objective ({numbers}): {listing(list(problems), 3)}"


def _is_flat(result: TuningResult) -> bool:
    costs = [trial.cost for trial in result.trials if trial.objective is not None]
    return len(costs) > 1 and max(costs) - min(costs) <= FLAT * max(map(abs, costs))


def _elsewhere(result: TuningResult) -> list[str]:
    """Return what other starts say of the best values."""
    if not result.starts:
        return ["whether there are better values elsewhere is not known"]
    assert result.best is not None
    here = [end for end in result.ends if result.ended_here(end)]
    others = [end for end in result.ends if not result.ended_here(end)]
    ended = len(result.ends)
    if not others:
        return [f"{_here_text(len(here), result.starts)}; better values elsewhere are not excluded"]
    other = min(others, key=lambda end: end.cost)
    place = values_text(other.point)
    if math.isclose(other.cost, result.best.cost, rel_tol=SAME_COST):
        return [f"the values are not unique: another start ended at {place} with this objective"]
    objective = -other.cost if result.maximize else other.cost
    return [
        f"{len(others)} of {ended} starts ended elsewhere, the best of them at {place} with "
        f"{objective:.6g}: more starts, or the method 'global', may find better values"
    ]


def _here_text(here: int, starts: int) -> str:
    """Return how many of the starts ended at the best values, none of them elsewhere."""
    if not here:
        return "no local search has finished"
    if starts == 1:
        return "searched from one start"
    if here < starts:
        return f"{here} of {starts} starts finished and ended here"
    return f"all {here} starts ended here"


def _of_errors(result: TuningResult) -> list[str]:
    if result.errors_problem:
        return [f"no standard errors: {result.errors_problem}"]
    if result.errors is None:
        return []
    said = [_whiteness(result.residual, result.errors.samples)]
    said += [
        f"the interval of {key} extends beyond its bounds, where nothing was tried"
        for key in _beyond_bounds(result.space, result.errors)
    ]
    said += [
        f"along {key} the objective rises unevenly within a standard error: its interval is rough"
        for key in result.errors.skewed
    ]
    return said


def _beyond_bounds(space: SearchSpace, errors: StandardErrors) -> list[str]:
    """Return the keys whose interval has values that the search did not have."""
    found = []
    for key in space.bounded:
        low, high = errors.intervals[key.key]
        if low < key.lower or high > key.upper:
            found.append(key.key)
    return found


def _whiteness(residual: ResidualCheck | None, samples: int) -> str:
    """Return what the standard errors assume of the residual, and what it looks like."""
    given = "the standard errors assume that"
    white = f"the {samples} samples of the residual are white with a constant standard deviation"
    if residual is None or not residual.samples:
        unknown = "" if residual is None else f": {residual.problem}"
        return f"{given} {white} (not checked{unknown})"
    found = f"the autocorrelation at lag 1 is {residual.neighbours:.2g}"
    if residual.rows != residual.samples:
        found += f", and the {residual.rows} rows are interpolated or held between them"
    if samples == residual.samples and not residual.problem:
        return f"{given} {white}; whiteness is not rejected, {found}"
    said = residual.problem or f"by their color {residual.independent} are"
    return (
        f"{given} {samples} of the {residual.samples} samples of the residual are independent with "
        f"a constant standard deviation; {said}; {found}"
    )


def with_residual(
    result: TuningResult, moves: Matrix | None = None, *, samples: int | None = None
) -> TuningResult:
    """Return a result with the standard errors that its residual allows.

    Parameters
    ----------
    result : TuningResult
    moves : Matrix, shape (n, p), or None
        As of :func:`cosim.studies.tuning.standard_errors.of_samples`.
    samples : int, optional
        As many are independent; left out: as the residual says.
    """
    residual = result.residual
    if residual is None or result.errors is None:
        return result
    if residual.problem and samples is None:
        way_out = f"or {option('samples')} says how many of them are independent"
        if residual.samples:
            way_out = (
                f"where a wrong model is not the cause, {option('samples')} says how many of the "
                f"{residual.samples} samples are independent"
            )
        problem = f"{residual.problem}; {way_out}"
        return replace(result, errors=None, errors_problem=problem)
    independent = residual.independent if samples is None else samples
    if not residual.samples or (moves is None and independent == result.errors.samples):
        return result
    try:
        errors = of_samples(result.errors, result.space, residual, independent, moves)
    except NoStandardErrors as problem:
        return replace(result, errors=None, errors_problem=str(problem))
    return replace(result, errors=errors)
