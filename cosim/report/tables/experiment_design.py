"""The table of choices for an experiment, ranked by the error of theta that is to be expected."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping
from typing import Any, Final

from cosim.report.summary import numbers_text
from cosim.report.tables.console import new_table, print_json, print_line, print_table
from cosim.scenario.experiment_design.ranking import ExperimentDesign, OmittedDesigns

_SHOWN: Final = 3  # designs of a choice and a method
_TITLES: Final = {"scenario": "as it is"}


def print_design(design: ExperimentDesign, *, as_json: bool) -> None:
    """Print the best designs of every choice, or all of them as JSON."""
    if as_json:
        print_json(design.to_dict())
        return
    parameters = range(len(design.theta))
    errors = [f"error of theta[{j}]" for j in parameters]
    noise = numbers_text(design.deviations.tolist())
    title = f"{design.identifier}: predicted errors, noise of y {noise} ({design.noise_source})"
    table = new_table(title, ("", "set", "method", *errors, "of bound"))
    shown: Counter[tuple[str, str]] = Counter()
    for one in design.designs:
        kind = (one.choice, one.method)
        shown[kind] += 1
        if shown[kind] <= _SHOWN:
            cells = [_number(error) for error in one.error]
            choice = _TITLES.get(one.choice, one.choice)
            table.add_row(choice, _settings(one.settings), one.method, *cells, _number(one.ratio))
    print_table(table)
    for omitted in design.omitted:
        print_line(_omission(omitted))
    for note in design.notes:
        print_line(note)


def _omission(omitted: OmittedDesigns) -> str:
    """Write which choices have no row, and why."""
    choices = ", ".join(filter(None, map(_settings, omitted.settings)))
    choice = _TITLES.get(omitted.choice, omitted.choice)
    what = " ".join(filter(None, (f"{choice}:", omitted.method, choices)))
    return f"{what}: {omitted.reason}" if not what.endswith(":") else f"{what} {omitted.reason}"


def _settings(settings: Mapping[str, Any]) -> str:
    """Write what is set as the options that set it."""
    return " ".join(f"{key}={_value(value)}" for key, value in settings.items())


def _number(error: float) -> str:
    return f"{error:.3g}" if math.isfinite(error) else "no estimate"


def _value(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value).replace(" ", "")
