"""What follows KEY= in the option --vary, as a study file would have it.

::

    1e3,1e6  sine,step  [0,2],[0,4]     these values, as in --vary of a replay
    [a.fmu,b.fmu]                       the same for the key of a component: swaps
    log:10:1e4:25   linear:0:1:11       a grid: first, last, points
    uniform:0:1     normal:0:0.1        a distribution and its numbers, in the order of the file
    normal:0:1:-2:2                     with bounds; the same for beta
    tolerance:0.05:normal               a tolerance and its distribution
    choice:1,2,4                        one of these at random
"""

from __future__ import annotations

import re
from typing import Any, Final

from cosim.errors import UsageError, nearest, quoted
from cosim.scenario.document.value_lists import read_values
from cosim.studies.document.variations import FORMS

_FORM: Final = re.compile(r"([A-Za-z][A-Za-z-]*):(.*)", re.DOTALL)
_NUMBER: Final = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_GRIDS: Final = ("linear", "log")
_BOUNDED: Final = ("normal", "beta")


def read_vary_option(text: str) -> Any:
    """Return the list or the table of a study file that a text of --vary means.

    What the numbers of a distribution must be is checked with the study.

    Raises
    ------
    UsageError
        If it is none.
    """
    stripped = text.strip()
    match = _FORM.fullmatch(stripped)
    if match is not None:
        name, rest = match.groups()
        if name == "choice":
            return {"choice": read_values(rest)}
        if name == "tolerance":
            return _tolerance(rest, text)
        parts = rest.split(":")
        if name in FORMS and name != "values":
            return _table(name, parts, text)
        if all(_NUMBER.fullmatch(part.strip()) for part in parts):
            raise UsageError(
                f"no form {quoted(name)} in {quoted(text)}; {nearest(name, FORMS[1:])}"
            )
    values = read_values(stripped)
    if len(values) == 1 and _is_bracketed(values[0]):
        return read_values(values[0][1:-1])
    return values


def _is_bracketed(value: Any) -> bool:
    """Return whether a text is a list whose entries are no TOML: ``[a.fmu,b.fmu]``."""
    return isinstance(value, str) and value.startswith("[") and value.endswith("]")


def _table(name: str, parts: list[str], text: str) -> dict[str, Any]:
    numbers = [_number(part, text) for part in parts]
    if name in _GRIDS:
        if len(numbers) != 3 or not numbers[2].is_integer():
            raise UsageError(f"expected {name}:FIRST:LAST:POINTS, got {quoted(text)}")
        return {name: numbers[:2], "points": int(numbers[2])}
    if name in _BOUNDED and len(numbers) == 4:
        return {name: numbers[:2], "lower": numbers[2], "upper": numbers[3]}
    return {name: numbers}


def _tolerance(rest: str, text: str) -> dict[str, Any]:
    part, colon, distribution = rest.partition(":")
    table: dict[str, Any] = {"tolerance": _number(part, text)}
    if colon:
        table["distribution"] = distribution
    return table


def _number(part: str, text: str) -> float:
    try:
        return float(part)
    except ValueError as error:
        raise UsageError(f"expected a number, got {quoted(part)} in {quoted(text)}") from error
