"""Replays of one log with varied values: every combination of those of several keys.

A replay that fails is a row like the others, with its reason.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain, product
from pathlib import Path
from typing import Any, Final

from cosim.arguments import callable_argument, mapping_argument, setting_arguments, truth_argument
from cosim.core.recorded.signals import DistinctWarnings, warning_texts
from cosim.errors import UsageError, option, quoted
from cosim.log import Log
from cosim.report.comparing import attempt, log_paths, results_table
from cosim.report.printable import print_notice
from cosim.report.summary import ResultValue, Summary, results_of, summarize
from cosim.report.tables.console import Shown
from cosim.scenario.document.document import short
from cosim.scenario.document.problems import TableProblems
from cosim.scenario.document.swaps import PortNames
from cosim.scenario.kinds.base import Scenario
from cosim.scenario.recordings.recording import Progress, Target
from cosim.scenario.recordings.replay_request import ReplayRequest
from cosim.scenario.running.replay import Replays, replays_of
from cosim.studies.design import check_keys
from cosim.studies.variations import GridVariation, read_variation

MOST_COMBINATIONS: Final = 1000


@dataclass(frozen=True)
class SweepRow:
    """One replay of a sweep.

    Parameters
    ----------
    values : mapping of dotted key to value
        What was varied.
    summary : Summary or None
        None: the replay failed.
    problem : str
        Why it failed; empty: it did not.
    path : Path or None
        Of its log; None: none was written.
    """

    values: Mapping[str, Any]
    summary: Summary | None
    problem: str = ""
    path: Path | None = None

    @property
    def results(self) -> dict[str, ResultValue]:
        """What the result says, by column: see :func:`results_of`; empty where it failed."""
        return {} if self.summary is None else results_of(self.summary)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "values": dict(self.values),
            "results": self.results,
            "problem": self.problem or None,
            "log": None if self.path is None else str(self.path),
            "summary": None if self.summary is None else self.summary.to_dict(),
        }


@dataclass(frozen=True)
class ReplaySweep:
    """Replays of one log with varied values.

    Parameters
    ----------
    log : str
        Its path.
    varied : tuple of str
        The keys whose values differ.
    rows : tuple of SweepRow
        One a combination, in their order.
    """

    log: str
    varied: tuple[str, ...]
    rows: tuple[SweepRow, ...]

    @property
    def columns(self) -> tuple[str, ...]:
        """The names of all results that a row has."""
        return tuple(dict.fromkeys(chain.from_iterable(row.results for row in self.rows)))

    def __getitem__(self, column: str) -> list[ResultValue]:
        """Return a result in every row; None where there is none."""
        return [row.results.get(column) for row in self.rows]

    @property
    def passed(self) -> bool:
        """Whether no replay failed."""
        return not any(row.problem for row in self.rows)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "log": self.log,
            "varied": list(self.varied),
            "columns": list(self.columns),
            "rows": [row.to_dict() for row in self.rows],
        }


def show_sweep(sweep: ReplaySweep) -> Shown:
    """Show the results of replays; on stderr what they warned of."""
    yield sweep.to_dict()
    rows = []
    for row in sweep.rows:
        values = [quoted(value) for value in row.values.values()]
        rows.append((values, None if row.problem else row.results))
    yield results_table(sweep.log, sweep.varied, rows)
    warnings = [one for row in sweep.rows if row.summary for one in row.summary.warnings]
    for text in warning_texts(DistinctWarnings(warnings)):
        print_notice(f"warning: {text}")


def replay_sweep(
    log: str | Path | Log,
    *,
    vary: Mapping[str, Any],
    set: Mapping[str, Any] | None = None,
    swap: Mapping[str, str | Path] | None = None,
    map: Mapping[str, PortNames] | None = None,
    allow_code: bool = False,
    rerun: bool = False,
    window: tuple[float | None, float | None] | None = None,
    components: Sequence[str] | None = None,
    scenario: str | Path | Scenario | None = None,
    stop: float | None = None,
    verdicts: bool | None = None,
    out: str | Path | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> ReplaySweep:
    """Replay a log with every combination of some values: one log, many answers.

    All combinations are checked before the first is run. What is taken from a log of cosim is read
    once.

    Parameters
    ----------
    log : str, Path or Log
        As of :func:`cosim.replay`: of a log that was rotated with the files before it.
    vary : mapping of dotted key to values
        A list, ``{"identifier.P0": [1e3, 1e6], "observer.filter_rate": [100.0, 300.0]}``, or a
        grid as in the file of a study, ``{"log": [10.0, 1e3], "points": 3}``; there are at most
        1000 combinations.
    set : mapping of dotted key to value, optional
        What all of them have; not what is varied.
    swap, map, allow_code, rerun, window, components, scenario, stop, verdicts
        As of :func:`cosim.replay`.
    out : str or Path, optional
        Folder for their logs, ``1.mcap``, ``2.mcap``, ... in the order of the rows; without it
        nothing is written.
    force : bool
        Replace logs there.
    progress : callable, optional
        Called with simulated time and end [s], of all replays together.

    Raises
    ------
    UsageError
        As from :func:`cosim.replay`, before the first replay; it names the combination.
    Interrupted
        If the user interrupts one.
    """
    callable_argument("progress", progress)
    force = truth_argument("force", force)
    with setting_arguments(set, stop=stop, verdicts=verdicts) as changes:
        request = ReplayRequest(
            set=changes,
            swap=swap,
            map=map,
            allow_code=allow_code,
            rerun=rerun,
            window=window,
            components=components,
            scenario=scenario,
        )
        replays = replays_of(log, request)
        return sweep_of(replays, vary, out=out, force=force, progress=progress)


def sweep_of(
    replays: Replays,
    vary: Mapping[str, Any],
    *,
    out: str | Path | None,
    force: bool,
    progress: Progress | None,
) -> ReplaySweep:
    """Replay with every combination of some values; parameters as of :func:`replay_sweep`."""
    chosen = combinations(vary)
    check_keys([(short(key), "varied") for key in chosen[0]], replays.request.changes)
    names = [str(number) for number in range(1, len(chosen) + 1)]
    paths = log_paths(out, names, partial(replays.check_target, force=force))
    for values in chosen:
        try:
            replays.check(values)
        except UsageError as error:
            texts = [f"{key} = {quoted(value)}" for key, value in values.items()]
            problem = str(error)
            if len(values) == 1:
                problem = problem.removeprefix(f"{option('set', *values)}: ")
            raise UsageError(f"{', '.join(texts)}: {problem}") from error
    rows = []
    for number, (values, path) in enumerate(zip(chosen, paths, strict=True)):
        part = None if progress is None else partial(_part, progress, number, len(chosen))
        target = Target(path, force)
        again, problem = attempt(partial(replays.record, values, target, progress=part))
        rows.append(SweepRow(values, None if again is None else summarize(again), problem, path))
    return ReplaySweep(replays.label, tuple(chosen[0]), tuple(rows))


def _part(progress: Progress, number: int, count: int, time: float, end: float) -> None:
    """Report the progress of one replay as a part of that of all."""
    progress(number * end + time, count * end)


def combinations(vary: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return every combination of values by key; that of the last key changes first.

    Raises
    ------
    UsageError
        If a key has no values, or a distribution; there is no key, or there are more than
        ``MOST_COMBINATIONS`` combinations.
    """
    given = mapping_argument("vary", vary)
    if not given:
        raise UsageError(f"{option('vary')}: expected a key and its values, got nothing")
    values_of = {key: _values(key, values) for key, values in given.items()}
    counts = list(map(len, values_of.values()))
    if math.prod(counts) > MOST_COMBINATIONS:
        raise UsageError(
            f"{option('vary')}: expected at most {MOST_COMBINATIONS} combinations, got "
            f"{' x '.join(map(str, counts))} = {math.prod(counts)}"
        )
    return [dict(zip(values_of, row, strict=True)) for row in product(*values_of.values())]


def _values(key: str, value: Any) -> tuple[Any, ...]:
    """Return the values of a key, which are given as in the file of a study."""
    place = option("vary", key)
    try:
        variation = read_variation(key, list(value) if isinstance(value, range) else value)
    except TableProblems as error:
        texts = [": ".join(map(str, (place, *inner, text))) for inner, text in error.problems]
        raise UsageError("\n".join(texts)) from error
    if not isinstance(variation, GridVariation):
        raise UsageError(
            f"{place}: expected a list of values, or a grid, got {quoted(variation.distribution)}; "
            "'cosim study' draws from distributions"
        )
    return variation.values
