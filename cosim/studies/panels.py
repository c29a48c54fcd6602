"""What pictures of studies share: panels of metrics, scales of their axes, marks of failures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path, PurePath
from typing import Any, Final

import numpy as np

from cosim.arrays import Vector
from cosim.errors import UsageError
from cosim.report.plots.picture import (
    COLORS,
    LARGEST,
    LARGEST_DRAWN,
    Picture,
    PictureOptions,
    broken,
    shown_text,
)
from cosim.studies.layout import MetricColumn, StudyResults, VariedValues, count_text, numbers_of
from cosim.studies.search import Search

FAILED_COLOR: Final = "#D55E00"
FAILED: Final = "members that failed"
FAINT: Final = 0.25  # opacity of a band
NOTE: Final = {"fontsize": "small", "color": "0.3"}  # above a panel
_MOST_PANELS: Final = 12
_MOST_MARKS: Final = 300  # of members that failed; more cannot be told apart, and hide others
_LONGEST: Final = 18  # characters of a line of a name at an axis
_CROWDED: Final = 30  # characters of the names side by side at an axis, which do not overlap


@dataclass
class StudyPicture:
    """What a picture of a study shows, and the file it is written to.

    Parameters
    ----------
    results : StudyResults
    out : Path
    metrics, keys : sequence of str
        No metrics: all that have numbers.
    options : PictureOptions
    search : Search or None
        Which has chosen the members.
    note : str
        Behind the title.

    Attributes
    ----------
    columns : list of MetricColumn
        Of the metrics, which have values.

    Raises
    ------
    UsageError
        If a metric is not there, has no numbers, or too large ones.
    """

    results: StudyResults
    out: Path
    metrics: Sequence[str]
    keys: Sequence[str]
    options: PictureOptions
    search: Search | None = None
    note: str = ""

    def __post_init__(self) -> None:
        of_study = self.results.columns
        all_columns = [one for one in of_study.metrics.values() if len(one.values)]
        self.title = self.results.name
        self.columns = [of_study.metric(name) for name in self.metrics] or all_columns
        empty = [repr(one.name) for one in self.columns if not len(one.values)]
        if empty or not self.columns:
            needed = ", ".join(empty) or "any metric"
            raise UsageError(f"no member has a value of {needed}, so there is nothing to show")
        for one in self.columns:
            largest = float(np.abs(one.values).max())
            if largest > LARGEST_DRAWN:
                needed = f"expected at most {LARGEST_DRAWN:g}"
                raise UsageError(f"{one.name}: {largest:g} is too large to be drawn; {needed}")

    def panels(self, count: int, across: int, size: tuple[float, float]) -> list[Any]:
        """Return panels, by default each of a size [cm]."""
        options = self.options
        if options.size is None:
            width, height = size[0] * across + 1.0, size[1] * -(-count // across) + 2.0
            options = replace(options, size=(min(width, LARGEST), min(height, LARGEST)))
        self._picture = Picture(count, options, columns=across, shares_time=False)
        for panel in self._picture.panels:
            panel.set_axisbelow(True)  # its grid
        return self._picture.panels

    def each(
        self, across: int = 3, size: tuple[float, float] = (11.0, 7.5)
    ) -> Iterator[tuple[Any, MetricColumn, str]]:
        """Yield a panel for each metric, with the metric and its label."""
        columns = self.columns[:_MOST_PANELS]
        if len(columns) < len(self.columns):
            self.title += f": the first {_MOST_PANELS} of {len(self.columns)} metrics"
        panels = self.panels(len(columns), min(across, len(columns)), size)
        for panel, column in zip(panels, columns, strict=True):
            counts = {
                "failed": len(column.failed),
                "without value": len(column.without_value),
                "infinite": len(column.infinite),
            }
            others = [f", {count} {words}" for words, count in counts.items() if count]
            panel.set_title(count_text(len(column.values)) + "".join(others), **NOTE)
            yield panel, column, self.label(column.name)

    def label(self, name: str) -> str:
        """Return what an axis says of a key, or a metric: its name with its unit."""
        return shown_text(self.results.with_unit(name))

    def save(self, what: str, *, legend: str = "") -> None:
        """Write the picture, with a legend of all that has a label, each once."""
        labelled: dict[str, Any] = {}
        for panel in self._picture.panels:
            for handle in panel.get_legend_handles_labels()[0]:
                labelled.setdefault(handle.get_label(), handle)
        if labelled:
            self._picture.legend(list(labelled.values()), below=True, title=legend)
        self._picture.save(self.out, title=shown_text(f"{self.title}: {what}{self.note}"))


@dataclass(frozen=True)
class Scale:
    """Where values stand at an axis; NaN and infinite ones nowhere.

    Parameters
    ----------
    positions : Vector, shape (N,)
    names : tuple of str
        Of values that are no numbers, at 0, 1, ...
    """

    positions: Vector
    names: tuple[str, ...] = ()

    @classmethod
    def of(cls, values: VariedValues) -> Scale:
        """Return the scale of a parameter: of paths the last part, if these differ."""
        numbers = numbers_of(values)
        if numbers is not None:
            return cls(numbers)
        texts = [str(value) for value in values.tolist()]
        names = list(dict.fromkeys(texts))
        positions = np.array([names.index(text) for text in texts], np.float64)
        short = [PurePath(name).name or name for name in names]
        shown = short if len(set(short)) == len(names) else names
        return cls(positions, tuple(broken(shown_text(name), _LONGEST) for name in shown))

    @cached_property
    def logarithmic(self) -> bool:
        """Whether its axis is."""
        return not self.names and is_logarithmic(self.positions)

    def show(self, axis: Any, label: str) -> None:
        """Give the scale, its names and a label to an axis."""
        axis.set_label_text(label)
        direction = axis.axis_name
        if self.logarithmic:
            axis.axes.set(**{f"{direction}scale": "log"})
        if self.names:
            is_crowded = direction == "x" and len("".join(self.names)) > _CROWDED
            turned = {"rotation": 20.0, "horizontalalignment": "right"} if is_crowded else {}
            axis.set_ticks(range(len(self.names)), labels=self.names, **turned)
            axis.axes.set(**{f"{direction}lim": (-0.5, len(self.names) - 0.5)})

    def edges(self, most: int, even: int) -> Vector:
        """Return edges halfway between values; of more than ``most`` numbers those of even cells.

        There is a value that is finite.
        """
        values = self.positions[np.isfinite(self.positions)]
        low, high = values.min(), values.max()
        places = np.unique(np.log(values) if self.logarithmic else values)
        if len(places) == 1:
            reach = 0.05 * abs(low) or 0.5
            return np.array([low - reach, low + reach])
        if len(places) > most and not self.names:
            spaced = np.geomspace if self.logarithmic else np.linspace
            return np.asarray(spaced(low, high, even + 1), np.float64)  # its ends are exact
        middles = 0.5 * (places[1:] + places[:-1])
        edges = np.array([2.0 * places[0] - middles[0], *middles, 2.0 * places[-1] - middles[-1]])
        return np.exp(edges) if self.logarithmic else edges

    def draw_histogram(self, panel: Any) -> None:
        """Draw how many values are where."""
        values = self.positions[np.isfinite(self.positions)]
        if len(values):
            even = min(max(int(len(values) ** 0.5), 5), 40)
            edges = self.edges(min(len(values) // 3, 20), even)
            panel.hist(values, bins=edges, color=COLORS[5], edgecolor="white", linewidth=0.3)


def is_logarithmic(values: Vector) -> bool:
    """Return whether nine of ten values are over a factor of 10, and more even by factors."""
    finite = values[np.isfinite(values)]
    if not len(finite) or finite.min() <= 0.0:
        return False
    low, middle, high = np.quantile(finite, [0.05, 0.5, 0.95])
    if high <= 10.0 * low:
        return False
    linear = (middle - low) / (high - low) - 0.5
    logarithmic = np.log(middle / low) / np.log(high / low) - 0.5
    return bool(abs(logarithmic) < abs(linear))


def mark_failed(panel: Any, x: Vector, y: Vector | None = None, *, label: str = FAILED) -> None:
    """Mark members that failed, if any; without ``y`` above the frame, where no values are."""
    if not len(x):
        return
    above: dict[str, Any] = {}
    if y is None:
        y = np.full(len(x), 1.025)
        above = {"transform": panel.get_xaxis_transform(), "clip_on": False}
        panel.set_title(panel.get_title(), pad=11.0, **NOTE)
    points = np.unique(np.stack([x, y]), axis=1)
    count = points.shape[1]
    if count > _MOST_MARKS:
        label = f"{_MOST_MARKS} of the {count} {label}"
        points = points[:, np.linspace(0, count - 1, _MOST_MARKS).astype(np.int64)]
    panel.plot(*points, "x", color=FAILED_COLOR, markersize=5.0, label=label, **above)
