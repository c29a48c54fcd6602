"""What the scenario itself says of a key: the value that a tolerance is relative to, its seeds."""

from __future__ import annotations

from typing import Any

from cosim.errors import UsageError, option, quoted
from cosim.scenario.document.edits import ACTIONS, COMPONENTS, FLAT, component_in, short
from cosim.scenario.document.elements import address
from cosim.scenario.parsing import Scenario


def own_number(scenario: Scenario, key: str) -> float:
    """Return the number that a key has in a scenario, or by default.

    Raises
    ------
    UsageError
        If there is none, or it is 0.
    """
    value = own_value(scenario, key)
    label = option("vary", key)
    if value is None:
        raise UsageError(
            f"{label}: the scenario sets no value that the tolerance could be relative to; use "
            "another distribution, such as { uniform = [LOWER, UPPER] }"
        )
    if isinstance(value, bool) or not isinstance(value, int | float):
        way_out = f"; name an element: {key}[0]" if isinstance(value, list | tuple) else ""
        raise UsageError(
            f"{label}: a tolerance is relative to a number; got {quoted(value)}{way_out}"
        )
    if value == 0:
        raise UsageError(
            f"{label}: a tolerance is relative to the scenario's own value, which is 0; use "
            "another distribution, such as { uniform = [LOWER, UPPER] }"
        )
    return float(value)


def own_value(scenario: Scenario, key: str) -> Any:
    """Return the value of a key as the file has it, or the default; None: there is none."""
    component = component_in(key)
    first, _, rest = key.removeprefix(f"{COMPONENTS}.").partition(".")
    if component is None and first in FLAT:
        return scenario.tree.get(first, {}).get(rest)
    parts = address(rest).split(".")
    value: Any = scenario.tree
    for part in (first, *parts) if component is None else (COMPONENTS, first, *parts):
        value = _inner(value, part)
    if value is None and component is not None:
        value = scenario.specs.get(first)
        for part in parts:
            value = _inner(value, part)
    if value is None and component is None and first == "scenario":
        value = getattr(scenario.file.scenario, rest, None)
    return value


def _inner(value: Any, part: str) -> Any:
    if isinstance(value, dict):
        return value.get(part)
    if isinstance(value, list | tuple):
        return value[int(part)] if part.isdigit() and int(part) < len(value) else None
    return getattr(value, part, None) if value is not None and part.isidentifier() else None


def noise_sources(scenario: Scenario, *, is_replay: bool) -> dict[str, str]:
    """Return the names of what has random numbers, by the dotted keys of their seeds.

    Components whose table has a seed, and, in a run, actions with noise or lost samples: a replay
    follows those that were recorded.
    """
    keys = {}
    for name, table in scenario.tree["components"].items():
        if table.get("seed") is not None:
            keys[short(f"{COMPONENTS}.{name}.seed")] = name
    for number, action in scenario.actions.items():
        loses = action.drop is not None and not isinstance(action.drop, bool)
        if not is_replay and (action.noise is not None or loses):
            keys[f"{ACTIONS}.{number}.seed"] = f"{ACTIONS}.{number}"
    return keys
