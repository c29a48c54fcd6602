"""Axes: numbers, logarithmic where values are spread so, and names."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any, Final

import numpy as np

from cosim.arrays import Mask, Vector
from cosim.errors import UsageError
from cosim.report.plots.curves import LARGEST_DRAWN, shown_text
from cosim.studies.layout import VariedValues, numbers_of

_SPREAD: Final = 30.0  # of nine of ten values, from which on an axis is logarithmic
_DECADE: Final = 5.0  # of nine of ten values of a key, from which on its axis may be logarithmic
_CENTERED: Final = 0.5  # how much nearer to the middle their median has to be on that axis
_SAME: Final = 1e-6  # of steps that are one, in relation to it
_LONGEST: Final = 18  # characters of a name at an axis
_POWERS: Final = (-4, 5)  # of ten, beyond which an axis names it once
_TICKS: Final = 4  # intervals of a horizontal axis, at most
_CROWDED: Final = 30  # characters of the names side by side at an axis, which do not overlap


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
            logarithmic = is_logarithmic(numbers) or is_even_in_logarithms(numbers)
            return cls(numbers, logarithmic=logarithmic)
        texts = [str(value) for value in values.tolist()]
        names = list(dict.fromkeys(texts))
        places = {name: float(place) for place, name in enumerate(names)}
        positions = np.array([places[text] for text in texts])
        return cls(positions, tuple(short_names(names)))

    @property
    def is_placed(self) -> Mask:
        """Whether a value has a place: it is there, and finite."""
        return np.isfinite(self.positions)

    def label(self, axis: Any, name: str) -> None:
        """Write the name of the values, and those of positions, at an axis of a panel."""
        axis.set_label_text(shown_text(name))
        if not self.names:
            return
        shown = [shown_text(one) for one in self.names]
        is_crowded = axis.axis_name == "x" and sum(map(len, shown)) > _CROWDED
        turned = {"rotation": 20.0, "horizontalalignment": "right"} if is_crowded else {}
        axis.set_ticks(range(len(shown)), labels=shown, **turned)
        axis.axes.set(**{f"{axis.axis_name}lim": (-0.5, len(shown) - 0.5)})

    def apply(self, panel: Any, direction: str) -> None:
        """Make the ``x`` or ``y`` axis of a panel logarithmic, if this is."""
        if self.logarithmic:
            getattr(panel, f"set_{direction}scale")("log")
        elif not self.names and direction == "y":
            panel.ticklabel_format(axis=direction, scilimits=_POWERS)
        elif not self.names:  # a power of ten would stand on the name of the axis
            panel.xaxis.get_major_locator().set_params(nbins=_TICKS)


def short_names(names: Sequence[str]) -> list[str]:
    """Return names that fit an axis, and differ: of paths the last part if these do."""
    last = [PurePath(name).name or name for name in names]
    shown = last if len(set(last)) == len(names) else list(names)
    for head in (0, _LONGEST // 2):
        cut = [_cut(name, head) for name in shown]
        if len(set(cut)) == len(names):
            return cut
    return shown


def _cut(name: str, head: int) -> str:
    """Return a name, of a long one so many first characters, and last ones."""
    if len(name) <= _LONGEST:
        return name
    return f"{name[:head]}...{name[head + 3 - _LONGEST :]}"


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


def reach_beside(value: float) -> float:
    """Return how far an axis reaches on both sides of a value that is the only one."""
    return 0.05 * abs(value) or 0.5


def zero_width(values: Vector) -> float | None:
    """Return how far from zero an axis should be linear, so that small values of both signs show.

    None: it may be linear everywhere, as nine of ten values that are not zero are within a factor
    of 900.
    """
    sizes = np.abs(values[np.isfinite(values) & (values != 0.0)])
    if len(sizes) < 3:
        return None
    low, high = np.quantile(sizes, [0.05, 0.95])
    return float(low) if high > _SPREAD**2 * low else None


def is_even_in_logarithms(values: Vector) -> bool:
    """Return whether values that someone chose were chosen by factors, such as 10, 30 and 100.

    Their median is then in the middle of a logarithmic axis, and not in that of a linear one.
    """
    different = np.unique(values[np.isfinite(values)])
    if len(different) < 3 or different[0] <= 0.0:
        return False
    low, middle, high = np.quantile(different, [0.05, 0.5, 0.95])
    if high < _DECADE * low:
        return False
    linear = (middle - low) / (high - low) - 0.5
    logarithmic = np.log(middle / low) / np.log(high / low) - 0.5
    return bool(abs(logarithmic) < _CENTERED * abs(linear))


def check_drawable(name: str, values: Vector) -> None:
    """Raise UsageError if a value is too large for an axis."""
    largest = float(np.abs(values).max(initial=0.0))
    if largest > LARGEST_DRAWN:
        raise UsageError(
            f"{name}: {largest:g} is too large to be drawn; expected at most {LARGEST_DRAWN:g}"
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
