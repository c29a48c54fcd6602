"""The table of choices for an experiment, ranked by the error of theta that is to be expected."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping
from typing import Any, Final

from cosim.report.estimators import numbers_text
from cosim.report.tables.console import new_table, print_json, print_line, print_table
from cosim.scenario.experiment_design.designs import ExperimentDesign

_SHOWN: Final = 3  # designs of a choice and a method
_TITLES: Final = {"scenario": "as it is"}


def print_design(design: ExperimentDesign, *, as_json: bool) -> None:
    """Print the best designs of every choice, or all of them as JSON."""
    if as_json:
        print_json(design.to_dict())
        return
    titles = [f"error of theta[{j}]" for j in range(len(design.theta))]
    noise = numbers_text(design.deviations.tolist())
    title = f"{design.identifier}: predicted errors, noise of y {noise} ({design.noise_source})"
    rows = []
    shown: Counter[tuple[str, str]] = Counter()
    for ranked in design.designs:
        shown[ranked.choice, ranked.method] += 1
        if shown[ranked.choice, ranked.method] <= _SHOWN:
            choice = _TITLES.get(ranked.choice, ranked.choice)
            numbers = map(_number, (*ranked.error, ranked.ratio))
            rows.append((choice, _settings(ranked.settings), ranked.method, *numbers))
    print_table(new_table(title, ("", "set", "method", *titles, "of bound"), rows))
    for omitted in design.omitted:
        choice = _TITLES.get(omitted.choice, omitted.choice)
        settings = ", ".join(filter(None, map(_settings, omitted.settings)))
        of_method = " ".join(filter(None, (omitted.method, settings)))
        print_line(": ".join(filter(None, (choice, of_method, omitted.reason))))
    for note in design.notes:
        print_line(note)


def _settings(settings: Mapping[str, Any]) -> str:
    """Write what is set as the options that set it."""
    return " ".join(f"{key}={_value(value)}" for key, value in settings.items())


def _number(error: float) -> str:
    return f"{error:.3g}" if math.isfinite(error) else "no estimate"


def _value(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value).replace(" ", "")
