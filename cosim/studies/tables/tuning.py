"""The result of a tuning as lines of text."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from typing import Any

from cosim.studies.design.commands import toml_text
from cosim.studies.document.variations import SWAP
from cosim.studies.tuning.result import TuningResult, statements
from cosim.studies.tuning.tuning import TuningTask


def tuning_lines(task: TuningTask, result: TuningResult) -> list[str]:
    """Return the best values, what is to be said of them, and the command that runs them."""
    best = result.best
    count = len(result.trials)
    members = "1 member" if count == 1 else f"{count} members"
    if best is None:
        return [f"{members}, none with a value of {task.expression}", *statements(result)]
    lines = [f"{task.expression} = {best.objective:.6g}, best of {members}"]
    for key, value in best.point.items():
        lines.append(f"  {key} = {_shown(value)}{_error(result, key)}")
    lines += statements(result)
    lines.append(f"again: {best_command(task, best.point)}")
    return lines


def best_command(task: TuningTask, point: Mapping[str, Any]) -> str:
    """Return the line for a shell that runs values with all their digits."""
    words = ["cosim", "run", task.scenario]
    swaps = dict(task.swap)
    changes = dict(task.set)
    for key, value in point.items():
        if key.startswith(SWAP):
            swaps[key.removeprefix(SWAP)] = str(value)
        else:
            changes[key] = value
    for name, path in swaps.items():
        words += ["--swap", f"{name}={path}"]
    for port, names in task.map.items():
        text = names if isinstance(names, str) else f"[{','.join(names)}]"
        words += ["--map", f"{port}={text}"]
    for key, value in changes.items():
        words += ["--set", f"{key}={toml_text(value)}"]
    return shlex.join(words)


def _shown(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _error(result: TuningResult, key: str) -> str:
    if result.errors is None:
        return ""
    low, high = result.errors.intervals[key]
    error = result.errors.errors[key]
    return f", standard error {error:.2g}, 95 % interval {low:.6g} to {high:.6g}"
