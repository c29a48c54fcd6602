"""What a tuning varies: keys between bounds, and keys with a list of values.

A search sees coordinates from 0 to 1, in the logarithm of the values where the key has it. A value
is rounded to 12 significant digits: it is short in a command, and a search that runs again on
another machine, whose linear algebra differs in the last bit, asks for the same one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from cosim.arrays import Vector
from cosim.errors import UsageError, option, quoted
from cosim.studies.tuning.points import value_name

DIGITS: Final = 12


@dataclass(frozen=True, slots=True)
class BoundedKey:
    """A key with a number between two bounds.

    Parameters
    ----------
    key : str
        Dotted.
    lower, upper : float
        The bounds; they belong to it.
    logarithmic : bool
        Searched in the logarithm of the value.
    """

    key: str
    lower: float
    upper: float
    logarithmic: bool = False

    def value(self, coordinate: float) -> float:
        """Return the value at a coordinate from 0 to 1."""
        if coordinate <= 0.0:
            return self.lower
        if coordinate >= 1.0:
            return self.upper
        if self.logarithmic:
            low, high = self._logarithms
            value = math.exp(low + coordinate * (high - low))
        else:  # without the difference of the bounds, which may overflow
            value = (1.0 - coordinate) * self.lower + coordinate * self.upper
        return min(max(float(f"{value:.{DIGITS}g}"), self.lower), self.upper)

    def coordinate(self, value: float) -> float:
        """Return the coordinate of a value between the bounds."""
        if self.logarithmic:
            low, high = self._logarithms
            return (math.log(value) - low) / (high - low)
        half_lower = 0.5 * self.lower  # the difference of the bounds may overflow
        half_width = 0.5 * self.upper - half_lower
        return (0.5 * value - half_lower) / half_width

    def slope(self, value: float) -> float:
        """Return the derivative of the value with respect to its coordinate."""
        if self.logarithmic:
            low, high = self._logarithms
            return value * (high - low)
        return self.upper - self.lower

    @property
    def _logarithms(self) -> tuple[float, float]:
        """Those of the bounds."""
        return math.log(self.lower), math.log(self.upper)


@dataclass(frozen=True, slots=True)
class ChoiceKey:
    """A key with one of several values, or a swapped component with one of several models.

    Parameters
    ----------
    key : str
        Dotted; of a swap the name of the component.
    choices : tuple
    """

    key: str
    choices: tuple[Any, ...]


@dataclass(frozen=True, slots=True)
class SearchSpace:
    """All that is varied, in the order in which it was given.

    Parameters
    ----------
    keys : tuple of BoundedKey or ChoiceKey
    """

    keys: tuple[BoundedKey | ChoiceKey, ...]

    @property
    def bounded(self) -> tuple[BoundedKey, ...]:
        """The keys between bounds."""
        return tuple(key for key in self.keys if isinstance(key, BoundedKey))

    @property
    def choices(self) -> tuple[ChoiceKey, ...]:
        """The keys with a list of values."""
        return tuple(key for key in self.keys if isinstance(key, ChoiceKey))

    def point(self, coordinates: Sequence[float] | Vector) -> dict[str, Any]:
        """Return the values at coordinates, shape (n,), of keys that all have bounds."""
        pairs = zip(self.bounded, coordinates, strict=True)
        return {key.key: key.value(float(coordinate)) for key, coordinate in pairs}

    def coordinates(self, point: Mapping[str, Any]) -> Vector:
        """Return the coordinates of values, shape (n,), of keys that all have bounds."""
        return np.array([key.coordinate(point[key.key]) for key in self.bounded])

    def center(self) -> Vector:
        """Return the coordinates in the middle of all bounds, shape (n,)."""
        return np.full(len(self.bounded), 0.5)


def key_of(content: Mapping[str, Any]) -> BoundedKey | ChoiceKey:
    """Return a key that is recorded as plain values: its fields."""
    if "choices" in content:
        return ChoiceKey(content["key"], tuple(content["choices"]))
    return BoundedKey(**content)


def check_space(space: SearchSpace) -> None:
    """Check what a search needs of its keys.

    Raises
    ------
    UsageError
        If there is none, one is given twice, bounds are no increasing finite numbers (positive ones
        for a logarithm), or a list has no value, or one value twice.
    """
    if not space.keys:
        raise UsageError(f"{option('vary')}: expected at least one key to tune, got none")
    seen: set[str] = set()
    for key in space.keys:
        if key.key in seen:
            raise UsageError(f"{option('vary', key.key)}: expected once, got twice")
        seen.add(key.key)
        if isinstance(key, BoundedKey):
            _check_bounds(key)
        elif len({value_name(choice) for choice in key.choices}) < max(len(key.choices), 1):
            raise UsageError(
                f"{option('vary', key.key)}: expected one or more distinct values, got "
                f"{quoted(list(key.choices))}"
            )


def _check_bounds(key: BoundedKey) -> None:
    name = option("vary", key.key)
    found = f"got {key.lower!r} to {key.upper!r}"
    if not (math.isfinite(key.lower) and math.isfinite(key.upper) and key.lower < key.upper):
        raise UsageError(f"{name}: expected two finite bounds, the lower one first, {found}")
    if key.logarithmic and key.lower <= 0.0:
        raise UsageError(
            f"{name}: expected positive bounds with 'log:', {found}; without 'log:' the scale is "
            "linear"
        )
