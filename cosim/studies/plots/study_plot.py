"""The kinds of pictures of a study."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from cosim.errors import UsageError, nearest, quoted
from cosim.report.plots.picture import PictureOptions, need_plot
from cosim.studies.layout import StudyResults, drawn_members
from cosim.studies.plan import RecordedSearch
from cosim.studies.plots.convergence import plot_convergence
from cosim.studies.plots.distributions import plot_distributions, plot_histograms
from cosim.studies.plots.heat_map import plot_heat_maps
from cosim.studies.plots.over_key import plot_over_key
from cosim.studies.plots.scatter import plot_scatter
from cosim.studies.plots.search_history import plot_search
from cosim.studies.plots.sensitivity import plot_sobol

KINDS: Final = {
    "histogram": "how the values of metrics are distributed, with mean and quantiles",
    "distribution": "the share of members below each value",
    "convergence": "the mean of metrics over the number of members, with its interval",
    "line": "metrics over one varied key",
    "map": "metrics over two varied keys",
    "scatter": "every parameter and metric over every other one",
    "sobol": "Sobol indices, of a Saltelli design",
    "search": "the objective of each member of a tuning, and the best one so far",
}
_STANDARD = PictureOptions()


def plot_study(
    results: StudyResults,
    out: Path,
    *,
    kind: str | None = None,
    metrics: Sequence[str] = (),
    keys: Sequence[str] = (),
    options: PictureOptions = _STANDARD,
    search: RecordedSearch | None = None,
) -> None:
    """Draw a picture of a study.

    Parameters
    ----------
    results : StudyResults
    out : Path
    kind : str, optional
        One of ``KINDS``; None: ``search`` of a tuning, unless other metrics or keys are named;
        ``line`` or ``map`` of a grid, ``sobol`` of a Saltelli design, else ``histogram``.
    metrics : sequence of str
        Empty: all that have values; ``search`` shows the objective alone.
    keys : sequence of str
        What is varied: the one or two of ``line`` and ``map``, those of ``scatter``; ``search``
        has none. Empty: the first ones with several values.
    options : PictureOptions
        Their times have no meaning here.
    search : RecordedSearch, optional
        That chose the members.

    Raises
    ------
    UsageError
        If there is no matplotlib, the format of ``out`` is unknown, there is no such kind, metric,
        key or search, or there is nothing to show.
    """
    need_plot(out)
    drawn = replace(results, columns=drawn_members(results.columns, results.layout))
    if kind is not None and kind not in KINDS:
        raise UsageError(f"no plot kind {kind!r}; {nearest(kind, KINDS)}")
    varied = _varied(results)
    _check_known(keys, results, varied)
    if kind is None and search is not None and not keys and set(metrics) <= {search.metric}:
        kind = "search"
    chosen = kind or _standard_kind(results, list(keys) or varied)
    shown = list(keys) or varied
    match chosen:
        case "histogram":
            plot_histograms(drawn, out, metrics, options)
        case "distribution":
            plot_distributions(drawn, out, metrics, options)
        case "convergence":
            plot_convergence(drawn, out, metrics, options)
        case "line":
            _check_count(chosen, shown, 1)
            plot_over_key(drawn, out, metrics, shown[:2], options)
        case "map":
            _check_count(chosen, shown, 2)
            plot_heat_maps(drawn, out, metrics, shown[:2], options)
        case "scatter":
            plot_scatter(drawn, out, metrics, shown, options)
        case "sobol":
            plot_sobol(results, out, metrics, options)
        case _:
            plot_search(results, out, options, search=_checked_search(search, metrics, keys))


def _checked_search(
    search: RecordedSearch | None, metrics: Sequence[str], keys: Sequence[str]
) -> RecordedSearch:
    """Return the search that is drawn; it has one metric, and shows no key.

    Raises
    ------
    UsageError
        If there is none, or another metric or a key is named.
    """
    if search is None:
        raise UsageError(
            "plot kind 'search': expected a study whose members were chosen by a search, such as "
            "a tuning, got a planned one"
        )
    if keys:
        raise UsageError(
            f"plot kind 'search': expected no key, got {quoted(keys[0])}; kind 'scatter' shows "
            "what was varied"
        )
    for name in metrics:
        if name != search.metric:
            raise UsageError(
                f"plot kind 'search': expected the objective {quoted(search.metric)}, got the "
                f"metric {quoted(name)}; other kinds show other metrics"
            )
    return search


def _varied(results: StudyResults) -> list[str]:
    """Return the keys that have several values among the members that are done."""
    found = []
    for key, values in results.columns.parameters.items():
        different = set(map(str, values.tolist())) if values.dtype == object else np.unique(values)
        if len(different) > 1:
            found.append(key)
    return found


def _standard_kind(results: StudyResults, keys: Sequence[str]) -> str:
    kind = results.layout.kind
    if kind == "saltelli":
        return "sobol"
    if kind == "grid" and keys:
        return "line" if len(keys) == 1 else "map"
    return "histogram"


def _check_known(keys: Sequence[str], results: StudyResults, varied: Sequence[str]) -> None:
    for key in keys:
        if key not in results.columns.parameters:
            raise UsageError(f"the study does not vary {key!r}; {nearest(key, varied)}")


def _check_count(kind: str, keys: Sequence[str], count: int) -> None:
    if len(keys) < count:
        found = f"{len(keys)} varied key{'' if len(keys) == 1 else 's'}"
        raise UsageError(f"plot kind {kind!r}: expected {count} with several values, got {found}")
