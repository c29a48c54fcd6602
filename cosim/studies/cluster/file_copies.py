"""The files of a study on a worker: those that the planner has, or copies of them.

Copies stand in one folder under the paths that the files have where the study is planned, so that
what one says of another by a relative path still holds; absolute paths in the copy of the scenario
are those of the copies. A worker keeps the content of every file
that it was sent by its hash: it is sent once, however many studies have it.
"""

from __future__ import annotations

import hashlib
import os
import re
import secrets
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from cosim.digests import sha256_of

STORE: Final = "cosim-files"
FOLDER: Final = "cosim-studies"


def has_all(files: Mapping[str, str]) -> bool:
    """Return whether this machine has all files under the same paths: their storage is shared."""
    return all(_has(path, digest) for path, digest in files.items())


def missing_content(folder: Path, files: Mapping[str, str]) -> list[str]:
    """Return the hashes of the files whose content a worker does not have, under any path.

    Parameters
    ----------
    folder : Path
        The worker's own.
    files : mapping of absolute path to SHA-256
    """
    wanted = {digest for digest in files.values() if not (folder / STORE / digest).exists()}
    wanted -= {digest for path, digest in files.items() if digest in wanted and _has(path, digest)}
    return sorted(wanted)


def store_content(folder: Path, content: bytes) -> None:
    """Keep the content of a file."""
    store = folder / STORE
    store.mkdir(parents=True, exist_ok=True)
    temporary = store / f"{secrets.token_hex(8)}.tmp"
    temporary.write_bytes(content)
    os.replace(temporary, store / hashlib.sha256(content).hexdigest())


def place_copies(folder: Path, study: str, files: Mapping[str, str]) -> Path:
    """Put the files of a study into one folder; return it.

    Parameters
    ----------
    folder : Path
        The worker's own.
    study : str
        Name of the study's folder.
    files : mapping of absolute path to SHA-256
        Their content is there, as :func:`missing_content` says.
    """
    root = folder / FOLDER / study
    for path, digest in files.items():
        copy = Path(moved(path, str(root)))
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.unlink(missing_ok=True)
        stored = folder / STORE / digest
        shutil.copyfile(stored if stored.exists() else _source(files, digest), copy)
    return root


def named_files(value: Any, files: Mapping[str, str]) -> dict[str, str]:
    """Return the absolute paths that tables name, with those under which the files are known.

    Parameters
    ----------
    value
        Tables, lists, and what is in them.
    files : mapping of absolute path to SHA-256
    """
    match value:
        case str():
            path = value.partition("#")[0]
            known = path if path in files else os.path.realpath(path)
            return {path: known} if os.path.isabs(path) and known in files else {}
        case Mapping():
            return named_files(list(value.values()), files)
        case list() | tuple():
            found: dict[str, str] = {}
            for entry in value:
                found |= named_files(entry, files)
            return found
        case _:
            return {}


def name_copies(scenario: Path, named: Mapping[str, str], root: str) -> None:
    """Replace the paths that a scenario names by those of the copies.

    Parameters
    ----------
    scenario : Path
        A copy.
    named : mapping of path to path
        As of :func:`named_files`.
    root : str
        Folder of the copies.
    """
    text = scenario.read_text(encoding="utf-8")
    for path, known in named.items():
        quoted = re.compile(f"(?<=[\"']){re.escape(path)}(?=[\"'#])")
        text = quoted.sub(moved(known, root).replace("\\", r"\\"), text)
    scenario.write_text(text, encoding="utf-8")


def remove_copies(folder: Path, study: str) -> None:
    """Remove the folder of a study."""
    shutil.rmtree(folder / FOLDER / study, ignore_errors=True)


def moved(path: str, root: str) -> str:
    """Return where the copy of a file is."""
    return os.path.join(root, path.replace(":", "").lstrip("/\\"))


def with_copies(value: Any, files: Mapping[str, str], root: str) -> Any:
    """Return a value in which the paths of files are those of their copies.

    What follows a path, as in ``x.fmu#cs``, stays.
    """
    match value:
        case str():
            path, mark, rest = value.partition("#")
            return moved(path, root) + mark + rest if path in files else value
        case Mapping():
            return {
                with_copies(key, files, root): with_copies(entry, files, root)
                for key, entry in value.items()
            }
        case list() | tuple():
            return [with_copies(entry, files, root) for entry in value]
        case _:
            return value


def _source(files: Mapping[str, str], digest: str) -> str:
    """Return the path of a file with some content."""
    return next(path for path, other in files.items() if other == digest and _has(path, digest))


def _has(path: str, digest: str) -> bool:
    """Return whether a file has some content."""
    try:
        return sha256_of(path) == digest
    except OSError:
        return False
