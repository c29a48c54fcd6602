"""What is said of a run whose log went on in further files: none of them is the whole."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeGuard

from cosim.core.recorded.signals import warning_texts
from cosim.instants import NANOSECONDS
from cosim.log import Log
from cosim.log.contents.result import PARTIAL, PARTIAL_STATUS
from cosim.log.mcap_file.rotation import part_paths
from cosim.report.tables.console import new_table, print_json, print_line, print_table


def is_rotated(recording: object) -> TypeGuard[Log]:
    """Return whether a recording is the last file of several."""
    return (
        isinstance(recording, Log)
        and recording.status == PARTIAL_STATUS
        and len(part_paths(recording.path)) > 1
    )


def print_rotated(last: Log, *, wall: Mapping[str, float], as_json: bool, quiet: bool) -> None:
    """Print how a run ended and which files it wrote.

    Parameters
    ----------
    last : Log
        The last of them.
    wall : mapping of name to float
        Wall times [s].
    as_json, quiet : bool
    """
    content = _content(last)
    if as_json:
        print_json({**content, "results": dict(last.results), "wall": dict(wall)})
        return
    if quiet:
        return
    for text in warning_texts(last.warnings):
        print_line(f"warning: {text}", error=True)
    table = new_table("", ("", ""))
    table.add_row("status", f"{content['status']}{_behind(content['reason'])}")
    table.add_row("steps", f"{content['steps']}, up to {content['end']} s")
    table.add_row("content hash", str(content["content_hash"]))
    for path in content["logs"]:
        table.add_row("log", path)
    print_table(table)
    print_line(
        "each file has a part of the run; 'cosim merge' joins them, and 'cosim replay' of the last "
        "one replays the run"
    )


def _content(last: Log) -> dict[str, Any]:
    whole = last.metadata.get(PARTIAL, {})
    return {
        "logs": [str(path) for path in part_paths(last.path)],
        "status": whole.get("status", ""),
        "reason": whole.get("reason", ""),
        "steps": last.steps,
        "end": last.end_ns / NANOSECONDS,
        "content_hash": whole.get("content_hash", ""),
    }


def _behind(reason: str) -> str:
    return f", {reason}" if reason else ""
