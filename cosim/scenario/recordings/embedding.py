"""The FMUs of a run in its log: put there as they are, and taken out again, by their SHA-256.

An FMU is code. What is taken out, or is found where the log says that it was, is what the run had,
bit for bit, or it is refused. It is copied into a folder of our own under a name that is its hash:
no name that a log has becomes a path. The copy is unpacked as any FMU is
(:mod:`cosim.fmi.reading.archive`).
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Final

from cosim.core.recording import CompleteRecording
from cosim.errors import FmuError, LogError, flag, quoted
from cosim.files import read_bounded
from cosim.log import Attachment, Log
from cosim.log.reading.container import MOST_ATTACHED
from cosim.scenario.kinds.build_record import RecordedFmu
from cosim.scenario.record import MEANS, component_metadata, component_record
from cosim.temporary import TemporaryFolder

MOST_EMBEDDED: Final = MOST_ATTACHED - 2**12  # bytes; the record of an attachment has a head, too
_SHA256: Final = re.compile(r"[0-9a-f]{64}")


def embedded_name(sha256: str) -> str:
    """Return the name of the attachment that an FMU is, by its hash."""
    return f"{sha256}.fmu"


def embedded_fmus(files: Mapping[str, Path]) -> list[Attachment]:
    """Return FMUs as attachments of a log.

    Parameters
    ----------
    files : mapping of SHA-256 to Path

    Raises
    ------
    FmuError
        If one is too large to be read back, or is not the one any more that was opened.
    """
    attachments = []
    for sha256, path in files.items():
        try:
            size = path.stat().st_size
            if size > MOST_EMBEDDED:
                raise FmuError(
                    f"{path}: has {size} bytes, but a log takes FMUs of at most {MOST_EMBEDDED}; "
                    f"omit {flag('embed')}"
                )
            content = read_bounded(path, MOST_EMBEDDED)
        except OSError as error:
            raise FmuError(f"{path} cannot be read: {error.strerror or error}") from error
        if hashlib.sha256(content).hexdigest() != sha256:
            raise FmuError(f"{path}: changed while it was being read; try again")
        attachments.append(Attachment(embedded_name(sha256), "application/zip", content))
    return attachments


def recorded_fmus(
    source: CompleteRecording, paths: Mapping[str, str], resources: ExitStack
) -> dict[str, RecordedFmu]:
    """Return copies of the FMUs that components had in a recorded run, by component.

    Parameters
    ----------
    source : CompleteRecording
    paths : mapping of component name to path
        Where each is, if it is not embedded.
    resources : ExitStack
        Removes the copies.

    Raises
    ------
    LogError
        If the log does not say which FMU a component had.
    FmuError
        If there is no such FMU, or another one in its place.
    """
    if not paths:
        return {}
    folder = resources.enter_context(TemporaryFolder("fmu"))
    copies = {}
    for name, path in paths.items():
        record = component_record(source, name)
        sha256 = record.sha256
        if sha256 is None or not _SHA256.fullmatch(sha256):
            raise LogError(
                f"{source.label}: SHA-256 of the FMU of {name!r}: expected 64 hexadecimal digits, "
                f"got {quoted(sha256)}"
            )
        candidates = [path] if record.path is None else [path, record.path]
        content = _content(source, name, sha256, candidates)
        copy = folder / embedded_name(sha256)
        copy.write_bytes(content)
        means = MEANS not in component_metadata(source, name)
        copies[name] = RecordedFmu(copy, record.path or path, means)
    return copies


def _content(source: CompleteRecording, name: str, sha256: str, paths: Iterable[str]) -> bytes:
    """Return the bytes of an FMU: those in the log, else those of a file, if they are the same."""
    attached = embedded_name(sha256)
    if attached in source.attachments:
        content = source.attachment(attached)
        _check(name, f"the FMU in {source.label}", content, sha256)
        return content
    # relative to the working folder; who is in another one has them beside the log, or above it
    folders = source.path.parents[:2] if isinstance(source, Log) else []
    tried = list(dict.fromkeys(paths))
    others: dict[str, bytes] = {}
    for path in [*tried, *(str(folder / path) for folder in folders for path in tried)]:
        try:
            content = read_bounded(Path(path), MOST_EMBEDDED)
        except OSError:
            continue
        if hashlib.sha256(content).hexdigest() == sha256:
            return content
        others.setdefault(path, content)
    for path, content in others.items():
        _check(name, path, content, sha256)
    raise FmuError(
        f"the FMU of {name!r} is neither in the log nor in a readable file: {', '.join(tried)}; "
        f"restore one of them, or record with {flag('embed')} to put the FMU into the log"
    )


def _check(name: str, place: str, content: bytes, sha256: str) -> None:
    found = hashlib.sha256(content).hexdigest()
    if found != sha256:
        raise FmuError(
            f"the FMU of {name!r}: {place}: expected the SHA-256 {sha256} that the log recorded, "
            f"got {found}; it is not run"
        )
