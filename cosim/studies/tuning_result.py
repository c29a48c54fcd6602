"""What a search finds: its result, and the sentences that say what it is worth."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any

from cosim.arrays import Matrix
from cosim.errors import listing
from cosim.studies.contracts import MemberOutcome
from cosim.studies.residual import ResidualCheck
from cosim.studies.search import (
    BATCHES,
    OBJECTIVE,
    Point,
    RunPoints,
    Search,
    SearchEnd,
    SearchEnded,
    SearchTrial,
    Trials,
    search_points,
)
from cosim.studies.standard_errors import (
    NoStandardErrors,
    StandardErrors,
    errors_at,
    members_of_errors,
    of_samples,
)
from cosim.studies.statistics import grouped, warning_lines


@dataclass(frozen=True, slots=True, repr=False)
class TuningResult:
    """What a tuning found.

    Parameters
    ----------
    search : Search
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
    errors : StandardErrors or None
    errors_problem : str
        Why there are no standard errors; empty: they were not wanted, or are there.
    residual : ResidualCheck or None
        What noise the residual is at the best values; None: that is not known.
    command : str
        The line for a shell that runs the best member alone, bit for bit; empty: it is not known.
    """

    search: Search
    trials: tuple[SearchTrial, ...]
    best: SearchTrial | None
    finished: bool
    stop_reason: str
    ends: tuple[SearchEnd, ...]
    best_end: SearchEnd | None
    errors: StandardErrors | None
    errors_problem: str
    residual: ResidualCheck | None = None
    command: str = ""

    def __repr__(self) -> str:
        best = self.best
        found = "none" if best is None else f"{best.objective:.6g} at {_values_text(best.point)}"
        return f"<TuningResult {self.expression}: {found}>"

    @property
    def expression(self) -> str:
        """The metric."""
        return self.search.expression

    @property
    def estimate(self) -> dict[str, Any]:
        """The best values by key; none: no member has an objective."""
        return {} if self.best is None else dict(self.best.point)

    @property
    def standard_errors(self) -> dict[str, float] | None:
        """The standard errors by key; None: there are none, ``errors_problem`` may say why."""
        return None if self.errors is None else dict(self.errors.errors)

    @property
    def history(self) -> list[dict[str, Any]]:
        """Member, values and objective of every trial, in the order in which they were tried."""
        return [_trial_dict(trial) for trial in self.trials]

    @property
    def failed(self) -> tuple[SearchTrial, ...]:
        """The trials without an objective."""
        return tuple(trial for trial in self.trials if trial.objective is None)

    @property
    def warnings(self) -> list[str]:
        """How many members warn of what, a line each."""
        pairs = [(trial.number, line) for trial in self.trials for line in trial.warnings]
        return warning_lines(grouped(pairs), len(self.trials))

    @property
    def at_bounds(self) -> dict[str, str]:
        """Which bound a best value is at, ``lower`` or ``upper``; of keys where it is at one."""
        near = 1e-4  # of the range between the bounds
        found = {}
        for key in self.search.bounded if self.best is not None else ():
            coordinate = key.coordinate(self.estimate[key.key])
            if not near < coordinate < 1.0 - near:
                found[key.key] = "lower" if coordinate <= near else "upper"
        return found

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "objective": OBJECTIVE,
            "maximize": self.search.maximize,
            "method": self.search.method,
            "best": None if self.best is None else _trial_dict(self.best),
            "members": len(self.trials),
            "failed": [_trial_dict(trial, "problem") for trial in self.failed],
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

    @property
    def statements(self) -> list[str]:
        """What is to be said of the result: why it ended, and what it does not exclude."""
        said = [self._ending]
        failed = self.failed
        if failed:
            numbers = listing([str(trial.number) for trial in failed])
            problems = listing([*dict.fromkeys(trial.problem for trial in failed)], 3)
            have = "member has" if len(failed) == 1 else "members have"
            said.append(f"{len(failed)} {have} no objective ({numbers}): {problems}")
        said += self.warnings
        if self.best is None:
            return said
        costs = [trial.cost for trial in self.trials if trial.objective is not None]
        if len(costs) > 1 and max(costs) - min(costs) <= 1e-9 * max(map(abs, costs)):
            keys = "the varied keys have no effect on it here"
            return [*said, f"all members have the same objective: {keys}"]
        for key, side in self.at_bounds.items():
            said.append(f"{key} is at its {side} bound: values beyond it may be better")
        return [*said, self._elsewhere(self.best), *self._of_errors()]

    @property
    def _ending(self) -> str:
        end = self.best_end
        if end is not None:
            return end.reason if self.finished else f"{end.reason}; then {self.stop_reason}"
        if self.best is not None and not self.finished and self.search.method != "optuna":
            return f"{self.stop_reason} before a search converged at these values"
        return self.stop_reason

    def _elsewhere(self, best: SearchTrial) -> str:
        """Return what is known of other places than the best one."""
        starts = self.search.starts
        if self.search.method in BATCHES:
            return "whether there are better values elsewhere is not known"
        ended = len(self.ends)
        others = [end for end in self.ends if self.search.distance(end.point, best.point) > 0.01]
        if others:
            other = min(others, key=lambda end: end.cost)
            place = _values_text(other.point)
            if math.isclose(other.cost, best.cost, rel_tol=1e-6):
                found = f"another start ended at {place} with this objective"
                return f"the values are not unique: {found}"
            objective = -other.cost if self.search.maximize else other.cost
            return (
                f"{len(others)} of {ended} starts ended elsewhere, the best of them at "
                f"{place} with {objective:.6g}: more starts, or the method 'global', may find "
                "better values"
            )
        found = f"{ended} of {starts} starts finished and ended here"
        if not ended:
            found = "no local search has finished"
        elif ended == starts:
            found = "searched from one start" if starts == 1 else f"all {starts} starts ended here"
        return f"{found}; better values elsewhere are not excluded"

    def _of_errors(self) -> Iterator[str]:
        if self.errors_problem:
            yield f"no standard errors: {self.errors_problem}"
        if self.errors is None:
            return
        yield f"the standard errors assume that {self._assumed(self.errors.samples)}"
        for key in self.search.bounded:
            low, high = self.errors.intervals[key.key]
            if low < key.lower or high > key.upper:
                beyond = "extends beyond its bounds, where nothing was tried"
                yield f"the interval of {key.key} {beyond}"
        for name in self.errors.skewed:
            rises = f"along {name} the objective rises unevenly within a standard error"
            yield f"{rises}: its interval is rough"

    def _assumed(self, samples: int) -> str:
        """Return what standard errors assume of the residual, and what is known of that."""
        residual = self.residual
        which = f"{samples} samples of the residual are white"
        if residual is None or not residual.samples:
            known = f"not checked{'' if residual is None else f': {residual.problem}'}"
        elif samples == residual.samples and not residual.problem:
            known = "whiteness is not rejected"
        else:
            which = f"{samples} of the {residual.samples} samples of the residual are independent"
            known = residual.problem or f"by their color {residual.independent} are"
        if residual is not None and residual.samples:
            known += f"; the autocorrelation at lag 1 is {residual.neighbours:.2g}"
            if residual.rows != residual.samples:
                known += f", and the {residual.rows} rows are interpolated or held between them"
        return f"{which}, with a constant standard deviation; {known}"


def _trial_dict(trial: SearchTrial, name: str = "objective") -> dict[str, Any]:
    return {"member": trial.number, "values": dict(trial.point), name: getattr(trial, name)}


def _values_text(point: Point) -> str:
    return ", ".join(
        f"{key} = {value:.6g}" if isinstance(value, float) else f"{key} = {value}"
        for key, value in point.items()
    )


def search_best(
    run: RunPoints,
    search: Search,
    first: Point,
    *,
    with_errors: bool = False,
    samples: int | None = None,
    recorded: Iterable[tuple[Point, MemberOutcome]] = (),
    progress: Callable[[int, int, int], None] | None = None,
) -> TuningResult:
    """Search the best point, and its standard errors as if the rows were independent samples.

    Parameters
    ----------
    run, search, recorded, progress
        As of :class:`cosim.studies.search.Trials`.
    first : mapping of key to value
        Of the point that is tried first; left out: the middle between the bounds.
    with_errors : bool
        Find standard errors.
    samples : int, optional
        Independent ones of the residual; left out: all.
    """
    trials = Trials(run, search, recorded, progress)
    if with_errors:
        trials.members -= min(members_of_errors(len(search.keys)), search.members // 2)
    finished = True
    try:
        stop_reason = search_points(trials, first)
    except SearchEnded as error:
        finished, stop_reason = False, str(error)
    best, best_end, errors, problem = trials.best, None, None, ""
    if best is not None:
        at_best = (e for e in trials.ends if search.distance(e.point, best.point) <= 1e-3)
        best_end = next((end for end in at_best if end.converged), None)
    trials.members = search.members
    if with_errors:
        try:
            errors = errors_at(trials, best, samples)
        except (NoStandardErrors, SearchEnded) as error:
            problem = str(error)
    found = (finished, stop_reason, tuple(trials.ends), best_end, errors, problem)
    return TuningResult(search, trials.all, trials.best, *found)


def with_residual(
    result: TuningResult, residual: ResidualCheck | None, moves: Matrix | None, samples: int | None
) -> TuningResult:
    """Return a result whose standard errors are those of the samples of the residual.

    Parameters
    ----------
    result : TuningResult
        Whose standard errors are as if all rows were samples.
    residual : ResidualCheck or None
        Of the best values; None: nothing is known of it.
    moves : Matrix, shape (n, p), or None
        How W' times the residual moves with each value, per standard error; None: W is 1.
    samples : int or None
        How many of its samples are independent; None: as it says itself.
    """
    if residual is None or result.errors is None:
        return result
    errors, problem = None, ""
    try:
        errors = of_samples(result.errors, result.search, residual, samples, moves)
    except NoStandardErrors as error:
        problem = str(error)
    return replace(result, residual=residual, errors=errors, errors_problem=problem)
