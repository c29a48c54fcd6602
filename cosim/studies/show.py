"""What studies, searches and tunings print: tables, or the same figures as JSON."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np

from cosim.errors import UsageError, listing, option, quoted, shortened
from cosim.report.tables.console import new_table, print_json, print_line, print_section
from cosim.report.tables.console import print_table as print_table
from cosim.studies import sensitivity, statistics
from cosim.studies.contracts import RECORDING
from cosim.studies.layout import (
    StudyLayout,
    StudyResults,
    count_text,
    independence_of,
    results_of_study,
)
from cosim.studies.statistics import ConfidenceInterval, Figures

if TYPE_CHECKING:
    from cosim.studies.search import Search
    from cosim.studies.study import Study
    from cosim.studies.studying import StudyEstimate
    from cosim.studies.tuning_result import TuningResult
    from cosim.studies.verifying import StudyVerification

CommandOf: TypeAlias = Callable[[int], str]
_LEAST: Final = statistics.LEAST_MEMBERS
_MOST_REASONS: Final = 20  # that are shown; --json has all
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
    as_json : bool

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
    as_json: bool = False

    def __post_init__(self) -> None:
        if self.worst < 0:
            raise UsageError(f"{option('worst')}: expected 0 or more, got {self.worst}")
        is_given = {
            "member": self.member is not None,
            "pass": bool(self.conditions),
            "by": bool(self.by),
            "sobol": self.sobol,
            "metric": bool(self.metrics) and not (self.by or self.sobol),
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
) -> None:
    """Print parts of a study, or of a search, also while it runs."""
    results = results_of_study(study, layout)
    if parts.member is not None:
        if not 0 <= parts.member < results.planned:
            last = results.planned - 1
            raise UsageError(f"expected a member from 0 to {last}, got {parts.member}")
        if parts.member in results.missing:
            again = "run the study again to continue"
            raise UsageError(f"member {parts.member} has not run yet; {again}")
        row = study.table(members=[parts.member]).to_pylist()[0]
        _show_member(row, results, command_of(parts.member), as_json=parts.as_json)
    elif parts.sobol:
        _show_sobol(results, parts)
    elif parts.by:
        _show_groups(results, parts)
    elif parts.metrics:
        _show_metrics(results, parts)
    elif search is not None and not parts.conditions:
        _show_search(results, search, command_of, parts)
    else:
        _show_all(results, command_of, parts)


def _show_all(results: StudyResults, command_of: CommandOf, parts: ShownParts) -> None:
    """Print what all members of a study say."""
    columns, layout = results.columns, results.layout
    shares = [statistics.passed_share(columns, layout, text) for text in parts.conditions]
    of_metrics = statistics.study_statistics(columns, layout)
    correlations = statistics.rank_correlations(columns, layout)
    ended_early = statistics.reasons_of(columns, failed=False)
    if parts.as_json:
        with_values = [name for name, one in of_metrics.items() if one["count"]]
        worst = {name: [*statistics.extremes(columns, name, parts.worst)] for name in with_values}
        times = results.wall_times[~columns.failed]
        content = {
            "design": asdict(layout),
            "wall_time": float(results.wall_times.sum()),
            "median_wall_time": float(np.median(times)) if len(times) else None,
            "statistics": of_metrics,
            "passed": shares,
            "correlations": correlations,
            "ended_early": ended_early,
            "worst": worst,
        }
        print_json({**_outcome(results, command_of), **content})
        return
    missing = results.missing.tolist()
    not_done = f"{len(missing)} missing ({_members_text(missing)}), " if len(missing) else ""
    count = f"{results.done} of {results.planned} members done, {not_done}{_failed_text(results)}"
    print_line(f"{results.name}: {layout.text}; {count}")
    _print_wall_time(results)
    _print_statistics(results, of_metrics)
    heads = ("", "members", "share", "95 % interval", "not passed")
    _print_rows("passed", heads, [_share_row(share) for share in shares])
    for one in [one for one in (*of_metrics.values(), *shares) if one.get("count") != 0][:1]:
        print_line(f"±, 95 % intervals: {one['basis']}")
    rough = [name for name, one in of_metrics.items() if one["is_rough"]]
    if rough:
        print_line(f"± may be too small (few members or skewed values): {listing(rough)}")
    _print_correlations(results, correlations)
    _print_failures(results, command_of)
    _print_reasons("ended before their stop time", ended_early)
    if parts.worst:
        _print_extremes(results, command_of, parts.worst)


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


def _failed_text(results: StudyResults) -> str:
    return f"{results.failed} failed" if results.failed else "none failed"


def _print_wall_time(results: StudyResults) -> None:
    failed = results.columns.failed
    completed, others = results.wall_times[~failed], results.wall_times[failed]
    if len(completed):
        line = f"wall time: median {np.median(completed):.3g} s per member"
        if len(others):
            line += f" that completed; at most {others.max():.3g} s per failed member"
        print_line(line)
    elif len(others):
        print_line(f"wall time: median {np.median(others):.3g} s per failed member")


def _print_rows(title: str, heads: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table, unless it has no rows."""
    table = new_table(title, heads)
    for row in rows:
        table.add_row(*row)
    if rows:
        print_table(table)


def _print_statistics(results: StudyResults, of_metrics: Mapping[str, Figures]) -> None:
    with_values = {name: one for name, one in of_metrics.items() if one["count"]}
    rows = [
        (results.with_unit(name), str(one["count"]), *_figures(one, 4))
        for name, one in with_values.items()
    ]
    _print_rows("statistics", ("", "members", "mean", "deviation", *_HEADS), rows)
    for name, one in of_metrics.items():
        texts = [f"{count} {text}" for text, count in one["texts"].items()]
        if len(texts) > 5:
            texts[5:] = [f"and {count_text(len(texts) - 5, 'other text')}"]
        if texts:
            print_line(f"{name}: {'; '.join(texts)}")
        for words, numbers in _without_number(results, name):
            counted = count_text(len(numbers))
            print_line(f"{name}: {words} in {counted}: {_members_text(numbers)}")


def _without_number(results: StudyResults, name: str) -> list[tuple[str, Sequence[int]]]:
    """Return which members have no finite value of a metric, beside those that failed."""
    column = results.columns.metrics[name]
    pairs = (("no value", column.without_value), ("infinite", column.infinite))
    return [(words, numbers.tolist()) for words, numbers in pairs if len(numbers)]


def _figures(one: Figures, digits: int) -> list[str]:
    """Return the cells of a mean, a deviation and quantiles."""
    found = [f"{quantile['value']:.{digits}g}" for quantile in one["quantiles"]]
    mean = text_with_half_width(one["mean"], one["mean_interval"])
    return [mean, _number_text(one["deviation"], 4), *(found or [""] * len(_HEADS))]


def _share_row(one: Figures) -> list[str]:
    others = one["of"] - one["passed"]
    why = [_members_text(one["first_not_passed"], others)] if others else []
    for key, words in (("failed", "failed"), ("without_value", "have no value")):
        if one[key]:
            why.append(f"{one[key]} of them {words}")
    share = "" if one["share"] is None else f"{100.0 * one['share']:.3g} %"
    lower, upper = one["interval"]
    ends = "" if lower is None else f"{100.0 * lower:.3g} % to {100.0 * upper:.3g} %"
    return [one["condition"], f"{one['passed']} of {one['of']}", share, ends, "; ".join(why)]


def _print_correlations(results: StudyResults, correlations: Sequence[Figures]) -> None:
    if correlations and all(one["count"] < _LEAST for one in correlations):
        print_line(f"rank correlations: none for fewer than {_LEAST} members")
    rows = []
    for name in results.columns.raw_metrics:
        found = statistics.strongest(correlations, name)
        strong = [one for one in found if abs(one["value"]) >= 0.1 and one["is_distinct"]]
        shown = [f"{one['parameter']} {one['value']:+.2f}" for one in strong[:3]]
        rows += [(name, ", ".join(shown))] if shown else []
    _print_rows("rank correlation", ("", "strongest parameters"), rows)
    if rows and independence_of(results.layout).is_drawn:
        count = len(correlations)
        by_chance = f"; about {count // 20} of {count} pairs are significant by chance"
        more = by_chance if count >= 20 else ""
        print_line(f"correlations not significant at the 5 % level are omitted{more}")


def _print_failures(results: StudyResults, command_of: CommandOf) -> None:
    """Print why members failed, with the command of the first of each reason, and warnings."""
    failures = statistics.reasons_of(results.columns, failed=True)
    _print_reasons("failures", failures)
    for group in failures[:_MOST_REASONS]:
        _print_command(group["first_members"][0], command_of)
    warnings = statistics.warnings_by_text(results.columns)
    for line in statistics.warning_lines(warnings, results.done):
        print_line(line)


def _print_reasons(title: str, groups: Sequence[Figures]) -> None:
    rows = []
    for group in groups[:_MOST_REASONS]:
        members = _members_text(group["first_members"], group["count"])
        rows.append((str(group["count"]), members, group["reason"]))
    _print_rows(title, ("members", "first of them", "reason"), rows)
    if len(groups) > len(rows):
        print_line(f"and {count_text(len(groups) - len(rows), 'other reason')}; see --json")


def _print_command(number: int, command_of: CommandOf) -> None:
    print_line(f"member {number} alone: {command_of(number)}")


def _print_extremes(results: StudyResults, command_of: CommandOf, count: int) -> None:
    rows = []
    first = []
    for name, column in results.columns.metrics.items():
        if len(column.values) + len(column.infinite):
            smallest = statistics.extremes(results.columns, name, 1, largest=False)
            ends = [smallest, statistics.extremes(results.columns, name, count)]
            cells = [", ".join(f"{k}: {value:.6g}" for k, value in end.items()) for end in ends]
            rows.append((results.with_unit(name), *cells))
            first.append(next(iter(ends[1])))
    _print_rows("smallest and largest values, by member", ("", "smallest", "largest"), rows)
    if first:
        _print_command(first[0], command_of)


def _show_metrics(results: StudyResults, parts: ShownParts) -> None:
    """Print all that is known of some metrics."""
    columns = results.columns
    for name in parts.metrics:
        columns.metric(name)
    of_metrics = statistics.study_statistics(columns, results.layout)
    correlations = statistics.rank_correlations(columns, results.layout)
    content = {}
    for name in parts.metrics:
        content[name] = {
            **of_metrics[name],
            "correlations": statistics.strongest(correlations, name),
            "largest": [*statistics.extremes(columns, name, 20)],
            "smallest": [*statistics.extremes(columns, name, 20, largest=False)],
        }
    if parts.as_json:
        print_json(content)
        return
    for name, one in content.items():
        _print_metric(results, name, one)
        own = [pair for pair in correlations if pair["metric"] == name]
        few = [pair["parameter"] for pair in own if pair["count"] < _LEAST]
        if few:
            which = "" if len(few) == len(own) else f" with {listing(few)}"
            print_line(f"rank correlations{which}: none for fewer than {_LEAST} members")
        for words, numbers in _without_number(results, name):
            print_line(f"{words} in members {_members_text(numbers)}")


def _print_metric(results: StudyResults, name: str, one: Figures) -> None:
    counts = {
        "failed": one["failed"],
        "no value": one["without_value"],
        "infinite": one["infinite"],
    }
    rows = [("members", str(one["count"]), "")]
    rows += [(words, str(count), "") for words, count in counts.items() if count]
    figures = [("mean", one["mean"], one["mean_interval"])]
    figures += [("standard deviation", one["deviation"], one["deviation_interval"])]
    for head, quantile in zip(_HEADS, one["quantiles"], strict=False):
        figures += [(head, quantile["value"], quantile["interval"])]
    for words, value, interval in figures:
        rows.append((words, _number_text(value), interval_text(interval)))
    for words in ("smallest", "largest"):
        ends = statistics.extremes(results.columns, name, 5, largest=words == "largest")
        members = f"members {_members_text([*ends])}" if ends else ""
        rows.append((words, _number_text(next(iter(ends.values()), None)), members))
    for pair in one["correlations"]:
        head = f"rank correlation with {pair['parameter']}"
        rows.append((head, f"{pair['value']:+.3f}", interval_text(pair["interval"])))
    _print_rows(results.with_unit(name), ("", "", "95 % interval"), rows)
    if results.layout.kind == "saltelli":
        print_line(
            "statistics: members of matrices A and B; smallest, largest and missing values: all "
            "members"
        )
    print_line(f"95 % intervals: {one['basis']}")
    if one["mean_interval"].lower is not None:
        print_line(
            "mean: Student's t; standard deviation: Bonett; quantiles: order statistics; rank "
            "correlations: Fisher's z"
        )
    if one["is_rough"]:
        print_line("the interval of the mean may be too narrow (few members or skewed values)")


def _show_groups(results: StudyResults, parts: ShownParts) -> None:
    """Print the statistics of metrics for each value of a key."""
    columns = results.columns
    for name in parts.metrics:
        columns.metric(name)
    groups = statistics.statistics_by(columns, results.layout, parts.by)
    if parts.as_json:
        print_json({"key": parts.by, "groups": groups})
        return
    every = [name for name, column in columns.metrics.items() if len(column.values)]
    heads = (results.with_unit(parts.by), "members", "failed", "mean", "deviation", *_HEADS)
    is_rough = False
    for name in parts.metrics or every:
        rows = []
        for group in groups:
            one, value = group["statistics"][name], group["value"]
            head = value if isinstance(value, str) else quoted(value)
            rows.append((head, str(one["count"]), str(group["failed"] or ""), *_figures(one, 5)))
            is_rough |= one["is_rough"]
        _print_rows(results.with_unit(name), heads, rows)
    print_line(f"±, 95 % intervals: {independence_of(results.layout).basis}")
    if is_rough:
        print_line("± may be too small for groups of few members or with skewed values")


def _show_sobol(results: StudyResults, parts: ShownParts) -> None:
    """Print the Sobol indices of metrics, and which metrics have none."""
    sensitivity.check_has_indices(results.layout)
    found = []
    without = []
    for name in parts.metrics or results.columns.raw_metrics:
        try:
            found.append(sensitivity.sobol_indices(results.columns, results.layout, name))
        except UsageError as error:
            if parts.metrics:
                raise
            without.append(str(error))
    if without and not found:
        raise UsageError("; ".join(without))
    if parts.as_json:
        print_json({indices.metric: indices.to_dict() for indices in found})
        return
    for indices in found:
        _print_indices(indices, results.with_unit(indices.metric))
    for text in without:
        print_line(text, error=True)


def _print_indices(indices: sensitivity.SobolIndices, name: str) -> None:
    first, total = indices.first_order, indices.total_order
    rows = []
    for k in np.argsort(-total, kind="stable"):
        ends = ["", ""]
        if indices.has_intervals:
            pair = (indices.first_intervals[k], indices.total_intervals[k])
            ends = [f"{lower:.3f} to {upper:.3f}" for lower, upper in pair]
        rows.append((indices.parameters[k], f"{first[k]:.3f}", ends[0], f"{total[k]:.3f}", ends[1]))
    rows.append(("sum", f"{first.sum():.3f}", "", f"{total.sum():.3f}", ""))
    heads = ("", "first order", "95 % interval", "total order", "95 % interval")
    _print_rows(f"Sobol indices of {name}", heads, rows)
    basis = "rough (bootstrap)" if indices.has_intervals else "none (too few)"
    print_line(f"of {count_text(indices.base_points, 'base point')}; 95 % intervals: {basis}")
    if indices.remark:
        print_line(indices.remark)
    omitted = indices.omitted.tolist()
    if omitted:
        print_line(
            f"omitted: {count_text(len(omitted), 'base point')} with a member that failed, has no "
            f"value or is missing: {_members_text(omitted)}; the indices are biased if this "
            "depends on the parameters"
        )


def _show_member(
    row: dict[str, Any], results: StudyResults, command: str, *, as_json: bool
) -> None:
    """Print all that is recorded of a member, and the command that runs it alone."""
    if as_json:
        print_json({**row, "command": command})
        return
    reason = f": {row['reason']}" if row["reason"] else ""
    print_line(f"member {row['member']}: {row['status']}{reason}")
    keys = (*results.columns.parameters, *results.layout.noise_seeds)
    sections: dict[str, dict[str, Any]] = {"parameters": {}, "metrics": {}, "run": {}}
    for name, value in row.items():
        shown = results.with_unit(name)
        if name in keys:
            sections["parameters"][shown] = "the scenario's own value" if value is None else value
        elif name in results.columns.raw_metrics:
            sections["metrics"][shown] = "no value" if value is None else value
        elif name not in ("member", "status", "reason", "designs") and value not in (None, ""):
            sections["run"][shown] = shortened(str(value))
    for title, values in sections.items():
        print_section(title, values)
    print_line(f"alone: {command}")


def _show_search(
    results: StudyResults, search: Search, command_of: CommandOf, parts: ShownParts
) -> None:
    """Print the best members of a search."""
    columns = results.columns
    best = statistics.extremes(columns, search.metric, parts.worst, largest=search.maximize)
    shown = []
    for number, objective in best.items():
        (row,) = columns.rows_of(np.array([number])).tolist()
        values = {key: column.tolist()[row] for key, column in columns.parameters.items()}
        found: Figures = {"member": number, "objective": objective, "values": values}
        shown.append({**found, "command": command_of(number)})
    if parts.as_json:
        print_json({**_outcome(results, command_of), "search": asdict(search), "best": shown})
        return
    done = f"{count_text(results.done)} of at most {results.planned}, {_failed_text(results)}"
    print_line(f"{results.name}: {search.method}, {search.goal}; {done}")
    _print_wall_time(results)
    keys = [key for key in columns.parameters if key != RECORDING]  # one of all
    rows = []
    for one in shown:
        cells = [_number_text(one["values"][key]) for key in keys]
        rows.append((str(one["member"]), _number_text(one["objective"]), *cells))
    _print_rows("best members", ("member", search.metric, *keys), rows)
    if not rows and results.done > results.failed:
        print_line(f"{search.metric}: no member has a finite value")
    _print_failures(results, command_of)
    if best:
        _print_command(next(iter(best)), command_of)


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


def print_verification(found: StudyVerification, *, as_json: bool = False) -> None:
    """Print what came of running members again, and what that does not show."""
    if as_json:
        print_json(found.to_dict())
        return
    count = len(found.members)
    numbers = listing([str(number) for number in found.members], 10)
    rerun = "rerun, each built from scratch in its own process"
    print_line(f"{found.name}: {count} of {count_text(found.done)} {rerun}: {numbers}")
    for item in found.differences:
        print_line(f"member {item.member}: {item.name} was {item.recorded!r}, is {item.now!r}")
    differing = len({item.member for item in found.differences})
    if differing:
        differ = "differs" if differing == 1 else "differ"
        print_line(f"{differing} of {count_text(count)} {differ} from the record")
    else:
        print_line(f"identical bit for bit: {listing(found.values, 10)}")
    elsewhere = "results on other machines"
    if found.elsewhere:
        machines = listing(found.elsewhere, 3)
        elsewhere = (
            f"results on the original machine ({machines}): libraries of this one may round "
            "differently"
        )
    others = found.done - count
    not_shown = [f"{count_text(others)} not rerun"] if others else []
    not_shown += [elsewhere, "signals without a metric"]
    if found.is_searched:
        not_shown.append("whether the search would choose these members again")
    not_shown += [f"{name} was {old}, is {now}" for name, (old, now) in found.environment.items()]
    print_line(f"not verified: {'; '.join(not_shown)}")


def print_estimate(name: str, estimate: StudyEstimate, *, as_json: bool = False) -> None:
    """Print what a study will take."""
    if as_json:
        print_json({"name": name, **estimate.to_dict()})
        return
    entries = {
        "members": str(estimate.members),
        "first member of a worker": f"{estimate.first_time:.3g} s",
        "every other member": f"{estimate.member_time:.3g} s, as measured for one",
        f"total, on {estimate.workers} workers": _duration(estimate.study_time),
        "dataset": f"about {_bytes(estimate.dataset_bytes)}, before compression",
    }
    if estimate.log_bytes is None:
        entries["kept logs"] = "unknown (as many as fail)"
    elif estimate.log_bytes:
        entries["kept logs"] = _bytes(estimate.log_bytes)
    print_section(f"{name}: dry run, nothing was recorded", entries)


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
    decimals = 1 - exponent
    if -3 <= decimals <= 8 and abs(value) < 1e8:
        digits = max(decimals, 0)
        return f"{value:.{digits}f} ± {half_width:.{digits}f}"
    common = max(exponent, math.floor(math.log10(abs(value))) if value else exponent)
    decimals += common
    unit = 10.0**common
    return f"({value / unit:.{decimals}f} ± {half_width / unit:.{decimals}f})e{common:+03d}"


def interval_text(interval: ConfidenceInterval) -> str:
    """Return an interval in words; which end it has not."""
    lower, upper = interval
    if lower is None:
        return "" if upper is None else f"to {upper:.4g}; too few members for the lower end"
    if upper is None:
        return f"from {lower:.4g}; too few members for the upper end"
    return f"{lower:.4g} to {upper:.4g}"


def _members_text(numbers: Sequence[int], count: int | None = None) -> str:
    """Return the first of so many members, and how many more there are."""
    more = (len(numbers) if count is None else count) - 5
    shown = ", ".join(map(str, numbers[:5]))
    return f"{shown}, and {more} more" if more > 0 else shown
