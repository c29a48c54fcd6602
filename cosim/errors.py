"""The errors of cosim.

::

    CosimError
    ├── UsageError            found before the first step; exit 2
    │   ├── ScenarioError     a scenario file: every problem of the file in one report
    │   ├── GraphError        components and connections that do not fit together
    │   │   ├── AlgebraicLoopError
    │   │   └── RollbackError     components that would have to go back, and cannot
    │   ├── ClockError        a time, step or period that is off the grid
    │   ├── AssumptionError   an assumption of the method that does not hold
    │   │   └── StartError    an iteration cannot start where it should; another start may do
    │   ├── FmuError          an FMU that cannot be used, or a model that cannot become one
    │   ├── LogError          a log that cannot be read, or written
    │   │   └── UnknownSignalError   what was not recorded; a KeyError too
    │   └── DatasetError      a study's dataset that is another one's, in use or damaged
    └── RunError              the run began and could not go on; exit 1
        ├── NonFiniteError    the first NaN or infinity, with component, signal and time
        ├── RunawayError      a loop whose values grow without end, step by step
        ├── LogWriteError     a full disk, a lost file; what was written stays valid
        ├── DatasetWriteError the same, of the dataset of a study
        ├── ChangedFileError  a file that a study reads is another one than when it began
        └── Interrupted       Ctrl-C or another signal; exit 128 + its number

    CosimWarning              what a run, a session or a study goes on with; see :func:`warn`

Every message names the thing, what was expected, what was found and the way out, in the language of
the caller: :func:`option` and :func:`flag` name an argument as it is written in Python, or in the
shell under :func:`shell_language`.
"""

from __future__ import annotations

import signal
import sys
import unicodedata
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from difflib import get_close_matches
from importlib import import_module
from typing import Any, Final

MOST_NAMES: Final = 100  # that a message about an unknown name lists

MOST_CHARACTERS: Final = 120  # of a value that a message quotes

_in_shell: ContextVar[bool] = ContextVar("in_shell", default=False)
# What sets keys of a scenario beside ``set``, by the keys
_names_of_keys: ContextVar[Mapping[str, str] | None] = ContextVar("names_of_keys", default=None)


class CosimError(Exception):
    """Base of every deliberate error; ``exit_code`` is what the command line returns."""

    exit_code: int = 1


class UsageError(CosimError):
    """Wrong use, found before the first step."""

    exit_code = 2


class ScenarioError(UsageError):
    """Problems of a scenario file, all of them together."""


class GraphError(UsageError):
    """Components and connections that do not fit together."""


class AlgebraicLoopError(GraphError):
    """Outputs that feed through to each other in an algebraic loop."""


class RollbackError(GraphError):
    """Components of a loop that would have to go back to the start of a step, and cannot."""


class ClockError(UsageError):
    """A time, step or period that is off the integer-nanosecond grid."""


class AssumptionError(UsageError):
    """An assumption of the method that does not hold for the given system.

    Parameters
    ----------
    evidence : str
        What was found and what was expected.
    verdict : str
        The name of what is wrong, such as ``INDEX_2``; empty: it has none.
    cure : str
        The way out; the message ends with it. Empty: the evidence has it.
    """

    def __init__(self, evidence: str, verdict: str = "", cure: str = "") -> None:
        super().__init__(f"{evidence}; {cure}" if cure else evidence)
        self.evidence = evidence
        self.verdict = verdict
        self.cure = cure


class StartError(AssumptionError):
    """An iteration cannot start where it should."""


class FmuError(UsageError):
    """An FMU that cannot be used here, or a model that cannot become one."""


class LogError(UsageError):
    """A log that cannot be read, or written."""


class UnknownSignalError(LogError, KeyError):
    """A component, signal or element that was not recorded."""

    __str__ = Exception.__str__  # not the repr that KeyError shows


class DatasetError(UsageError):
    """A dataset of a study that is another one's, in use, damaged or not there."""


class RunError(CosimError):
    """The run began and could not go on."""


class NonFiniteError(RunError):
    """A signal became NaN or infinite."""


class RunawayError(RunError):
    """The values of a loop grow without end, step by step."""


class LogWriteError(RunError):
    """A log could not be written further; what was written is a valid file."""


class DatasetWriteError(RunError):
    """A dataset could not be written further; the outcomes that were written are there."""


class ChangedFileError(RunError):
    """A file that a study reads is not the one that it began with.

    Parameters
    ----------
    problem : str
        The file and what became of it.
    """

    def __init__(self, problem: str) -> None:
        super().__init__(problem)
        self.problem = problem

    def __str__(self) -> str:
        """Add the way out, in the language of whoever reads it."""
        return (
            f"{self.problem}; put it back as it was to resume the study, or start again with "
            f"{flag('new')}"
        )


class Interrupted(RunError):
    """The user interrupted the run, or a signal from outside did.

    Parameters
    ----------
    text : str
    signal_number : int
        Of what came; the exit code is what a shell says of a program that it killed.
    """

    def __init__(self, text: str, signal_number: int = signal.SIGINT) -> None:
        super().__init__(text)
        self.exit_code = 128 + signal_number


# --- warnings ---


class CosimWarning(UserWarning):
    """What a run, a session or a study warns of, and goes on: ``log.warnings`` has all of them.

    >>> import warnings
    >>> warnings.filterwarnings("error", category=CosimWarning)  # now the first one is raised
    """


def warn(texts: Iterable[str]) -> None:
    """Show warnings to the caller of the package in Python, each text once.

    In the shell there is nothing to do: what a command prints has them.
    """
    if _in_shell.get():
        return
    level = 1
    frame = sys._getframe()
    while frame.f_back is not None and frame.f_globals.get("__name__", "").startswith("cosim."):
        frame = frame.f_back
        level += 1
    for text in dict.fromkeys(texts):
        warnings.warn(text, CosimWarning, stacklevel=level)


# --- the parts of a message ---


def nearest(name: str, known_names: Iterable[str]) -> str:
    """Return the end of a message about an unknown name: the name probably meant, and all names.

    Of very many names it lists the first.
    """
    names = list(known_names)
    if not names:
        return "none is available"
    composed = unicodedata.normalize("NFC", name)
    if name != composed and composed in names:
        return f"expected {composed!r}, composed as Unicode NFC"
    close = get_close_matches(name, names, n=1, cutoff=0.5)
    if close and name not in close[0] and len(close[0]) > 2 * len(name):
        close = []  # few letters are in every long name
    opening = f"did you mean {close[0]!r}? Available" if close else "available"
    return f"{opening}: {listing(names, MOST_NAMES)}"


def listing(names: Sequence[str], most: int = 5) -> str:
    """Return names in one line: the first of them, and how many more there are."""
    text = ", ".join(names[:most])
    omitted = len(names) - most
    return f"{text}, and {omitted} more" if omitted > 0 else text


def names_by_reason(reasons: Mapping[str, str]) -> dict[str, list[str]]:
    """Return for each reason the names that have it, in their order."""
    names: dict[str, list[str]] = {}
    for name, reason in reasons.items():
        names.setdefault(reason, []).append(name)
    return names


def steps_text(steps: float) -> str:
    """Return a number of communication steps in words: ``1 communication step``."""
    return f"{steps:g} communication step{'' if steps == 1 else 's'}"


def quoted(value: object) -> str:
    """Return a value as Python writes it, cut in the middle where it is long."""
    try:
        return shortened(repr(value))
    except (ValueError, RecursionError):  # an integer of thousands of digits, deep nesting
        return f"a value of type {type(value).__name__} that is too long to be shown"


def shortened(text: str, most: int = MOST_CHARACTERS) -> str:
    """Return a text, cut in the middle where it is long."""
    if len(text) <= most:
        return text
    half = most // 2
    return f"{text[:half]}...{text[-half:]}"


@contextmanager
def shell_language() -> Iterator[None]:
    """Name arguments as options of the shell, in every message made inside."""
    token = _in_shell.set(True)
    try:
        yield
    finally:
        _in_shell.reset(token)


@contextmanager
def named_keys(names: Mapping[str, str]) -> Iterator[None]:
    """Name keys of the scenario by the arguments that set them, as ``stop``, in every message."""
    token = _names_of_keys.set({**(_names_of_keys.get() or {}), **names})
    try:
        yield
    finally:
        _names_of_keys.reset(token)


def flag(name: str, value: bool = True) -> str:
    """Name an argument that is true or false: ``force=True``, in the shell ``--force``.

    ``allow_code=True`` is ``--allow-code`` there.
    """
    if _in_shell.get():
        words = name.replace("_", "-")
        return f"--{words}" if value else f"--no-{words}"
    return f"{name}={value}"


def command(name: str) -> str:
    """Name a function of the package: ``cosim.run``, in the shell ``'cosim run'``."""
    return f"'cosim {name}'" if _in_shell.get() else f"cosim.{name}"


def option(name: str, key: str | None = None, value: str | None = None) -> str:
    """Name an argument, an entry of it, or an entry with its value.

    ``stop``, ``set['plant.x']``, ``map={'plant.u': 'force'}``; in the shell ``--stop``,
    ``--set plant.x``, ``--map plant.u=force``. A key that :func:`named_keys` names has that name.
    """
    names = _names_of_keys.get() or {}
    if name == "set" and key is not None and key in names and value is None:
        return names[key]
    if _in_shell.get():
        name = name.replace("_", "-")
        entry = "" if key is None else f" {shortened(key)}"
        return f"--{name}{entry}" if value is None else f"--{name}{entry}={value}"
    if key is None:
        return name
    if value is None:
        return f"{name}[{quoted(key)}]"
    return f"{name}={{{key!r}: {value!r}}}"


def optional_library(name: str, what: str = "studies need", extra: str = "study") -> Any:
    """Return an optional library, or a module of it.

    Parameters
    ----------
    name : str
    what : str
        What needs it: ``plots need``.
    extra : str
        That has it.

    Raises
    ------
    UsageError
        If it is not installed.
    """
    try:
        return import_module(name)
    except ImportError as error:
        package = name.partition(".")[0]
        raise UsageError(
            f"{what} {package}, which is not installed: pip install {package}, or, in a clone of "
            f"cosim, pip install -e '.[{extra}]'"
        ) from error
