"""The result of a tuning as lines of text."""

from __future__ import annotations

from typing import Any

from cosim.studies.tuning.result import TuningResult


def tuning_lines(result: TuningResult) -> list[str]:
    """Return the best values, what is to be said of them, and the command that runs them."""
    best = result.best
    count = len(result.trials)
    members = "1 member" if count == 1 else f"{count} members"
    if best is None:
        return [f"{members}, none with a value of {result.expression}", *result.statements]
    lines = [f"{result.expression} = {best.objective:.6g}, best of {members}"]
    for key, value in best.point.items():
        lines.append(f"  {key} = {_shown(value)}{_error(result, key)}")
    lines += result.statements
    lines.append(f"again: {result.command}")
    return lines


def _shown(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _error(result: TuningResult, key: str) -> str:
    if result.errors is None:
        return ""
    low, high = result.errors.intervals[key]
    error = result.errors.errors[key]
    return f", standard error {error:.2g}, 95 % interval {low:.6g} to {high:.6g}"
