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

from cosim.temporary import TemporaryFolder

# set in a child that does a command of its parent: the columns of the terminal; 0: there is none
COMMAND_VARIABLE: Final = "COSIM_COMMAND"
_PARENT_VARIABLE: Final = "COSIM_PARENT"  # set in a child: the process that waits for it
_ENDED_VARIABLE: Final = "COSIM_ENDED"  # set in a child: the file that it makes at its own end
_LIMIT_VARIABLE: Final = "COSIM_LIMIT"  # set in a child: how long a call may take there [s]
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
    """What a command printed, and how it ended.

    ``failure`` says how foreign code ended it; empty: it came to its own end.
    """

    output: str
    messages: str
    exit_code: int
    failure: str


def run_command(arguments: Sequence[str], *, columns: int | None, limit: float) -> CommandResult:
    """Run a command line of cosim in a child process, in this working directory.

    Parameters
    ----------
    arguments : sequence of str
    columns : int or None
        Of the terminal that shows what it prints; None: it is a file or a pipe.
    limit : float
        How long a call of foreign code may take [s]; the child keeps it (:func:`call_limit`).
    """
    with TemporaryFolder("command") as folder:
        ended, output, messages = (folder / name for name in ("ended", "output", "messages"))
        environment = child_environment(folder, COMMAND_VARIABLE, str(columns or 0))
        # files, as a pipe has no end as long as a process that an FMU started lives on
        with output.open("wb") as stdout, messages.open("wb") as stderr:
            exit_code = run_child(
                ["cosim", *arguments],
                environment | {_ENDED_VARIABLE: str(ended), _LIMIT_VARIABLE: repr(limit)},
                streams=(stdout, stderr),
            )
        printed, said = (path.read_text("utf-8", "replace") for path in (output, messages))
        ended_itself = ended.exists()
    assert exit_code is not None  # there is no limit
    failure = ""
    if sys.platform != "win32" and exit_code == -signal.SIGALRM:
        failure = f"was ended, as a call did not return within {limit:g} s"
    elif exit_code < 0:
        failure = describe_exit(exit_code)
    elif not ended_itself:
        failure = f"was ended by one of them, with exit code {exit_code}"
    return CommandResult(printed, said, exit_code, failure)


def run_child(
    module: Sequence[str],
    environment: Mapping[str, str],
    *,
    folder: Path | None = None,
    streams: tuple[Any, Any] = (subprocess.DEVNULL, subprocess.DEVNULL),
    timeout: float | None = None,
) -> int | None:
    """Run a module of Python in a process that leads a session; nothing of it is left behind.

    Return its exit code; None: it did not end in time.

    Parameters
    ----------
    module : sequence of str
        Its name, then its arguments.
    environment : mapping
    folder : Path or None
        That it works in; None: this one.
    streams : tuple
        Its stdout and stderr, as of :mod:`subprocess`; no pipes.
    timeout : float or None
        After it the child and what it started are killed [s].
    """
    child = subprocess.Popen(
        [sys.executable, "-m", *module],
        cwd=folder,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=streams[0],
        stderr=streams[1],
        start_new_session=True,
    )
    try:
        return child.wait(timeout)
    except subprocess.TimeoutExpired:
        return None
    finally:
        kill(child)


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


def call_limit() -> float:
    """Return how long a call may take in this child [s]; infinity: there is no limit."""
    return float(os.environ.get(_LIMIT_VARIABLE, "inf"))


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
