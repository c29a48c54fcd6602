"""What studies, searches and tunings print: tables, or the same figures as JSON."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np

from cosim.errors import UsageError, listing, option, quoted, shortened
from cosim.report.printable import print_notice
from cosim.report.tables import console
from cosim.report.tables.console import Shown
from cosim.studies import sensitivity, statistics
from cosim.studies.contracts import RECORDING
from cosim.studies.layout import StudyLayout, StudyResults, count_text, results_of_study
from cosim.studies.statistics import NO_INTERVAL, ConfidenceInterval, Figures

if TYPE_CHECKING:
    from cosim.studies.search import Search
    from cosim.studies.study import Study
    from cosim.studies.studying import StudyEstimate
    from cosim.studies.tuning_result import TuningResult
    from cosim.studies.verifying import StudyVerification

CommandOf: TypeAlias = Callable[[int], str]
_LEAST: Final = statistics.LEAST_MEMBERS
_MOST_REASONS: Final = 20  # that are shown; --json has all
_METRIC_HEADS: Final = ("", "", "95 % interval")
_METHODS: Final = (
    "mean: Student's t; standard deviation: Bonett; quantiles: order statistics; rank "
    "correlations: Fisher's z"
)
_HEADS: Final = [
    "median" if share == 0.5 else f"{100.0 * share:g} %" for share in statistics.PROBABILITIES
]


@dataclass(frozen=True, slots=True)
class ShownParts:
    """What of a study is shown: one of its parts, or without any all members together.

    Parameters
    ----------
    member : int, optional
    metrics : tuple of str
        With all their intervals; of ``by`` and ``sobol``: these only.
    conditions : tuple of str
        Whose shares of members are shown beside all the rest.
    by : str
        A key.
    sobol : bool
    worst : int
        Members of each metric that are listed; of a search, the best.

    Raises
    ------
    UsageError
        If parts do not go together.
    """

    member: int | None = None
    metrics: tuple[str, ...] = ()
    conditions: tuple[str, ...] = ()
    by: str = ""
    sobol: bool = False
    worst: int = 3

    def __post_init__(self) -> None:
        if self.worst < 0:
            raise UsageError(f"{option('worst')}: expected 0 or more, got {self.worst}")
        is_given = {
            "member": self.member is not None,
            "pass": self.conditions,
            "by": self.by,
            "sobol": self.sobol,
            "metric": self.metrics and not (self.by or self.sobol),
        }
        given = [option(name) for name, is_one in is_given.items() if is_one]
        if len(given) > 1:
            raise UsageError(f"expected one of {given[0]} and {given[1]}, got both")


def show_study(
    study: Study,
    layout: StudyLayout,
    command_of: CommandOf,
    parts: ShownParts,
    *,
    search: Search | None = None,
) -> Shown:
    """Show parts of a study, or of a search, also while it runs."""
    results = results_of_study(study, layout)
    for name in parts.metrics:
        results.columns.metric(name)
    if parts.member is not None:
        return _member(study, results, parts.member, command_of(parts.member))
    if parts.sobol:
        return _sobol(results, parts)
    if parts.by:
        return _groups(results, parts)
    if parts.metrics:
        return _metrics(results, parts)
    if search is not None and not parts.conditions:
        return _search(results, search, command_of, parts)
    return _all(results, command_of, parts)


def _table(title: str, heads: Sequence[str], rows: Iterable[Iterable[str]]) -> Shown:
    """Yield a table, unless it has no rows."""
    table = console.new_table(title, heads)
    for row in rows:
        table.add_row(*row)
    if table.rows:
        yield table


# --- all members ---


def _all(results: StudyResults, command_of: CommandOf, parts: ShownParts) -> Shown:
    """Show what all members of a study say."""
    columns, layout = results.columns, results.layout
    largest = {
        name: statistics.extremes(columns, name, parts.worst)
        for name, column in columns.metrics.items()
        if len(column.values) + len(column.infinite)
    }
    of_metrics = statistics.study_statistics(columns, layout)
    shares = [statistics.passed_share(columns, layout, text) for text in parts.conditions]
    correlations = statistics.rank_correlations(columns, layout)
    ended_early = statistics.reasons_of(columns, failed=False)
    outcome = _outcome(results, command_of)
    times = results.wall_times[~columns.failed]
    yield {
        **outcome,
        "design": asdict(layout),
        "wall_time": float(results.wall_times.sum()),
        "median_wall_time": float(np.median(times)) if len(times) else None,
        "statistics": of_metrics,
        "passed": shares,
        "correlations": correlations,
        "ended_early": ended_early,
        "worst": {name: [*largest[name]] for name, one in of_metrics.items() if one["count"]},
    }
    missing = results.missing.tolist()
    not_done = f", {len(missing)} missing ({_members_text(missing)})" if missing else ""
    done = f"{results.done} of {results.planned} members done{not_done}"
    yield from _done(f"{results.name}: {layout.text}; {done}", results)
    rows = [
        (results.with_unit(name), str(one["count"]), *_figures(one, 4))
        for name, one in of_metrics.items()
        if one["count"]
    ]
    yield from _table("statistics", ("", "members", "mean", "deviation", *_HEADS), rows)
    for name, one in of_metrics.items():
        texts = [f"{count} {text}" for text, count in one["texts"].items()]
        if len(texts) > 5:
            texts[5:] = [f"and {count_text(len(texts) - 5, 'other text')}"]
        if texts:
            yield f"{name}: {'; '.join(texts)}"
        yield from _without_number(results, name)
    heads = ("", "members", "share", "95 % interval", "not passed")
    yield from _table("passed", heads, map(_share_row, shares))
    yield from _basis(results, [name for name, one in of_metrics.items() if one["is_rough"]])
    yield from _correlations(results, correlations)
    yield from _failures(outcome, results.done)
    yield from _reasons("ended before their stop time", ended_early)
    if parts.worst and largest:
        yield from _extremes(results, largest)
        number = next(iter(next(iter(largest.values()))))
        yield f"member {number} alone: {command_of(number)}"


def _outcome(results: StudyResults, command_of: CommandOf) -> Figures:
    """Return what JSON says of the members of every study."""
    failures = statistics.reasons_of(results.columns, failed=True)
    counts = {"planned": results.planned, "done": results.done, "failed": results.failed}
    return {
        "name": results.name,
        "members": {**counts, "missing": len(results.missing)},
        "failures": [{**one, "command": command_of(one["first_members"][0])} for one in failures],
        "warnings": statistics.warnings_by_text(results.columns),
    }


def _done(begin: str, results: StudyResults) -> Shown:
    """Show how many members failed, and how long members take."""
    yield f"{begin}, {results.failed or 'none'} failed"
    failed = results.columns.failed
    completed, others = results.wall_times[~failed], results.wall_times[failed]
    times = [f"median {np.median(completed):.3g} s per member"] if len(completed) else []
    times += [f"at most {others.max():.3g} s per failed member"] if len(others) else []
    if times:
        yield f"wall time: {'; '.join(times)}"


def _without_number(results: StudyResults, name: str) -> Shown:
    """Show which members have no finite value of a metric, beside those that failed."""
    column = results.columns.metrics[name]
    for words, numbers in (("no value", column.without_value), ("infinite", column.infinite)):
        if len(numbers):
            members = _members_text(numbers.tolist())
            yield f"{name}: {words} in {count_text(len(numbers))}: {members}"


def _basis(results: StudyResults, rough: Sequence[str]) -> Shown:
    """Show what intervals rest on, and of which metrics they are rough."""
    yield f"±, 95 % intervals: {results.layout.basis}"
    if rough:
        why = "few members or skewed values"
        yield f"intervals of means (±) may be too narrow ({why}): {listing(rough)}"


def _figures(one: Figures, digits: int) -> list[str]:
    """Return the cells of a mean, a deviation and quantiles."""
    mean = text_with_half_width(one["mean"], one["mean_interval"])
    found = [_number_text(quantile["value"], digits) for quantile in one["quantiles"]]
    return [mean, _number_text(one["deviation"], 4), *(found or [""] * len(_HEADS))]


def _share_row(one: Figures) -> list[str]:
    others = one["of"] - one["passed"]
    why = [_members_text(one["first_not_passed"], others)] if others else []
    why += [f"{one['failed']} of them failed"] if one["failed"] else []
    why += [f"{one['without_value']} of them have no value"] if one["without_value"] else []
    share = "" if one["share"] is None else f"{100.0 * one['share']:.3g} %"
    ends = [f"{100.0 * end:.3g} %" for end in one["interval"] if end is not None]
    passed = f"{one['passed']} of {one['of']}"
    return [one["condition"], passed, share, " to ".join(ends), "; ".join(why)]


def _correlations(results: StudyResults, correlations: Sequence[Figures]) -> Shown:
    if correlations and all(one["count"] < _LEAST for one in correlations):
        yield f"rank correlations: none for fewer than {_LEAST} members"
    rows = []
    for name in results.columns.raw_metrics:
        found = statistics.strongest(correlations, name)
        strong = [one for one in found if abs(one["value"]) >= 0.1 and one["is_distinct"]]
        shown = [f"{one['parameter']} {one['value']:+.2f}" for one in strong[:3]]
        rows += [(name, ", ".join(shown))] if shown else []
    yield from _table("rank correlation", ("", "strongest parameters"), rows)
    if rows and results.layout.is_drawn:
        count = len(correlations)
        by_chance = f"; about {count // 20} of {count} pairs are significant by chance"
        more = by_chance if count >= 20 else ""
        yield f"correlations not significant at the 5 % level are omitted{more}"


def _failures(outcome: Figures, done: int) -> Shown:
    """Show why members failed, with the command of the first of each reason, and warnings."""
    yield from _reasons("failures", outcome["failures"])
    for one in outcome["failures"][:_MOST_REASONS]:
        yield f"member {one['first_members'][0]} alone: {one['command']}"
    yield from statistics.warning_lines(outcome["warnings"], done)


def _reasons(title: str, groups: Sequence[Figures]) -> Shown:
    rows = [
        (str(one["count"]), _members_text(one["first_members"], one["count"]), one["reason"])
        for one in groups[:_MOST_REASONS]
    ]
    yield from _table(title, ("members", "first of them", "reason"), rows)
    if len(groups) > len(rows):
        yield f"and {count_text(len(groups) - len(rows), 'other reason')}; see --json"


def _extremes(results: StudyResults, largest: Mapping[str, Mapping[int, float]]) -> Shown:
    rows = []
    for name, found in largest.items():
        ends = (statistics.extremes(results.columns, name, 1, largest=False), found)
        cells = [", ".join(f"{k}: {value:.6g}" for k, value in end.items()) for end in ends]
        rows.append((results.with_unit(name), *cells))
    title = "smallest and largest values, by member"
    return _table(title, ("", "smallest", "largest"), rows)


# --- parts ---


def _metrics(results: StudyResults, parts: ShownParts) -> Shown:
    """Show all that is known of some metrics."""
    columns, layout = results.columns, results.layout
    of_metrics = statistics.study_statistics(columns, layout)
    correlations = statistics.rank_correlations(columns, layout)
    content = {
        name: {
            **of_metrics[name],
            "correlations": statistics.strongest(correlations, name),
            "largest": [*statistics.extremes(columns, name, 20)],
            "smallest": [*statistics.extremes(columns, name, 20, largest=False)],
        }
        for name in parts.metrics
    }
    yield content
    for name, one in content.items():
        yield from _table(results.with_unit(name), _METRIC_HEADS, _metric_rows(results, name, one))
        yield from _basis(results, [name] if one["is_rough"] else [])
        yield _METHODS
        if layout.kind == "saltelli":
            yield "statistics: matrices A and B; smallest, largest, missing values: all members"
        if any(one["metric"] == name and one["count"] < _LEAST for one in correlations):
            yield f"rank correlations: none for fewer than {_LEAST} members"
        yield from _without_number(results, name)


def _metric_rows(results: StudyResults, name: str, one: Figures) -> Iterator[tuple[str, str, str]]:
    yield "members", str(one["count"]), ""
    for key, words in (("failed", "failed"), ("without_value", "no value"), ("infinite",) * 2):
        if one[key]:
            yield words, str(one[key]), ""
    yield "mean", _number_text(one["mean"]), interval_text(one["mean_interval"])
    deviation = _number_text(one["deviation"])
    yield "standard deviation", deviation, interval_text(one["deviation_interval"])
    for head, quantile in zip(_HEADS, one["quantiles"], strict=False):
        yield head, _number_text(quantile["value"]), interval_text(quantile["interval"])
    for words in ("smallest", "largest"):
        ends = statistics.extremes(results.columns, name, 5, largest=words == "largest")
        members = f"members {_members_text([*ends])}" if ends else ""
        yield words, _number_text(next(iter(ends.values()), None)), members
    for pair in one["correlations"]:
        head = f"rank correlation with {pair['parameter']}"
        yield head, f"{pair['value']:+.3f}", interval_text(pair["interval"])


def _groups(results: StudyResults, parts: ShownParts) -> Shown:
    """Show the statistics of metrics for each value of a key."""
    columns = results.columns
    groups = statistics.statistics_by(columns, results.layout, parts.by)
    yield {"key": parts.by, "groups": groups}
    every = [name for name, column in columns.metrics.items() if len(column.values)]
    heads = (results.with_unit(parts.by), "members", "failed", "mean", "deviation", *_HEADS)
    names = parts.metrics or every
    for name in names:
        rows = []
        for group in groups:
            one, value = group["statistics"][name], group["value"]
            head = value if isinstance(value, str) else quoted(value)
            head = "the scenario's own" if value is None else head
            rows.append((head, str(one["count"]), str(group["failed"] or ""), *_figures(one, 5)))
        yield from _table(results.with_unit(name), heads, rows)
    rough = [name for name in names if any(one["statistics"][name]["is_rough"] for one in groups)]
    yield from _basis(results, rough)


def _sobol(results: StudyResults, parts: ShownParts) -> Shown:
    """Show the Sobol indices of metrics; on stderr which metrics have none."""
    sensitivity.check_has_indices(results.layout)
    found = []
    without = []
    for name in parts.metrics or results.columns.raw_metrics:
        try:
            found.append(sensitivity.sobol_indices(results.columns, results.layout, name))
        except UsageError as error:
            without.append(str(error))
    if without and (parts.metrics or not found):
        raise UsageError("; ".join(without))
    yield {indices.metric: indices.to_dict() for indices in found}
    for indices in found:
        yield from _indices(indices, results.with_unit(indices.metric))
    for text in without:
        print_notice(text)


def _indices(indices: sensitivity.SobolIndices, name: str) -> Shown:
    first, total = indices.first_order, indices.total_order
    rows = []
    for k in np.argsort(-total, kind="stable"):
        of_first = (f"{first[k]:.3f}", interval_text(indices.first_intervals[k], ".3f"))
        of_total = (f"{total[k]:.3f}", interval_text(indices.total_intervals[k], ".3f"))
        rows.append((indices.parameters[k], *of_first, *of_total))
    rows.append(("sum", f"{first.sum():.3f}", "", f"{total.sum():.3f}", ""))
    heads = ("", "first order", "95 % interval", "total order", "95 % interval")
    yield from _table(f"Sobol indices of {name}", heads, rows)
    basis = "rough (bootstrap)" if indices.has_intervals else "none (too few)"
    yield f"of {count_text(indices.base_points, 'base point')}; 95 % intervals: {basis}"
    yield from filter(None, [indices.remark])
    omitted = indices.omitted.tolist()
    if omitted:
        yield (
            f"omitted: {count_text(len(omitted), 'base point')} with a member that failed, has no "
            f"value or is missing: {_members_text(omitted)}; the indices are biased if this "
            "depends on the parameters"
        )


def _member(study: Study, results: StudyResults, number: int, command: str) -> Shown:
    """Show all that is recorded of a member, and the command that runs it alone."""
    row = study.table(members=[number]).to_pylist()[0]
    yield {**row, "command": command}
    reason = f": {row['reason']}" if row["reason"] else ""
    yield f"member {number}: {row['status']}{reason}"
    titles = dict.fromkeys(results.columns.parameters, "parameters")
    titles |= dict.fromkeys(results.layout.noise_seeds, "parameters")
    titles |= dict.fromkeys(results.columns.raw_metrics, "metrics")
    empty = {"parameters": "the scenario's own value", "metrics": "no value", "run": ""}
    sections: dict[str, list[tuple[str, str]]] = {title: [] for title in empty}
    for name, value in row.items():
        title = titles.get(name, "run")
        text = empty[title] if value is None else shortened(str(value))
        if text and name not in ("member", "status", "reason"):
            sections[title].append((results.with_unit(name), text))
    for title, rows in sections.items():
        yield from _table(title, ("", ""), rows)
    yield f"alone: {command}"


# --- searches, tunings, verifications, estimates ---


def _search(
    results: StudyResults, search: Search, command_of: CommandOf, parts: ShownParts
) -> Shown:
    """Show the best members of a search."""
    columns = results.columns
    best = statistics.extremes(columns, search.metric, parts.worst, largest=search.maximize)
    places = columns.rows_of(np.array([*best], np.int64))
    points = zip(*(one[places].tolist() for one in columns.parameters.values()), strict=True)
    shown: list[Figures] = []
    for (number, objective), point in zip(best.items(), points, strict=True):
        values = dict(zip(columns.parameters, point, strict=True))
        found = {"member": number, "objective": objective, "values": values}
        shown.append({**found, "command": command_of(number)})
    outcome = _outcome(results, command_of)
    yield {**outcome, "search": asdict(search), "best": shown}
    done = f"{count_text(results.done)} of at most {results.planned}"
    yield from _done(f"{results.name}: {search.method}, {search.goal}; {done}", results)
    keys = [key for key in columns.parameters if key != RECORDING]  # one of all
    rows = [
        map(_number_text, (one["member"], one["objective"], *map(one["values"].get, keys)))
        for one in shown
    ]
    yield from _table("best members", ("member", search.metric, *keys), rows)
    if not best and results.done > results.failed:
        yield f"{search.metric}: no member has a finite value"
    yield from _failures(outcome, results.done)
    for one in shown[:1]:
        yield f"member {one['member']} alone: {one['command']}"


def tuning_lines(result: TuningResult) -> list[str]:
    """Return what a tuning found, in lines."""
    members = count_text(len(result.trials))
    if result.best is None:
        return [f"{members}, none with a value of {result.expression}", *result.statements]
    lines = [f"{result.expression} = {result.best.objective:.6g}, best of {members}"]
    for key, value in result.best.point.items():
        text = _number_text(value)
        if result.errors is not None and isinstance(value, float):
            error = result.errors.errors[key]
            digits = 6
            if value and error > 0.0:  # two digits of the error
                digits = max(digits, math.floor(math.log10(abs(value) / error)) + 2)
            low, high = (f"{end:.{digits}g}" for end in result.errors.intervals[key])
            interval = f"95 % interval {low} to {high}"
            text = f"{value:.{digits}g}, standard error {error:.2g}, {interval}"
        lines.append(f"  {key} = {text}")
    return [*lines, *result.statements, f"again: {result.command}"]


def show_verification(found: StudyVerification) -> Shown:
    """Show what came of running members again, and what that does not show."""
    yield found.to_dict()
    count = len(found.members)
    numbers = listing([str(number) for number in found.members], 10)
    rerun = "rerun, each built from scratch in its own process"
    yield f"{found.name}: {count} of {count_text(found.done)} {rerun}: {numbers}"
    for item in found.differences:
        yield f"member {item.member}: {item.name} was {item.recorded!r}, is {item.now!r}"
    differing = len({item.member for item in found.differences})
    if differing:
        differ = "differs" if differing == 1 else "differ"
        yield f"{differing} of {count_text(count)} {differ} from the record"
    else:
        yield f"identical bit for bit: {listing(found.values, 10)}"
    not_shown = [f"{count_text(found.done - count)} not rerun"] if found.done > count else []
    elsewhere = "results on other machines"
    if found.elsewhere:
        machines = f"results on the original machine ({listing(found.elsewhere, 3)})"
        elsewhere = f"{machines}: libraries of this one may round differently"
    not_shown += [elsewhere, "signals without a metric"]
    if found.is_searched:
        not_shown.append("whether the search would choose these members again")
    not_shown += [f"{name} was {old}, is {now}" for name, (old, now) in found.environment.items()]
    yield f"not verified: {'; '.join(not_shown)}"


def show_estimate(name: str, estimate: StudyEstimate) -> Shown:
    """Show what a study will take."""
    yield {"name": name, **estimate.to_dict()}
    logs = estimate.log_bytes
    entries = {
        "members": str(estimate.members),
        "first member of a worker": f"{estimate.first_time:.3g} s",
        "every other member": f"{estimate.member_time:.3g} s, as measured for one",
        f"total, on {estimate.workers} workers": _duration(estimate.study_time),
        "dataset": f"about {_bytes(estimate.dataset_bytes)}, before compression",
    }
    if logs != 0:
        entries["kept logs"] = "unknown (as many as fail)" if logs is None else _bytes(logs)
    yield from _table(f"{name}: dry run, nothing was recorded", ("", ""), entries.items())


# --- texts ---


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.3g} s"
    return f"{seconds / 60:.3g} min" if seconds < 7200 else f"{seconds / 3600:.3g} h"


def _bytes(count: int) -> str:
    power = min(max(len(str(count)) - 1, 0) // 3, 4)
    return f"{count / 1000**power:.3g} {('B', 'kB', 'MB', 'GB', 'TB')[power]}"


def _number_text(value: Any, digits: int = 6) -> str:
    if isinstance(value, float):
        return f"{value:.{digits}g}"
    return "" if value is None else str(value)


def text_with_half_width(value: float | None, interval: ConfidenceInterval) -> str:
    """Return a value with the half-width of its interval, to the second digit of that."""
    half_width = math.nan
    if interval.lower is not None and interval.upper is not None:
        half_width = 0.5 * (interval.upper - interval.lower)
    if value is None or not 0.0 < half_width < math.inf:
        return _number_text(value)
    exponent = int(f"{half_width:.1e}".partition("e")[2])
    common = 0
    if not -7 <= exponent <= 4 or abs(value) >= 1e8:
        common = max(exponent, math.floor(math.log10(abs(value))) if value else exponent)
    digits = max(1 - exponent + common, 0)
    unit = 10.0**common
    text = f"{value / unit:.{digits}f} ± {half_width / unit:.{digits}f}"
    return f"({text})e{common:+03d}" if common else text


def interval_text(interval: ConfidenceInterval, form: str = ".4g") -> str:
    """Return an interval in words; which end it has not."""
    if interval == NO_INTERVAL:
        return ""
    lower, upper = ("(too few members)" if end is None else f"{end:{form}}" for end in interval)
    return f"{lower} to {upper}"


def _members_text(numbers: Sequence[int], count: int | None = None) -> str:
    """Return the first of so many members, and how many more there are."""
    more = (len(numbers) if count is None else count) - 5
    shown = ", ".join(map(str, numbers[:5]))
    return f"{shown}, and {more} more" if more > 0 else shown
