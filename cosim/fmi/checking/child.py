"""Try a foreign binary in a child process: what crashes, hangs or lies does it there. ``trial.py`` is what the child runs."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Final, Literal, TypeAlias

if TYPE_CHECKING:
    from cosim.fmi.description import InterfaceType
    from cosim.fmi.reading.model_description import Archive

Task: TypeAlias = Literal["symbols", "run", "rollback"]

TIMEOUT: Final = 20.0  # [s] of wall time
INSIDE: Final = "COSIM_TRIAL"  # set in the child: a trial inside a trial is none
MISSING: Final = "missing function"
ROOT: Final = Path(__file__).parents[3]


def can_roll_back(
    archive: Archive, interface_type: InterfaceType, *, timeout: float = TIMEOUT
) -> tuple[str, ...]:
    """Say why get and set FMU state of an FMU cannot be relied on; empty: they can.

    The answer is kept for the life of the process: the trial starts one, which takes about half a second.

    Parameters
    ----------
    archive : Archive
    mode : Mode
        A kind that says that it can (``saves_state``).
    timeout : float
        Of the trial [s].
    """
    return (
        ()
        if INSIDE in os.environ
        else _can_roll_back(archive.path.resolve(), archive.sha256, interface_type, timeout)
    )


@lru_cache(maxsize=256)
def _can_roll_back(
    path: Path, sha256: str, interface_type: InterfaceType, timeout: float
) -> tuple[str, ...]:
    return attempt("rollback", str(path), interface_type, timeout=timeout)


def attempt(task: Task, *arguments: str, timeout: float = TIMEOUT) -> tuple[str, ...]:
    """Do a task in a child process; give what is wrong, empty where nothing is.

    Parameters
    ----------
    task : Task
        ``symbols LIBRARY NAME...``: load the library and look the functions up. ``run PATH MODE``: instantiate, initialize,
        read, step, terminate, free. ``rollback PATH MODE``: save and restore in the midst of a run.
    arguments : str
    timeout : float
        After it the child and what it started are killed [s].
    """
    with TemporaryDirectory(prefix="cosim-trial-", ignore_cleanup_errors=True) as folder:
        result = Path(folder) / "result"
        result.touch()
        command = [sys.executable, "-m", "cosim.fmi.checking.trial", task, str(result), *arguments]
        child = subprocess.Popen(
            command,
            cwd=folder,
            env=_environment(folder),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            ended: int | None = child.wait(timeout)
        except subprocess.TimeoutExpired:
            ended = None
        finally:
            _kill(child)
        return _verdict(result.read_text(encoding="utf-8", errors="replace"), ended, timeout)


def _environment(folder: str) -> dict[str, str]:
    """Let the child find this package, and keep its temporary files where they are removed."""
    paths = [str(ROOT), *os.environ.get("PYTHONPATH", "").split(os.pathsep)]
    own = {"PYTHONPATH": os.pathsep.join(path for path in paths if path), INSIDE: "1"}
    return os.environ | own | dict.fromkeys(("TMPDIR", "TEMP", "TMP"), folder)


def _kill(child: subprocess.Popen[bytes]) -> None:
    """End the child and what it started."""
    with suppress(ProcessLookupError, PermissionError):
        if sys.platform == "win32":
            child.kill()
        else:
            os.killpg(child.pid, signal.SIGKILL)
    child.wait()


def _verdict(story: str, ended: int | None, timeout: float) -> tuple[str, ...]:
    lines: list[dict[str, str]] = []
    for line in story.splitlines():
        with suppress(ValueError):  # the last one may be cut
            lines.append(json.loads(line))
    problems = [line["problem"] for line in lines if "problem" in line]
    where = next(
        (line["at"] for line in reversed(lines) if "at" in line), "the start of the process"
    )
    if ended is None:
        problems.append(f"hangs: did not end within {timeout:g} s, at: {where}")
    elif ended < 0:
        problems.append(f"crashes: {signal.Signals(-ended).name} at: {where}")
    elif not any("done" in line for line in lines):
        problems.append(f"ends the process with exit code {ended} at: {where}")
    return tuple(problems)
