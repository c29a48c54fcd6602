"""The command that runs a member of a study on its own, to the bit."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cosim.log.foreign.topics import is_foreign
from cosim.scenario.document.edits import parse_value
from cosim.studies.contracts import StudyMember
from cosim.studies.document.study_file import StudyFile


def run_command(member: StudyMember, study: StudyFile) -> str:
    """Return the line for a shell that runs a member: ``cosim run``, or ``cosim replay``.

    Read by a POSIX shell and by the command, its edits are those of the member, bit for bit.
    """
    settings = study.settings
    if member.recording is None:
        words = ["cosim", "run", study.scenario]
    else:
        words = ["cosim", "replay", member.recording]
        if is_foreign(Path(member.recording)):
            words += ["--scenario", study.scenario]
    for name, path in {**settings.swap, **member.swap}.items():
        words += ["--swap", f"{name}={path}"]
    for port, names in settings.map.items():
        words += ["--map", f"{port}={_port_names(names)}"]
    for key, value in {**settings.set, **member.set}.items():
        words += ["--set", f"{key}={toml_text(value)}"]
    if settings.allow_code and member.recording is not None:
        words.append("--allow-code")
    return shlex.join(words)


def _port_names(names: str | Sequence[str]) -> str:
    return names if isinstance(names, str) else f"[{','.join(names)}]"


def toml_text(value: Any) -> str:
    """Return a value as ``--set`` reads it: TOML, or a string that it takes for no other value."""
    if isinstance(value, str) and _is_plain(value):
        return value
    return _toml(value)


def _is_plain(text: str) -> bool:
    return bool(text) and text == text.strip() and parse_value(text) == text


def _toml(value: Any) -> str:
    match value:
        case bool():
            return "true" if value else "false"
        case str():
            # TOML has the escapes of JSON, and wants one for DEL, too.
            return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
        case Mapping():
            entries = [f"{_toml(key)} = {_toml(item)}" for key, item in value.items()]
            return f"{{{', '.join(entries)}}}"
        case list() | tuple():
            return f"[{', '.join(_toml(item) for item in value)}]"
        case _:
            return repr(value)
