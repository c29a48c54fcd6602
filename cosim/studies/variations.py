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
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal, NamedTuple, TypeAlias

import numpy as np
from pydantic import Field, ValidationError

from cosim.arrays import Vector
from cosim.errors import UsageError, nearest, quoted
from cosim.scenario.document.edits import plain
from cosim.scenario.document.problems import TableProblems, problems_of
from cosim.scenario.document.schema import Number, NumberRow, TomlTable, Whole
from cosim.scenario.document.value_lists import read_values
from cosim.studies.contracts import SWAP

MOST_POINTS: Final = 100_000  # of a key of the grid
_SIGMAS: Final = 3.0  # standard deviations that the tolerance of a normal distribution is


class VariationTable(TomlTable):
    """An entry of [vary] that is a table: one of its forms."""

    values: list[Any] | None = Field(None, description="each of these values")
    linear: NumberRow | None = Field(None, description="from the first to the last, linearly")
    log: NumberRow | None = Field(None, description="from the first to the last, logarithmically")
    points: Annotated[Whole, Field(ge=2, le=MOST_POINTS)] | None = Field(
        None, description="number of values of 'linear' and 'log'"
    )
    uniform: NumberRow | None = Field(None, description="[lower, upper]")
    log_uniform: NumberRow | None = Field(
        None, alias="log-uniform", description="[lower, upper] of a uniform logarithm"
    )
    normal: NumberRow | None = Field(None, description="[mean, deviation]; may have bounds")
    lognormal: NumberRow | None = Field(
        None, description="[median, deviation of the natural logarithm]"
    )
    triangular: NumberRow | None = Field(None, description="[lower, mode, upper]")
    exponential: Number | NumberRow | None = Field(None, description="the mean")
    beta: NumberRow | None = Field(None, description="[alpha, beta]; bounds are 0 and 1 unless set")
    weibull: NumberRow | None = Field(None, description="[scale, shape]")
    choice: list[Any] | None = Field(None, description="one of these values, at random")
    weights: NumberRow | None = Field(None, description="of the values of 'choice'")
    tolerance: Number | None = Field(
        None, description="relative to the scenario's own value, such as 0.05"
    )
    distribution: Literal["uniform", "normal"] | None = Field(
        None,
        description='of a tolerance: "uniform" (default), or "normal" with a third of it as '
        "deviation, truncated at the tolerance",
    )
    lower: Number | None = Field(None, description="bound of 'normal' and 'beta'")
    upper: Number | None = Field(None, description="bound of 'normal' and 'beta'")


_BELONGS: Final = {
    "points": ("linear", "log"),
    "weights": ("choice",),
    "distribution": ("tolerance",),
    "lower": ("normal", "beta"),
    "upper": ("normal", "beta"),
}
FORMS: Final = tuple(
    field.alias or name
    for name, field in VariationTable.model_fields.items()
    if name not in _BELONGS
)  # keys of what a variation is; it has one of them


@dataclass(frozen=True, slots=True)
class GridVariation:
    """Each of some values in turn, with every combination of the other keys."""

    key: str
    values: tuple[Any, ...]


@dataclass(frozen=True, slots=True)
class SampledVariation:
    """A value drawn from a distribution; ``values`` are those of a choice."""

    key: str
    distribution: str
    numbers: tuple[float, ...]
    values: tuple[Any, ...] = ()

    def __str__(self) -> str:
        is_unbounded = self.numbers[2:] == (-math.inf, math.inf)
        numbers = self.numbers[:2] if is_unbounded else self.numbers
        return f"{self.distribution} {quoted(list(numbers))}"


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
        return GridVariation(key, _values(key, value))
    if not isinstance(value, Mapping):
        raise _problem(
            "expected a list of values, or a table such as { uniform = [0.0, 1.0] }; got "
            f"{quoted(value)}"
        )
    try:
        table = VariationTable.model_validate(value)
    except ValidationError as error:
        raise TableProblems(problems_of(error, VariationTable, value, ())) from error
    form = _form(value)
    if form in ("values", "choice"):
        values = _values(key, value[form], form)
        if form == "values":
            return GridVariation(key, values)
        return SampledVariation(key, form, _weights(table, len(values)), values)
    if key.startswith(SWAP):
        raise _problem(f"expected a list of paths for a component, got '{form}'")
    if form in ("linear", "log"):
        return GridVariation(key, _points(form, table))
    return _distribution(key, form, table)


def _form(value: Mapping[str, Any]) -> str:
    """Return which of the forms a table has."""
    forms = [name for name in FORMS if name in value]
    if len(forms) != 1:
        found = " and ".join(f"'{name}'" for name in forms) or "none of them"
        raise _problem(f"expected one of: {', '.join(FORMS)}; got {found}")
    for name, homes in _BELONGS.items():
        if name in value and forms[0] not in homes:
            of = " or ".join(f"'{home}'" for home in homes)
            raise _problem(f"'{name}' belongs to {of}, got it beside '{forms[0]}'", name)
    return forms[0]


def _values(key: str, values: Sequence[Any], *place: str) -> tuple[Any, ...]:
    if not values:
        raise _problem("expected at least one value, got none", *place)
    if key.startswith(SWAP):
        for number, value in enumerate(values):
            if not isinstance(value, str):
                text = f"expected a path, or a key with a dot, got {quoted(value)}"
                raise _problem(text, *place, number)
    return tuple(values)


def _points(form: str, table: VariationTable) -> tuple[float, ...]:
    """Return the values of a grid of numbers; the first and the last are those that were given."""
    numbers: tuple[float, ...] = getattr(table, form)
    if table.points is None:
        raise _problem(f"'points' is missing; expected the number of values of '{form}'")
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
    _need(len(weights) == count, "weights", weights, f"a weight for each of the {count} values")
    is_right = min(weights) >= 0.0 and 0.0 < sum(weights) < math.inf
    _need(is_right, "weights", weights, "weights of at least 0, and one above it")
    return tuple(weights)


def _distribution(key: str, form: str, table: VariationTable) -> SampledVariation:
    if form == "tolerance":
        tolerance = table.tolerance or 0.0
        if not 0.0 < tolerance < 1.0:
            text = f"expected a fraction between 0 and 1, such as 0.05, got {tolerance!r}"
            raise _problem(text, form)
        name = "tolerance-normal" if table.distribution == "normal" else form
        return SampledVariation(key, name, (tolerance,))
    given = getattr(table, form.replace("-", "_"))
    numbers: tuple[float, ...] = given if isinstance(given, tuple) else (given,)
    _, size, is_right, needed = _DISTRIBUTIONS[form]
    _need(len(numbers) == size and is_right(*numbers), form, numbers, needed)
    if form in ("normal", "beta"):
        first, last = (-math.inf, math.inf) if form == "normal" else (0.0, 1.0)
        lower = first if table.lower is None else table.lower
        upper = last if table.upper is None else table.upper
        if not lower < upper:
            raise _problem(f"expected bounds with lower < upper, got {lower!r} and {upper!r}")
        numbers = (*numbers, lower, upper)
    return SampledVariation(key, form, numbers)


def _need(is_right: bool, form: str, numbers: Sequence[float], needed: str) -> None:
    if not is_right:
        raise _problem(f"expected {needed}, got {quoted(list(numbers))}", form)


def _problem(text: str, *place: str | int) -> TableProblems:
    return TableProblems([(place, text)])


# --- what is drawn ---


def quantiles(variation: SampledVariation, p: Vector, own_value: float) -> Vector:
    """Return the values at some probabilities.

    Parameters
    ----------
    variation : SampledVariation
        No choice.
    p : Vector
        Between 0 and 1.
    own_value : float
        The scenario's own, that a tolerance is of.
    """
    numbers = variation.numbers
    if not variation.distribution.startswith("tolerance"):
        return _DISTRIBUTIONS[variation.distribution].quantiles(p, *numbers)
    width = abs(own_value) * numbers[0]
    bounds = (own_value - width, own_value + width)
    if variation.distribution == "tolerance":
        return _uniform(p, *bounds)
    return _normal(p, own_value, width / _SIGMAS, *bounds)


def chosen(variation: SampledVariation, p: Vector) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    """Return the indices of what is chosen at some probabilities."""
    weights = np.array(variation.numbers)
    cumulative = np.cumsum(weights / weights.sum())
    indices = np.searchsorted(cumulative, p, side="right")
    last = int(np.flatnonzero(weights)[-1])  # the sum may round to less than 1
    return np.minimum(indices, last)


def _uniform(p: Vector, lower: float, upper: float) -> Vector:
    values: Vector = lower * (1.0 - p) + upper * p  # their difference could overflow
    return np.clip(values, lower, upper)


def _log_uniform(p: Vector, lower: float, upper: float) -> Vector:
    values: Vector = np.exp(_uniform(p, math.log(lower), math.log(upper)))
    return np.clip(values, lower, upper)


def _normal(p: Vector, mean: float, deviation: float, lower: float, upper: float) -> Vector:
    if lower == -math.inf and upper == math.inf:
        from scipy.special import ndtri

        values: Vector = mean + deviation * ndtri(p)
        return values
    from scipy.stats import truncnorm

    below, above = ((bound - mean) / deviation for bound in (lower, upper))
    truncated: Vector = mean + deviation * truncnorm.ppf(p, below, above)
    return np.clip(truncated, lower, upper)


def _lognormal(p: Vector, median: float, deviation: float) -> Vector:
    from scipy.special import ndtri

    with np.errstate(over="ignore"):  # the planning refuses what is not finite
        values: Vector = median * np.exp(deviation * ndtri(p))
    return values


def _triangular(p: Vector, lower: float, mode: float, upper: float) -> Vector:
    width = upper - lower
    rising = lower + np.sqrt(p * width * (mode - lower))
    falling = upper - np.sqrt((1.0 - p) * width * (upper - mode))
    values: Vector = np.where(p * width < mode - lower, rising, falling)
    return np.clip(values, lower, upper)


def _exponential(p: Vector, mean: float) -> Vector:
    values: Vector = -mean * np.log1p(-p)
    return values


def _beta(p: Vector, alpha: float, beta: float, lower: float, upper: float) -> Vector:
    from scipy.special import betaincinv

    return _uniform(betaincinv(alpha, beta, p), lower, upper)


def _weibull(p: Vector, scale: float, shape: float) -> Vector:
    with np.errstate(over="ignore"):
        values: Vector = scale * (-np.log1p(-p)) ** (1.0 / shape)
    return values


class _Distribution(NamedTuple):
    quantiles: Callable[..., Vector]
    size: int  # of its numbers, without bounds
    is_right: Callable[..., bool]
    needed: str


_DISTRIBUTIONS: Final = {
    "uniform": _Distribution(
        _uniform, 2, lambda low, high: low < high, "[lower, upper] with lower < upper"
    ),
    "log-uniform": _Distribution(
        _log_uniform, 2, lambda low, high: 0.0 < low < high, "[lower, upper] with 0 < lower < upper"
    ),
    "normal": _Distribution(
        _normal, 2, lambda _, s: s > 0.0, "[mean, deviation] with a deviation above 0"
    ),
    "lognormal": _Distribution(
        _lognormal,
        2,
        lambda median, s: min(median, s) > 0.0,
        "[median, deviation of the natural logarithm], both above 0",
    ),
    "triangular": _Distribution(
        _triangular,
        3,
        lambda low, mode, high: low <= mode <= high and low < high,
        "[lower, mode, upper] with lower <= mode <= upper",
    ),
    "exponential": _Distribution(_exponential, 1, lambda mean: mean > 0.0, "a mean above 0"),
    "beta": _Distribution(_beta, 2, lambda a, b: min(a, b) > 0.0, "[alpha, beta], both above 0"),
    "weibull": _Distribution(
        _weibull, 2, lambda a, b: min(a, b) > 0.0, "[scale, shape], both above 0"
    ),
}


# --- the option --vary ---

_OPTION: Final = re.compile(r"([A-Za-z][A-Za-z-]*):(.*)", re.DOTALL)
_NUMBERS: Final = re.compile(r"\s*[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?\s*")


def read_vary_option(text: str) -> Any:
    """Return the list or the table of a study file that a text of --vary means.

    ::

        1e3,1e6  sine,step  [0,2],[0,4]     these values, as in --vary of a replay
        [a.fmu,b.fmu]                       the same for the key of a component: swaps
        log:10:1e4:25   linear:0:1:11       a grid: first, last, points
        uniform:0:1     normal:0:0.1        a distribution and its numbers, in the order of the file
        normal:0:1:-2:2                     with bounds; the same for beta
        tolerance:0.05:normal               a tolerance and its distribution
        choice:1,2,4                        one of these at random

    Raises
    ------
    UsageError
        If it is none; what the numbers of a distribution must be is checked with the study.
    """
    match = _OPTION.fullmatch(text.strip())
    name, rest = match.groups() if match is not None else ("", "")
    parts = rest.split(":")
    if name == "choice":
        return {"choice": read_values(rest)}
    if name in FORMS and name != "values":
        distribution = {"distribution": parts.pop()} if name == "tolerance" and parts[1:] else {}
        return _table(name, parts, text) | distribution
    if name and all(map(_NUMBERS.fullmatch, parts)):
        raise UsageError(f"no form {quoted(name)} in {quoted(text)}; {nearest(name, FORMS[1:])}")
    values = read_values(text.strip())
    only = values[0] if len(values) == 1 else None
    if isinstance(only, str) and only.startswith("[") and only.endswith("]"):
        return read_values(only[1:-1])  # a list whose entries are no TOML
    return values


def _table(name: str, parts: Sequence[str], text: str) -> dict[str, Any]:
    try:
        numbers = [float(part) for part in parts]
    except ValueError as error:
        raise UsageError(f"expected numbers after '{name}:', got {quoted(text)}") from error
    if name in ("linear", "log"):
        if len(numbers) != 3 or not numbers[2].is_integer():
            raise UsageError(f"expected {name}:FIRST:LAST:POINTS, got {quoted(text)}")
        return {name: numbers[:2], "points": int(numbers[2])}
    if name == "tolerance":
        return {name: numbers[0]}
    if name in ("normal", "beta") and len(numbers) == 4:
        return {name: numbers[:2], "lower": numbers[2], "upper": numbers[3]}
    return {name: numbers}
