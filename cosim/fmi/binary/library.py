"""The binary of an FMU: loaded, its functions bound to one instance, unloaded.

Only declarations are taken from fmpy, not its loading: that leaves the working directory changed and the library in memory where
it fails, and looks for functions which no run needs. The calls of a run go to the library's functions directly, on the memory of
numpy arrays: fmpy's own wrappers build their ctypes arrays anew from lists at every call.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import redirect_stdout
from ctypes import CDLL, c_int, c_uint8, c_void_p
from importlib import import_module
from io import StringIO
from pathlib import Path
from typing import Any, Final, TypeAlias

from numpy.typing import NDArray

from cosim.errors import FmuError, RunError
from cosim.fmi.binary.messages import Messages

Call: TypeAlias = Callable[..., None]

STATUS: Final = ("ok", "warning", "discard", "error", "fatal", "pending")
WARNING, DISCARD, ERROR, FATAL = 1, 2, 3, 4
_Memory = c_uint8 * 1


def pointer(array: NDArray[Any]) -> Any:
    """Point to a contiguous array's memory; quicker than ``array.ctypes``."""
    memory: Any = array
    return _Memory.from_buffer(memory) if array.size else None


def declared(version: str) -> Any:
    """Import fmpy's declarations, of ``fmi1`` or ``fmi2``; where it has no logger for the machine, its import would print."""
    with redirect_stdout(StringIO()):
        return import_module(f"fmpy.{version}")


class Library:
    """The functions of one instance, each checking its status.

    Parameters
    ----------
    path : Path
        The binary.
    prefix : str
        Of its functions.
    name : str
        Stands in messages.
    messages : Messages
        What the FMU logs.

    Raises
    ------
    FmuError
        If it cannot be loaded, with the loader's reason.
    """

    def __init__(self, path: Path, prefix: str, name: str, messages: Messages) -> None:
        self.prefix, self.name, self.messages, self._binary = prefix, name, messages, path.name
        self.instance = c_void_p()  # one object for good, as every call holds it
        self.failed = False  # an error or worse: terminate is no longer allowed
        self._over = ""  # why no call is allowed any more
        try:
            self._dll: CDLL | None = CDLL(str(path))
        except OSError as error:
            raise self.refusal(str(error)) from error

    def refusal(self, reason: str) -> FmuError:
        """Say why the binary is of no use."""
        return FmuError(
            f"{self.name}: the binary {self._binary} cannot be used: {reason}{self.messages.tail}"
        )

    def function(self, name: str, result: Any, *types: Any) -> Any:
        """Give a function of the library.

        Raises
        ------
        FmuError
            If there is none of that name.
        """
        assert self._dll is not None  # nothing is bound after the end
        try:
            found = self._dll[self.prefix + name]
        except AttributeError as error:
            raise self.refusal(
                f"it has no function {self.prefix}{name}, which the standard requires"
            ) from error
        found.argtypes, found.restype = types, result
        return found

    def status(self, name: str, *types: Any) -> Callable[..., int]:
        """Give a function of the instance that returns a status up to discard, and raises RunError for any other."""
        return self._checked(name, DISCARD, types)

    def call(self, name: str, *types: Any) -> Call:
        """Give a function of the instance that raises RunError unless its status is ok or warning."""
        return self._checked(name, WARNING, types)

    def _checked(self, name: str, worst: int, types: tuple[Any, ...]) -> Callable[..., Any]:
        found, instance = self.function(name, c_int, c_void_p, *types), self.instance

        def checked(*arguments: Any) -> int:
            if self._over:
                raise RunError(f"{self.name}: {self.prefix}{name} cannot be called: {self._over}")
            status: int = found(instance, *arguments)
            if status > worst:
                raise self.failure(name, status)
            return status

        return checked

    def absent(self, what: str) -> Call:
        """Give a call that says what the FMU or its version does not have."""

        def refused(*_: Any) -> None:
            raise RunError(f"{self.name}: {what}")

        return refused

    def failure(self, name: str, status: int) -> RunError:
        """Name the FMU, the call, the status and the FMU's last words; remember what forbids later calls."""
        self.failed |= status >= ERROR
        if status == FATAL:
            self._over = f"{self.prefix}{name} returned 4 (fatal) before"
        label = STATUS[status] if 0 <= status < len(STATUS) else "no status of the standard"
        return RunError(
            f"{self.name}: {self.prefix}{name} returned {status} ({label}){self.messages.tail}"
        )

    @property
    def over(self) -> bool:
        """Whether no call is allowed any more."""
        return bool(self._over)

    def unload(self) -> None:
        """Let the binary go; no call reaches it any more."""
        from fmpy import freeLibrary

        if self._dll is not None:
            self._over = self._over or "the instance was freed"
            freeLibrary(self._dll._handle)
            self._dll = None
