"""Child processes: what they are given, how they end, and command lines of cosim in one."""

from __future__ import annotations

import atexit
import ctypes
import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, NamedTuple

from cosim.errors import RunError
from cosim.temporary import TemporaryFolder

# set in a child that does a command of its parent: the columns of the terminal; 0: there is none
COMMAND_VARIABLE: Final = "COSIM_COMMAND"
_PARENT_VARIABLE: Final = "COSIM_PARENT"  # set in a child: the process that waits for it
_ENDED_VARIABLE: Final = "COSIM_ENDED"  # set in a child: the file that it makes at its own end
_PR_SET_PDEATHSIG: Final = 1  # of linux/prctl.h
_IMPORTED_FROM: Final = Path(__file__).parents[1]
# of the libraries that start one for each core: as many processes would have the square of that
_THREAD_VARIABLES: Final = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "BLIS_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "NUMEXPR_NUM_THREADS",
)


class CommandResult(NamedTuple):
    """What a command printed, and how it ended."""

    output: str
    messages: str
    exit_code: int


def run_command(arguments: Sequence[str], *, columns: int | None) -> CommandResult:
    """Run a command line of cosim in a child process, in this working directory.

    Parameters
    ----------
    arguments : sequence of str
    columns : int or None
        Of the terminal that shows what it prints; None: it is a file or a pipe.

    Raises
    ------
    RunError
        If the child crashes, or code that it runs ends it.
    """
    with TemporaryFolder("command") as folder:
        ended = folder / "ended"
        environment = child_environment(folder, COMMAND_VARIABLE, str(columns or 0))
        child = subprocess.Popen(
            [sys.executable, "-m", "cosim", *arguments],
            env=environment | {_ENDED_VARIABLE: str(ended)},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            encoding="utf-8",
            errors="replace",
            start_new_session=True,
        )
        try:
            output, messages = child.communicate()
        finally:
            kill(child)
        ended_itself = ended.exists()
    if child.returncode < 0:
        ending = describe_exit(child.returncode)
        raise RunError(f"{messages}the process that loaded FMUs and classes {ending}")
    if not ended_itself:
        raise RunError(
            f"{messages}the process that loaded FMUs and classes was ended by one of them, with "
            f"exit code {child.returncode}"
        )
    return CommandResult(output, messages, child.returncode)


def child_environment(folder: Path, variable: str, value: str = "1") -> dict[str, str]:
    """Return one in which the child finds this package, and keeps temporary files in ``folder``.

    ``variable`` says to the child what it is.
    """
    inherited = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    import_paths = [str(_IMPORTED_FROM), *filter(None, inherited)]
    added = {
        "PYTHONPATH": os.pathsep.join(import_paths),
        variable: value,
        _PARENT_VARIABLE: str(os.getpid()),
        "PYTHONIOENCODING": "utf-8",
    }
    return os.environ | added | dict.fromkeys(("TMPDIR", "TEMP", "TMP"), str(folder))


def with_one_thread(environment: Mapping[str, str]) -> dict[str, str]:
    """Return it with one thread for numerical libraries, where it does not say how many."""
    return dict.fromkeys(_THREAD_VARIABLES, "1") | dict(environment)


def describe_exit(exit_code: int) -> str:
    """Say how a child that did not come to its own end was ended.

    ``crashes: SIGSEGV``, or ``ends the process with exit code 0``.

    Parameters
    ----------
    exit_code : int
        As :class:`subprocess.Popen` has it: of a signal, negative.
    """
    if exit_code >= 0:
        return f"ends the process with exit code {exit_code}"
    try:
        name = signal.Signals(-exit_code).name
    except ValueError:  # one of those for real time has no name
        name = f"signal {-exit_code}"
    return f"crashes: {name}"


def note_own_end() -> None:
    """Let this child tell its parent that it came to its end; ``exit`` of C in an FMU does not."""
    path = os.environ.get(_ENDED_VARIABLE)
    if path is not None:
        atexit.register(Path(path).touch)


def end_with_parent() -> None:
    """Let the kernel end this child when the process that waits for it ends; on Linux."""
    parent = os.environ.get(_PARENT_VARIABLE)
    if sys.platform == "linux" and parent is not None:
        with suppress(AttributeError):  # no prctl in this C library
            ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
        if parent != str(os.getppid()):
            os._exit(1)  # it ended before


def leave_no_core() -> None:
    """Let this process write no file of its memory where it crashes."""
    with suppress(ImportError):
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def kill(child: subprocess.Popen[Any]) -> None:
    """End a child that leads a session of its own, and what it started."""
    with suppress(ProcessLookupError, PermissionError):
        if sys.platform == "win32":
            child.kill()
        else:
            os.killpg(child.pid, signal.SIGKILL)
    child.wait()
