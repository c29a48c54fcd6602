"""Axes: numbers, logarithmic where values are spread so, and names."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePath
from textwrap import fill
from typing import Any, Final

import numpy as np

from cosim.arrays import Mask, Vector
from cosim.errors import UsageError
from cosim.report.plots.curves import LARGEST_DRAWN, shown_text
from cosim.studies.analysis.columns import VariedValues, numbers_of

_SPREAD: Final = 30.0  # of nine of ten values, from which on an axis is logarithmic
_SAME: Final = 1e-6  # of steps that are one, in relation to it
LABEL: Final = 36  # characters of a line beside an axis
_LONGEST: Final = 18  # characters of a name at an axis


@dataclass(frozen=True)
class Scale:
    """Where values stand on an axis.

    Parameters
    ----------
    positions : Vector, shape (N,)
        The values, or the number of their name.
    names : tuple of str
        Of positions 0, 1, ...; empty: the values are numbers.
    logarithmic : bool
    """

    positions: Vector
    names: tuple[str, ...] = ()
    logarithmic: bool = False

    @classmethod
    def of(cls, values: VariedValues) -> Scale:
        """Return the scale of the values of a parameter."""
        numbers = numbers_of(values)
        if numbers is not None:
            return cls(numbers, logarithmic=is_logarithmic(numbers))
        texts = [str(value) for value in values.tolist()]
        names = list(dict.fromkeys(texts))
        places = {name: float(place) for place, name in enumerate(names)}
        positions = np.array([places[text] for text in texts])
        return cls(positions, tuple(short_names(names)))

    @property
    def is_placed(self) -> Mask:
        """Whether a value has a place: it is there, and finite."""
        return np.isfinite(self.positions)

    def label(self, axis: Any, name: str, *, width: int = LABEL) -> None:
        """Write the name of the values, and those of positions, at an axis of a panel."""
        axis.set_label_text(fill(shown_text(name), width))
        if self.names:
            axis.set_ticks(range(len(self.names)), labels=[shown_text(n) for n in self.names])
            axis.axes.set(**{f"{axis.axis_name}lim": (-0.5, len(self.names) - 0.5)})

    def apply(self, panel: Any, direction: str) -> None:
        """Make the ``x`` or ``y`` axis of a panel logarithmic, if this is."""
        if self.logarithmic:
            getattr(panel, f"set_{direction}scale")("log")


def short_names(names: Sequence[str]) -> list[str]:
    """Return names that fit an axis: of paths the last part, where these differ."""
    last = [PurePath(name).name or name for name in names]
    shown = last if len(set(last)) == len(names) else list(names)
    return [name if len(name) <= _LONGEST else f"...{name[3 - _LONGEST :]}" for name in shown]


def is_logarithmic(values: Vector) -> bool:
    """Return whether values are better shown on a logarithmic axis.

    Those with a constant factor between them, and positive ones of which nine of ten are spread
    over a factor of 30.
    """
    finite = values[np.isfinite(values)]
    if len(finite) < 3 or finite.min() <= 0.0:
        return False
    different = np.unique(finite)
    if len(different) < 3:
        return False
    factors = np.diff(np.log(different))
    if np.ptp(factors) <= _SAME * factors.max():
        steps = np.diff(different)
        return bool(np.ptp(steps) > _SAME * steps.max())
    low, high = np.quantile(finite, [0.05, 0.95])
    return bool(high > _SPREAD * low)


def check_drawable(name: str, values: Vector) -> None:
    """Raise UsageError if a value is too large for an axis."""
    largest = float(np.abs(values).max(initial=0.0))
    if largest > LARGEST_DRAWN:
        raise UsageError(
            f"{name}: found {largest:g}, too large to be drawn; needed at most {LARGEST_DRAWN:g}"
        )


def cell_edges(centers: Vector, *, logarithmic: bool) -> Vector:
    """Return the edges of cells around ascending centers, halfway between them."""
    places = np.log(centers) if logarithmic else centers
    if len(places) == 1:
        edges = places[0] + np.array([-0.5, 0.5])
    else:
        middles = 0.5 * (places[1:] + places[:-1])
        first = places[0] - (middles[0] - places[0])
        last = places[-1] + (places[-1] - middles[-1])
        edges = np.concatenate([[first], middles, [last]])
    found: Vector = np.exp(edges) if logarithmic else edges
    return found


def even_edges(values: Vector, count: int, *, logarithmic: bool) -> Vector:
    """Return the edges of cells of one width, or one factor, that hold all values."""
    low = float(values.min())
    high = float(values.max())
    if low == high:
        return cell_edges(np.array([low]), logarithmic=logarithmic)
    if logarithmic:
        edges: Vector = np.geomspace(low, high, count + 1)  # its ends are exact
        return edges
    return np.linspace(low, high, count + 1)
