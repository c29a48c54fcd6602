"""A log as a file of another format: written under a hidden name, then moved to its own."""

from __future__ import annotations

import io
from pathlib import Path
from typing import BinaryIO, Final

from cosim.errors import LogError, UsageError
from cosim.log.conversion.arrays import write_mat, write_npz
from cosim.log.conversion.choice import LogChoice
from cosim.log.conversion.parquet import need_pyarrow, write_parquet
from cosim.log.conversion.text import csv_text
from cosim.log.mcap_file.unfinished import UnfinishedLog

ENDINGS: Final = (".csv", ".parquet", ".mat", ".npz")

_BUFFER_BYTES: Final = 2**20


def free_target(out: Path, *, force: bool = False) -> UnfinishedLog:
    """Return where a log is converted to; check that it can be, before the log is read.

    Raises
    ------
    UsageError
        If its ending is not that of a known format, or a library for that is missing.
    LogError
        If a file exists there and is not to be replaced, or none can be written.
    """
    ending = out.suffix.lower()
    if ending not in ENDINGS:
        found = repr(out.suffix) if out.suffix else "none"
        raise UsageError(
            f"{out}: expected a file extension among {', '.join(ENDINGS)}, got {found}"
        )
    if ending == ".parquet":
        need_pyarrow()
    target = UnfinishedLog(out, force=force)
    target.check_free()
    return target


def convert(choice: LogChoice, out: Path, *, force: bool = False) -> None:
    """Write signals to a file, in the format that its ending names.

    Parameters
    ----------
    choice : LogChoice
    out : Path
        Ends in .csv, .parquet, .mat or .npz.
    force : bool
        Replace an existing file.

    Raises
    ------
    UsageError
        As :func:`free_target`, or if an array is too large for MAT.
    LogError
        If the log is damaged, or the file cannot be written.
    """
    target = free_target(out, force=force)
    try:
        with io.BufferedWriter(target.create(), _BUFFER_BYTES) as stream:
            _write(stream, choice, out.suffix.lower())
        target.publish()
    except OSError as error:
        raise LogError(f"{out} cannot be written: {error.strerror or error}") from error
    finally:
        target.discard()


def _write(stream: BinaryIO, choice: LogChoice, ending: str) -> None:
    match ending:
        case ".npz":
            write_npz(stream, choice)
        case ".mat":
            write_mat(stream, choice)
        case ".parquet":
            write_parquet(stream, choice)
        case _:
            for text in csv_text(choice):
                stream.write(text.encode())
