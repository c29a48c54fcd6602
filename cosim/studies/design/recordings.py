"""The logs of a study that replays: paths and patterns, each log once."""

from __future__ import annotations

import glob
import os
from collections.abc import Iterable

from cosim.errors import UsageError, option, quoted
from cosim.files import file_type


def find_recordings(patterns: str | Iterable[str] | None) -> tuple[str, ...]:
    """Return the logs that patterns match, those of each pattern sorted.

    Raises
    ------
    UsageError
        If a pattern matches nothing, or what is no log.
    """
    if patterns is None:
        return ()
    found: dict[str, None] = {}
    for pattern in [patterns] if isinstance(patterns, str) else patterns:
        is_path = os.path.exists(pattern)  # also where it has a bracket in its name
        paths = [pattern] if is_path else sorted(glob.glob(pattern, recursive=True))
        if not paths:
            raise UsageError(
                f"{option('replay')}: no file matches {quoted(pattern)}; expected logs (.mcap)"
            )
        for path in paths:
            if file_type(path) != "log":
                raise UsageError(f"{option('replay')}: {path}: expected a log (.mcap)")
        found |= dict.fromkeys(paths)
    return tuple(found)
