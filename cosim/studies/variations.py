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
from cosim.scenario.document.document import parse_values, plain
from cosim.scenario.document.places import Key
from cosim.scenario.document.problems import TableProblems, problems_of
from cosim.scenario.document.schema import (
    Number,
    NumberRow,
    TomlTable,
    Whole,
)
from cosim.studies.contracts import SWAP


class VariationTable(TomlTable):
    """An entry of [vary] that is a table: one of its forms, and what belongs to it."""

    values: list[Any] | None = None
    linear: NumberRow | None = None
    log: NumberRow | None = None
    points: Annotated[Whole, Field(ge=2, le=100_000)] | None = None
    uniform: NumberRow | None = None
    log_uniform: NumberRow | None = Field(None, alias="log-uniform")
    normal: NumberRow | None = None
    lognormal: NumberRow | None = None
    triangular: NumberRow | None = None
    exponential: Number | NumberRow | None = None
    beta: NumberRow | None = None
    weibull: NumberRow | None = None
    choice: list[Any] | None = None
    weights: NumberRow | None = None
    tolerance: Number | None = None
    distribution: Literal["uniform", "normal"] | None = None  # of a tolerance
    lower: Number | None = None
    upper: Number | None = None


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
        raise _problem(str(error)) from error
    if not isinstance(value, list | Mapping):
        needed = "expected a list of values, or a table such as { uniform = [0.0, 1.0] }"
        raise _problem(f"{needed}; got {quoted(value)}")
    is_swap = key.startswith(SWAP)
    if is_swap and len(value) == 1 and isinstance(value, list) and isinstance(value[0], list):
        value = value[0]  # of an option, where the list is its only value
    given = {"values": value} if isinstance(value, list) else value
    try:
        table = VariationTable.model_validate(given)
    except ValidationError as error:
        raise TableProblems(problems_of(error, VariationTable, given, ())) from error
    form = _form(given)
    if form in ("values", "choice"):
        values = _values(given[form], is_swap, () if given is not value else (form,))
        if form == "values":
            return GridVariation(key, values)
        return SampledVariation(key, form, _weights(table.weights, len(values)), values)
    if is_swap:
        raise _problem(f"expected a list of paths for a component, got '{form}'")
    return _of_numbers(key, form, table)


def _form(value: Mapping[str, Any]) -> str:
    """Return which of the forms a table has."""
    forms = [name for name in FORMS if name in value]
    if len(forms) != 1:
        found = " and ".join(f"'{name}'" for name in forms) or "none of them"
        raise _problem(f"expected one of: {', '.join(FORMS)}; got {found}")
    form = forms[0]
    for name, homes in _BELONGS.items():
        if name in value and form not in homes:
            of = " or ".join(f"'{home}'" for home in homes)
            raise _problem(f"'{name}' belongs to {of}, got it beside '{form}'", name)
    return form


def _of_numbers(key: str, form: str, table: VariationTable) -> Variation:
    given = getattr(table, form.replace("-", "_"))
    numbers: tuple[float, ...] = given if isinstance(given, tuple) else (given,)
    size, is_right, needed, _ = _KINDS[form]
    _need(len(numbers) == size and is_right(*numbers), form, numbers, needed)
    if form in ("linear", "log"):
        if table.points is None:
            raise _problem(f"'points' is missing; expected the number of values of '{form}'")
        space: Any = np.linspace if form == "linear" else np.geomspace
        return GridVariation(key, tuple(space(*numbers, table.points).tolist()))
    if form == "tolerance" and table.distribution == "normal":
        form = "tolerance-normal"
    if form in ("normal", "beta"):
        first, last = (-math.inf, math.inf) if form == "normal" else (0.0, 1.0)
        lower = first if table.lower is None else table.lower
        upper = last if table.upper is None else table.upper
        if not lower < upper:
            raise _problem(f"expected bounds with lower < upper, got {lower!r} and {upper!r}")
        numbers = (*numbers, lower, upper)
    return SampledVariation(key, form, numbers)


def _values(values: Sequence[Any], is_swap: bool, place: Key) -> tuple[Any, ...]:
    if not values:
        raise _problem("expected at least one value, got none", *place)
    for number, value in enumerate(values):
        if is_swap and not isinstance(value, str):
            text = f"expected a path, or a key with a dot, got {quoted(value)}"
            raise _problem(text, *place, number)
    return tuple(values)


def _weights(weights: tuple[float, ...] | None, count: int) -> tuple[float, ...]:
    if weights is None:
        return (1.0,) * count
    _need(len(weights) == count, "weights", weights, f"a weight for each of the {count} values")
    is_right = min(weights) >= 0.0 and 0.0 < sum(weights) < math.inf
    _need(is_right, "weights", weights, "weights of at least 0, and one above it")
    return weights


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
    form = variation.distribution
    if form.startswith("tolerance"):
        width = abs(own_value) * numbers[0]
        numbers = (own_value - width, own_value + width)
        if form == "tolerance-normal":
            numbers = (own_value, width / 3.0, *numbers)
        form = "uniform" if form == "tolerance" else "normal"
    with np.errstate(over="ignore"):  # the planning refuses what is not finite
        values: Vector = _KINDS[form].quantiles(p, *numbers)
    return values


def chosen(variation: SampledVariation, p: Vector) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    """Return the indices of what is chosen at some probabilities."""
    weights = np.array(variation.numbers)
    cumulative = np.cumsum(weights / weights.sum())
    indices = np.searchsorted(cumulative, p, side="right")
    last = int(np.flatnonzero(weights)[-1])  # the sum may round to less than 1
    return np.minimum(indices, last)


def _uniform(p: Any, lower: float, upper: float) -> Any:
    return np.clip(lower * (1.0 - p) + upper * p, lower, upper)  # their difference could overflow


def _log_uniform(p: Any, lower: float, upper: float) -> Any:
    return np.clip(np.exp(_uniform(p, math.log(lower), math.log(upper))), lower, upper)


def _normal(
    p: Any, mean: float, deviation: float, lower: float = -math.inf, upper: float = math.inf
) -> Any:
    if lower == -math.inf and upper == math.inf:
        from scipy.special import ndtri

        return mean + deviation * ndtri(p)
    from scipy.stats import truncnorm

    below, above = ((bound - mean) / deviation for bound in (lower, upper))
    return np.clip(mean + deviation * truncnorm.ppf(p, below, above), lower, upper)


def _triangular(p: Any, lower: float, mode: float, upper: float) -> Any:
    width = upper - lower
    rising = lower + np.sqrt(p * width * (mode - lower))
    falling = upper - np.sqrt((1.0 - p) * width * (upper - mode))
    return np.clip(np.where(p * width < mode - lower, rising, falling), lower, upper)


def _beta(p: Any, alpha: float, beta: float, lower: float, upper: float) -> Any:
    from scipy.special import betaincinv

    return _uniform(betaincinv(alpha, beta, p), lower, upper)


class _Kind(NamedTuple):
    """What a form of numbers needs, and its values at probabilities."""

    size: int
    is_right: Callable[..., bool]
    needed: str
    quantiles: Callable[..., Any] = _uniform


def _are_positive(a: float, b: float) -> bool:
    return min(a, b) > 0.0


_KINDS: Final = {
    "linear": _Kind(2, lambda a, b: a != b, "[first, last], two different numbers"),
    "log": _Kind(
        2, lambda a, b: 0.0 < min(a, b) < max(a, b), "[first, last], two different positive numbers"
    ),
    "tolerance": _Kind(1, lambda x: 0.0 < x < 1.0, "a fraction between 0 and 1, such as 0.05"),
    "uniform": _Kind(2, lambda a, b: a < b, "[lower, upper] with lower < upper"),
    "log-uniform": _Kind(
        2, lambda a, b: 0.0 < a < b, "[lower, upper] with 0 < lower < upper", _log_uniform
    ),
    "normal": _Kind(2, lambda _, s: s > 0.0, "[mean, deviation] with a deviation above 0", _normal),
    "lognormal": _Kind(
        2,
        _are_positive,
        "[median, deviation of the natural logarithm], both above 0",
        lambda p, median, s: median * np.exp(_normal(p, 0.0, s)),
    ),
    "triangular": _Kind(
        3,
        lambda a, mode, b: a <= mode <= b and a < b,
        "[lower, mode, upper] with lower <= mode <= upper",
        _triangular,
    ),
    "exponential": _Kind(
        1, lambda mean: mean > 0.0, "a mean above 0", lambda p, mean: -mean * np.log1p(-p)
    ),
    "beta": _Kind(2, _are_positive, "[alpha, beta], both above 0", _beta),
    "weibull": _Kind(
        2,
        _are_positive,
        "[scale, shape], both above 0",
        lambda p, scale, shape: scale * (-np.log1p(-p)) ** (1.0 / shape),
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
        return {"choice": parse_values(rest)}
    if name in FORMS and name != "values":
        distribution = {"distribution": parts.pop()} if name == "tolerance" and parts[1:] else {}
        return _table(name, parts, text) | distribution
    if name and all(map(_NUMBERS.fullmatch, parts)):
        raise UsageError(f"no form {quoted(name)} in {quoted(text)}; {nearest(name, FORMS[1:])}")
    values = parse_values(text.strip())
    only = values[0] if len(values) == 1 else None
    if isinstance(only, str) and only.startswith("[") and only.endswith("]"):
        return parse_values(only[1:-1])  # a list whose entries are no TOML
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
