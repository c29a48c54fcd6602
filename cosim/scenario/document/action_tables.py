"""The tables of [[actions]] by themselves: what happens, to what, and when."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from pydantic import ValidationError

from cosim.scenario.document.problems import Key, Problem, problems_of
from cosim.scenario.document.schema import ActionTable

EFFECTS: Final = (
    "override",
    "freeze",
    "offset",
    "gain",
    "drift",
    "noise",
    "drop",
    "delay",
    "release",
    "set",
    "swap",
)  # keys of what happens; an action has one of them
SWITCHES: Final = ("freeze", "drop", "release")  # that may be true, and not false


def validate_actions(
    tables: Sequence[Mapping[str, Any]],
) -> tuple[dict[int, ActionTable], list[Problem]]:
    """Return the actions that are right by themselves, by their numbers, and the problems."""
    actions: dict[int, ActionTable] = {}
    problems: list[Problem] = []
    for number, table in enumerate(tables):
        key: Key = ("actions", number)
        try:
            action = ActionTable.model_validate(table)
        except ValidationError as error:
            problems += problems_of(error, ActionTable, table, key)
            continue
        own = _problems(action)
        if own:
            problems += [((*key, *inner), text) for inner, text in own]
        else:
            actions[number] = action
    return actions, problems


def effect_of(action: ActionTable) -> str:
    """Return the key of what happens, of an action that is right."""
    return _effects(action)[0]


def _effects(action: ActionTable) -> list[str]:
    return [name for name in EFFECTS if getattr(action, name) is not None]


def signals_of(action: ActionTable) -> list[str]:
    """Return the names of the signals that an action is about, none where it sets parameters."""
    if action.signal is None:
        return []
    return [action.signal] if isinstance(action.signal, str) else action.signal


def _problems(action: ActionTable) -> list[Problem]:
    """Return what is wrong with an action by itself."""
    problems: list[Problem] = []
    if (action.at is None) == (action.when is None):
        found = "neither" if action.at is None else "both"
        text = f"expected either 'at' (a time [s]) or 'when' (a condition), got {found}"
        problems.append(((), text))
    of_components = [name for name in ("set", "swap") if getattr(action, name) is not None]
    if of_components and action.signal is not None:
        text = f"not allowed with '{of_components[0]}'; write a separate action"
        problems.append((("signal",), text))
    if not of_components and not signals_of(action):
        problems.append(((), "'signal' is missing; expected an input, such as plant.u"))
    effects = _effects(action)
    if len(effects) != 1:
        found = " and ".join(effects) or "none"
        problems.append(((), f"expected exactly one of {', '.join(EFFECTS)}, got {found}"))
    if action.set == {}:
        problems.append((("set",), "expected a parameter and its value, got an empty table"))
    if action.swap == {}:
        problems.append((("swap",), "expected a component and its .fmu, got an empty table"))
    for name in SWITCHES:
        if getattr(action, name) is False:
            problems.append(((name,), "expected true, got False"))
    is_random = action.noise is not None or (
        action.drop is not None and not isinstance(action.drop, bool)
    )
    if action.seed is not None and not is_random:
        problems.append((("seed",), "allowed only with random numbers (noise, drop)"))
    return problems
