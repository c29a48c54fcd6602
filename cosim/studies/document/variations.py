"""What a key is varied by: each of some values, or a distribution that is drawn from.

A distribution is its name and its numbers:

==================  ==============================================================
uniform             lower, upper
log-uniform         lower, upper; the logarithm is uniform between theirs
normal              mean, deviation, lower, upper; without bounds these are -inf, inf
lognormal           median, deviation of the natural logarithm
triangular          lower, mode, upper
exponential         mean
beta                alpha, beta, lower, upper
weibull             scale, shape: P(x > X) = exp(-(X/scale)**shape)
choice              a weight for each of its values; they need not add up to 1
tolerance           part of the scenario's own value that it may be off by, uniform
tolerance-normal    the same, normal with a third of that as deviation, cut at it
==================  ==============================================================
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeAlias

import numpy as np
from pydantic import ValidationError

from cosim.errors import UsageError, quoted
from cosim.scenario.document.edits import plain
from cosim.scenario.document.problems import TableProblems, problems_of
from cosim.studies.contracts import SWAP
from cosim.studies.document.schema import VariationTable

FORMS: Final = (
    "values",
    "linear",
    "log",
    "uniform",
    "log-uniform",
    "normal",
    "lognormal",
    "triangular",
    "exponential",
    "beta",
    "weibull",
    "choice",
    "tolerance",
)  # keys of what a variation is; it has one of them
_BELONGS: Final = {
    "points": ("linear", "log"),
    "weights": ("choice",),
    "distribution": ("tolerance",),
    "lower": ("normal", "beta"),
    "upper": ("normal", "beta"),
}


@dataclass(frozen=True, slots=True)
class GridVariation:
    """Each of some values in turn, with every combination of the other keys.

    Parameters
    ----------
    key : str
    values : tuple
        As TOML has them.
    """

    key: str
    values: tuple[Any, ...]


@dataclass(frozen=True, slots=True)
class SampledVariation:
    """A value drawn from a distribution; see the module for their names and numbers.

    Parameters
    ----------
    key : str
    distribution : str
    numbers : tuple of float
    values : tuple
        Those that are chosen from; of the distribution ``choice`` alone.
    """

    key: str
    distribution: str
    numbers: tuple[float, ...]
    values: tuple[Any, ...] = ()

    def __str__(self) -> str:
        numbers = list(self.numbers)
        if numbers[2:] == [-math.inf, math.inf]:
            numbers = numbers[:2]
        return f"{self.distribution} {quoted(numbers)}"


Variation: TypeAlias = GridVariation | SampledVariation


def read_variation(key: str, value: Any) -> Variation:
    """Read an entry of [vary]: a list of values, or a table.

    Raises
    ------
    TableProblems
        With everything that is wrong with it.
    """
    try:
        value = plain(value)
    except UsageError as error:
        raise TableProblems([((), str(error))]) from error
    if isinstance(value, list):
        variation: Variation = GridVariation(key, _values(key, value, ()))
    elif isinstance(value, Mapping):
        variation = _read_table(key, value)
    else:
        needed = "expected a list of values, or a table such as { uniform = [0.0, 1.0] }"
        raise TableProblems([((), f"{needed}; got {quoted(value)}")])
    return variation


def _read_table(key: str, value: Mapping[str, Any]) -> Variation:
    try:
        table = VariationTable.model_validate(value)
    except ValidationError as error:
        raise TableProblems(problems_of(error, VariationTable, value, ())) from error
    form = _form(value)
    if form in ("values", "choice"):
        values = _values(key, value[form], (form,))
        if form == "values":
            return GridVariation(key, values)
        return SampledVariation(key, form, _weights(table, len(values)), values)
    if key.startswith(SWAP):
        text = f"expected a list of paths for a component, got '{form}'"
        raise TableProblems([((), text)])
    if form in ("linear", "log"):
        return GridVariation(key, _points(form, table))
    return _distribution(key, form, table)


def _form(value: Mapping[str, Any]) -> str:
    """Return which of the forms a table has."""
    forms = [name for name in FORMS if name in value]
    if len(forms) != 1:
        found = " and ".join(f"'{name}'" for name in forms) or "none of them"
        raise TableProblems([((), f"expected one of: {', '.join(FORMS)}; got {found}")])
    for name, homes in _BELONGS.items():
        if name in value and forms[0] not in homes:
            of = " or ".join(f"'{home}'" for home in homes)
            text = f"'{name}' belongs to {of}, got it beside '{forms[0]}'"
            raise TableProblems([((name,), text)])
    return forms[0]


def _values(key: str, values: Sequence[Any], place: tuple[str, ...]) -> tuple[Any, ...]:
    if not values:
        raise TableProblems([(place, "expected at least one value, got none")])
    if key.startswith(SWAP):
        for number, value in enumerate(values):
            if not isinstance(value, str):
                text = f"expected a path, or a key with a dot, got {quoted(value)}"
                raise TableProblems([((*place, number), text)])
    return tuple(values)


def _points(form: str, table: VariationTable) -> tuple[float, ...]:
    """Return the values of a grid of numbers; the first and the last are those that were given."""
    numbers = (table.linear if form == "linear" else table.log) or ()
    if table.points is None:
        raise TableProblems(
            [((), f"'points' is missing; expected the number of values of '{form}'")]
        )
    is_right = len(numbers) == 2 and numbers[0] != numbers[1]
    if form == "linear":
        _need(is_right, form, numbers, "[first, last], two different numbers")
        return tuple(np.linspace(numbers[0], numbers[1], table.points).tolist())
    _need(is_right and min(numbers) > 0.0, form, numbers, "[first, last], two positive numbers")
    return tuple(np.geomspace(numbers[0], numbers[1], table.points).tolist())


def _weights(table: VariationTable, count: int) -> tuple[float, ...]:
    weights = table.weights
    if weights is None:
        return (1.0,) * count
    needed = f"a weight for each of the {count} values"
    _need(len(weights) == count, "weights", weights, needed)
    is_right = min(weights) >= 0.0 and 0.0 < sum(weights) < math.inf
    _need(is_right, "weights", weights, "weights of at least 0, and one above it")
    return weights


def _need(is_right: bool, form: str, numbers: Sequence[float], needed: str) -> None:
    if not is_right:
        raise TableProblems([((form,), f"expected {needed}, got {quoted(list(numbers))}")])


# --- distributions ---


def _two_bounds(numbers: Sequence[float]) -> bool:
    return len(numbers) == 2 and numbers[0] < numbers[1]


def _positive_bounds(numbers: Sequence[float]) -> bool:
    return _two_bounds(numbers) and numbers[0] > 0.0


def _two_positive(numbers: Sequence[float]) -> bool:
    return len(numbers) == 2 and min(numbers) > 0.0


def _mean_and_deviation(numbers: Sequence[float]) -> bool:
    return len(numbers) == 2 and numbers[1] > 0.0


def _around_mode(numbers: Sequence[float]) -> bool:
    if len(numbers) != 3:
        return False
    lower, mode, upper = numbers
    return lower <= mode <= upper and lower < upper


def _one_positive(numbers: Sequence[float]) -> bool:
    return len(numbers) == 1 and numbers[0] > 0.0


_CHECKS: Final[Mapping[str, tuple[Callable[[Sequence[float]], bool], str]]] = {
    "uniform": (_two_bounds, "[lower, upper] with lower < upper"),
    "log-uniform": (_positive_bounds, "[lower, upper] with 0 < lower < upper"),
    "normal": (_mean_and_deviation, "[mean, deviation] with a deviation above 0"),
    "lognormal": (
        _two_positive,
        "[median, deviation of the natural logarithm], both above 0",
    ),
    "triangular": (_around_mode, "[lower, mode, upper] with lower <= mode <= upper"),
    "exponential": (_one_positive, "a mean above 0"),
    "beta": (_two_positive, "[alpha, beta], both above 0"),
    "weibull": (_two_positive, "[scale, shape], both above 0"),
}


def _distribution(key: str, form: str, table: VariationTable) -> SampledVariation:
    if form == "tolerance":
        tolerance = table.tolerance or 0.0
        if not 0.0 < tolerance < 1.0:
            text = f"expected a fraction between 0 and 1, such as 0.05, got {tolerance!r}"
            raise TableProblems([((form,), text)])
        name = "tolerance-normal" if table.distribution == "normal" else form
        return SampledVariation(key, name, (tolerance,))
    given = getattr(table, form.replace("-", "_"))
    numbers: tuple[float, ...] = given if isinstance(given, tuple) else (given,)
    is_right, needed = _CHECKS[form]
    _need(is_right(numbers), form, numbers, needed)
    if form in ("normal", "beta"):
        numbers = (*numbers, *_bounds(form, table))
    return SampledVariation(key, form, numbers)


def _bounds(form: str, table: VariationTable) -> tuple[float, float]:
    first, last = (-math.inf, math.inf) if form == "normal" else (0.0, 1.0)
    lower = first if table.lower is None else table.lower
    upper = last if table.upper is None else table.upper
    if not lower < upper:
        text = f"expected bounds with lower < upper, got {lower!r} and {upper!r}"
        raise TableProblems([((), text)])
    return lower, upper
