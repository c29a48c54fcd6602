"""What pictures of studies share: panels of metrics, scales of their axes, marks of failures."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePath
from typing import Any, Final

import numpy as np

from cosim.arrays import Vector
from cosim.errors import UsageError
from cosim.report.plots.curves import LARGEST_DRAWN, shown_text
from cosim.report.plots.fitting import broken
from cosim.report.plots.picture import LARGEST, Picture, PictureOptions
from cosim.studies.layout import MetricColumn, StudyResults, VariedValues, count_text, numbers_of
from cosim.studies.search import Search

MOST_PANELS: Final = 12
FAILED_COLOR: Final = "#D55E00"
FAILED: Final = "members that failed"
FAINT: Final = 0.25  # opacity of a band
NOTE: Final = {"fontsize": "small", "color": "0.3"}  # above a panel
_MOST_MARKS: Final = 300  # of members that failed; more cannot be told apart, and hide others
_ABOVE: Final = 1.025  # of the height of a panel: above its frame, where no values are
_SPREAD: Final = 30.0  # of nine of ten values, from which on an axis is logarithmic
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
        columns = self.results.columns
        self.title = self.results.name
        self.columns = [columns.metric(name) for name in self.metrics]
        for one in self.columns:
            if not len(one.values):
                raise UsageError(
                    f"metric {one.name!r}: no member has a value, so there is nothing to show"
                )
        self.columns = self.columns or [one for one in columns.metrics.values() if len(one.values)]
        if not self.columns:
            raise UsageError("no metric of the study has a value, so there is nothing to show")
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

    def __iter__(self) -> Iterator[tuple[Any, MetricColumn, str]]:
        """Yield a panel for each metric, with the metric and its label."""
        columns = self.columns[:MOST_PANELS]
        if len(columns) < len(self.columns):
            self.title += f": the first {MOST_PANELS} of {len(self.columns)} metrics"
        panels = self.panels(len(columns), min(3, len(columns)), (11.0, 7.5))
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

    def save(self, what: str, lines: Iterable[Any] = (), *, legend: str = "") -> None:
        """Write the picture, with a legend of the lines that differ."""
        different = {line.get_label(): line for line in lines}
        if different:
            self._picture.legend(list(different.values()), below=True, title=legend)
        self._picture.save(self.out, title=shown_text(f"{self.title}: {what}{self.note}"))


@dataclass(frozen=True)
class Scale:
    """Where values stand at an axis; NaN and infinite ones nowhere.

    Parameters
    ----------
    positions : Vector, shape (N,)
    names : tuple of str
        Of values that are no numbers, at 0, 1, ...
    logarithmic : bool
    """

    positions: Vector
    names: tuple[str, ...] = ()
    logarithmic: bool = False

    @classmethod
    def of(cls, values: VariedValues) -> Scale:
        """Return the scale of a parameter: of paths the last part, if these differ."""
        numbers = numbers_of(values)
        if numbers is not None:
            return cls(numbers, logarithmic=is_logarithmic(numbers, of_key=True))
        texts = [str(value) for value in values.tolist()]
        names = list(dict.fromkeys(texts))
        positions = np.array([names.index(text) for text in texts], np.float64)
        short = [PurePath(name).name or name for name in names]
        shown = short if len(set(short)) == len(names) else names
        return cls(positions, tuple(broken(shown_text(name), _LONGEST) for name in shown))

    def show(self, axis: Any, label: str) -> None:
        """Give the scale, its names and a label to an axis."""
        axis.set_label_text(label)
        direction = axis.axis_name
        if self.logarithmic:
            axis.axes.set(**{f"{direction}scale": "log"})
        if self.names:
            widths = [max(map(len, name.split("\n"))) for name in self.names]
            is_crowded = direction == "x" and sum(widths) > _CROWDED
            turned = {"rotation": 20.0, "horizontalalignment": "right"} if is_crowded else {}
            axis.set_ticks(range(len(self.names)), labels=self.names, **turned)
            axis.axes.set(**{f"{direction}lim": (-0.5, len(self.names) - 0.5)})


def is_logarithmic(values: Vector, *, of_key: bool = False) -> bool:
    """Return whether values are spread so widely that their axis is logarithmic.

    Nine of ten over a factor of 30; those of a key over a factor of 5, if they are more even so.
    """
    finite = values[np.isfinite(values)]
    different = np.unique(finite)
    if len(different) < 3 or different[0] <= 0.0:
        return False
    low, high = np.quantile(finite, [0.05, 0.95])
    if high > _SPREAD * low or not of_key:
        return bool(high > _SPREAD * low)
    low, middle, high = np.quantile(different, [0.05, 0.5, 0.95])
    linear = (middle - low) / (high - low) - 0.5
    logarithmic = np.log(middle / low) / np.log(high / low) - 0.5
    return bool(high >= 5.0 * low and abs(logarithmic) < 0.5 * abs(linear))


def cell_edges(scale: Scale, values: Vector, most: int, even: int) -> Vector:
    """Return edges halfway between values; of more than ``most`` numbers those of even cells."""
    low, high = float(values.min()), float(values.max())
    places = np.unique(np.log(values) if scale.logarithmic else values)
    if len(places) == 1:
        return np.array([low - reach_beside(low), low + reach_beside(low)])
    if len(places) > most and not scale.names:
        spaced = np.geomspace if scale.logarithmic else np.linspace
        return np.asarray(spaced(low, high, even + 1), np.float64)  # its ends are exact
    middles = 0.5 * (places[1:] + places[:-1])
    edges = np.array([2.0 * places[0] - middles[0], *middles, 2.0 * places[-1] - middles[-1]])
    return np.exp(edges) if scale.logarithmic else edges


def reach_beside(value: float) -> float:
    """Return how far an axis reaches beyond the only value that it shows."""
    return 0.05 * abs(value) or 0.5


def mark_failed(
    panel: Any, x: Vector, y: Vector | None = None, *, label: str = FAILED
) -> list[Any]:
    """Mark members that failed; without ``y`` above the frame. Return the marks, if any."""
    if not len(x):
        return []
    above: dict[str, Any] = {}
    if y is None:
        y = np.full(len(x), _ABOVE)
        above = {"transform": panel.get_xaxis_transform(), "clip_on": False}
        panel.set_title(panel.get_title(), pad=11.0, **NOTE)
    points = np.unique(np.stack([x, y]), axis=1)
    count = points.shape[1]
    if count > _MOST_MARKS:
        label = f"{_MOST_MARKS} of the {count} {label}"
    shown = points[:, spread_rows(count, _MOST_MARKS)]
    marks: list[Any] = panel.plot(
        *shown, "x", color=FAILED_COLOR, markersize=5.0, label=label, **above
    )
    return marks


def spread_rows(count: int, most: int) -> Any:
    """Return at most so many rows from the first to the last one."""
    return np.linspace(0, count - 1, min(count, most)).astype(np.int64)


def placed(results: StudyResults, keys: Sequence[str]) -> tuple[StudyResults, str]:
    """Return the members whose keys have a place at an axis, and a note of the others."""
    kept = np.ones(results.done, np.bool_)
    note = ""
    for key in keys:
        has_place = np.isfinite(Scale.of(results.columns.parameters[key]).positions)
        kept &= has_place
        if not has_place.all():
            note += f"; {count_text(int((~has_place).sum()))} without a finite {key}"
    return replace(results, columns=results.columns.only(kept)), note
