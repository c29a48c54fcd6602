"""The result of a tuning as lines of text."""

from __future__ import annotations

import math
from typing import Any, Final

from cosim.studies.tables.numbers import number_text
from cosim.studies.tuning.result import TuningResult

_DIGITS: Final = 6


def tuning_lines(result: TuningResult) -> list[str]:
    """Return the best values, what is to be said of them, and the command that runs them."""
    best = result.best
    count = len(result.trials)
    members = "1 member" if count == 1 else f"{count} members"
    if best is None:
        return [f"{members}, none with a value of {result.expression}", *result.statements]
    lines = [f"{result.expression} = {best.objective:.6g}, best of {members}"]
    for key, value in best.point.items():
        lines.append(f"  {key} = {_with_error(result, key, value)}")
    lines += result.statements
    lines.append(f"again: {result.command}")
    return lines


def _with_error(result: TuningResult, key: str, value: Any) -> str:
    """Return a value with its error, in as many digits as the error has two in."""
    if not isinstance(value, float):
        return str(value)
    if result.errors is None:
        return number_text(value)
    low, high = result.errors.intervals[key]
    error = result.errors.errors[key]
    digits = _DIGITS
    if value and error > 0.0:
        digits = max(digits, math.floor(math.log10(abs(value) / error)) + 2)
    return (
        f"{number_text(value, digits)}, standard error {error:.2g}, 95 % interval "
        f"{number_text(low, digits)} to {number_text(high, digits)}"
    )
