"""Paths of a study, which are relative to its file, or to the working directory for options."""

from __future__ import annotations

import os
from collections.abc import Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any

from cosim.files import expanded, file_type
from cosim.scenario.document.document import shipped
from cosim.studies.contracts import SWAP


def absolute(text: Any, folder: Path) -> Any:
    """Return a path in a folder as an absolute one; what is no text is left to the schema.

    What follows the path, as in ``x.fmu#cs``, stays.
    """
    return os.path.normpath(folder / expanded(text)) if isinstance(text, str) and text else text


def scenario_path(text: Any, folder: Path) -> Any:
    """Return the name of a shipped scenario as it is, else an absolute path."""
    if isinstance(text, str) and file_type(text) is None and text in shipped():
        return text
    return absolute(text, folder)


def with_absolute_paths(tables: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return the tables of a study with absolute paths; they have one dotted key an entry."""
    changed = deepcopy(dict(tables))
    settings = changed.get("study")
    if isinstance(settings, dict):
        if "cases" in settings:
            settings["cases"] = absolute(settings["cases"], folder)
        if "replay" in settings:
            settings["replay"] = _each(settings["replay"], folder)
        if isinstance(settings.get("swap"), dict):
            settings["swap"] = {
                name: absolute(path, folder) for name, path in settings["swap"].items()
            }
    vary = changed.get("vary")
    if isinstance(vary, dict):
        for key, value in vary.items():
            if key.startswith(SWAP):
                vary[key] = _of_entry(value, folder)
    return changed


def _each(value: Any, folder: Path) -> Any:
    if isinstance(value, list | tuple):
        return [absolute(path, folder) for path in value]
    return absolute(value, folder)


def _of_entry(value: Any, folder: Path) -> Any:
    """Return what a swap is varied by with absolute paths."""
    if not isinstance(value, dict):
        return _each(value, folder) if isinstance(value, list) else value
    lists = {name: value[name] for name in ("values", "choice") if name in value}
    return {**value, **{name: _each(paths, folder) for name, paths in lists.items()}}
