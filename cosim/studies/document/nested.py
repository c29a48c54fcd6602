"""Dotted keys that a file wrote without quotes, so that TOML made tables of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from cosim.scenario.document.edits import COMPONENTS, short
from cosim.scenario.document.problems import Key
from cosim.studies.contracts import SWAP
from cosim.studies.document.variations import FORMS

Written = dict[str, Key]  # how an entry was written, by its key


def flat_edits(table: Mapping[str, Any]) -> tuple[dict[str, Any], Written]:
    """Return edits with a dotted key each, and how these were written.

    A table under a key without a dot has the parameters of a component.
    """
    flat: dict[str, Any] = {}
    written: Written = {}
    for key, value in table.items():
        if isinstance(value, Mapping) and "." not in key:
            for name, item in value.items():
                _enter(flat, written, (key, name), item, short)
        else:
            _enter(flat, written, (key,), value, short)
    return flat, written


def flat_variations(table: Mapping[str, Any]) -> tuple[dict[str, Any], Written]:
    """Return the entries of [vary] with a dotted key each, and how these were written.

    A list under a key without a dot has the paths of a swapped component: ``swap.plant``.
    """
    flat: dict[str, Any] = {}
    written: Written = {}
    for key, value in table.items():
        if "." in key:
            _enter(flat, written, (key,), value)
        elif isinstance(value, Mapping) and not _is_varied(value):
            _descend(flat, written, (key,), value)
        else:
            flat[f"{SWAP}{key}"] = _paths(value)
            written[f"{SWAP}{key}"] = (key,)
    return flat, written


def varied_key(key: str) -> str:
    """Return the key of what is varied: a component without a parameter is swapped."""
    key = short(key)
    name = key.removeprefix(f"{COMPONENTS}.")
    return key if "." in name else f"{SWAP}{name}"


def _is_varied(value: Any) -> bool:
    """Return whether a table says what a key is varied by; others have keys inside."""
    if not isinstance(value, Mapping):
        return True
    entries = [value[name] for name in FORMS if name in value]
    return any(not isinstance(entry, Mapping) and entry is not None for entry in entries)


def _descend(flat: dict[str, Any], written: Written, path: Key, table: Mapping[str, Any]) -> None:
    for name, value in table.items():
        inner = (*path, name)
        if _is_varied(value):
            _enter(flat, written, inner, value)
        else:
            _descend(flat, written, inner, value)


def _enter(
    flat: dict[str, Any],
    written: Written,
    path: Key,
    value: Any,
    form: Callable[[str], str] = varied_key,
) -> None:
    key = form(".".join(map(str, path)))
    flat[key] = _paths(value) if key.startswith(SWAP) else value
    written[key] = path


def _paths(value: Any) -> Any:
    """Return the paths of a swap: of a list in a list, as the command line reads it, the inner."""
    if isinstance(value, list) and len(value) == 1 and isinstance(value[0], list):
        return value[0]
    return value
