"""A picture with a panel for each metric of a study."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from cosim.arrays import Vector
from cosim.errors import UsageError
from cosim.report.plots.curves import shown_text
from cosim.report.plots.picture import LARGEST, Picture, PictureOptions
from cosim.studies.layout import MetricColumn, NumberColumn, StudyResults, count_text
from cosim.studies.plots.scales import Scale

MOST_PANELS: Final = 12
FAILED_COLOR: Final = "#D55E00"
FAILED: Final = "members that failed"
FAINT: Final = 0.25  # opacity of a band
MOST_MARKS: Final = 300  # of members that failed; more cannot be told apart, and hide others
_ABOVE: Final = 1.025  # of the height of a panel: above its frame, where no values are
_WIDTH: Final = 11.0  # cm of a panel
_HEIGHT: Final = 7.5


class MetricPanels:
    """A picture with a panel for each of some metrics.

    Parameters
    ----------
    results : StudyResults
    metrics : sequence of str
        Empty: those that have values, at most ``MOST_PANELS``.
    options : PictureOptions

    Raises
    ------
    UsageError
        If there is no matplotlib, no such metric, or nothing to show.
    """

    def __init__(
        self, results: StudyResults, metrics: Sequence[str], options: PictureOptions
    ) -> None:
        names = shown_metrics(results, metrics)
        self._results = results
        self._title = results.name
        if len(names) > MOST_PANELS:
            self._title += f": the first {MOST_PANELS} of {len(names)} metrics"
        self.columns: list[MetricColumn] = []
        for name in names[:MOST_PANELS]:
            self.columns.append(results.columns.metric(name))
        across = min(3, len(self.columns))
        down = -(-len(self.columns) // across)
        size = (_WIDTH * across, _HEIGHT * down)
        self._picture = sized_picture(len(self.columns), across, options, size=size)
        self.panels = self._picture.panels

    def label(self, panel: Any, column: MetricColumn, words: str = "{}") -> str:
        """Return words with the name of a metric and its unit.

        What the panel is of, and what is not shown in it, is written above it.
        """
        panel.set_title(without_text(column), fontsize="small", color="0.3")
        panel.set_axisbelow(True)  # its grid
        return words.format(shown_text(self._results.with_unit(column.name)))

    def legend(self, lines: Iterable[Any], *, title: str = "") -> None:
        """Show a legend of all panels below them; what several have is named once."""
        different = {line.get_label(): line for line in lines}
        if different:
            self._picture.legend(list(different.values()), below=True, title=title)

    def save(self, out: Path, what: str) -> None:
        """Write the picture to a file; its title is that of the study and ``what``."""
        self._picture.save(out, title=shown_text(f"{self._title}: {what}"))


def mark_failed(panel: Any, places: Vector, *, label: str = FAILED) -> list[Any]:
    """Mark above the frame of a panel where members failed: they have no value."""
    if not len(places):
        return []
    places = np.unique(places)
    places = places[spread_rows(len(places), MOST_MARKS)]
    marks: list[Any] = panel.plot(
        places,
        np.full(len(places), _ABOVE),
        "x",
        color=FAILED_COLOR,
        markersize=5.0,
        transform=panel.get_xaxis_transform(),
        clip_on=False,
        label=label,
    )
    panel.set_title(panel.get_title(), fontsize="small", color="0.3", pad=11.0)
    return marks


def spread_rows(count: int, most: int) -> NumberColumn:
    """Return which of so many rows are drawn: all, or as many as may be, spread over them."""
    return np.linspace(0, count - 1, min(count, most)).astype(np.int64)


def placed(results: StudyResults, keys: Sequence[str]) -> tuple[StudyResults, str]:
    """Return the members that have a place on the axes of keys, and which were left out."""
    kept = np.ones(results.done, np.bool_)
    notes = ""
    for key in keys:
        has_place = Scale.of(results.columns.parameters[key]).is_placed
        kept &= has_place
        if not has_place.all():
            count = int((~has_place).sum())
            notes += f"; {count_text(count)} without a finite {key}"
    if not notes:
        return results, ""
    return replace(results, columns=results.columns.only(kept)), notes


def sized_picture(
    count: int, columns: int, options: PictureOptions, *, size: tuple[float, float]
) -> Picture:
    """Return a picture of panels, of a size [cm] where the options have none."""
    width, height = size
    if options.size is None:
        options = replace(options, size=(min(width + 1.0, LARGEST), min(height + 2.0, LARGEST)))
    return Picture(count, options, columns=columns, shares_time=False)


def shown_metrics(results: StudyResults, metrics: Sequence[str]) -> list[str]:
    """Return the metrics that are named, or all that have values.

    Raises
    ------
    UsageError
        If one has none.
    """
    for name in metrics:
        column = results.columns.metric(name)
        if not len(column.values):
            raise UsageError(f"metric {name!r}: no member has a value, so there is nothing to show")
    if metrics:
        return list(metrics)
    found = [name for name, column in results.columns.metrics.items() if len(column.values)]
    if not found:
        raise UsageError("no metric of the study has a value, so there is nothing to show")
    return found


def without_text(column: MetricColumn) -> str:
    """Return what figures of a metric are of, and which members are not in them."""
    parts = [count_text(len(column.values))]
    for words, numbers in (
        ("failed", column.failed),
        ("without value", column.without_value),
        ("infinite", column.infinite),
    ):
        if len(numbers):
            parts.append(f"{len(numbers)} {words}")
    return ", ".join(parts)
