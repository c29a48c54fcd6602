"""The binary of an FMU: loaded, its functions bound to one instance, unloaded.

fmpy's own loading is not used: it leaves the working directory changed and the library in memory
where it fails, and looks for functions which no run needs. The calls of a run go to the library's
functions directly, on the memory of numpy arrays: fmpy's own wrappers build their ctypes arrays
anew from lists at every call.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from ctypes import CDLL, addressof, byref, c_int, c_uint8, c_void_p, cast
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeAlias

from numpy.typing import NDArray

from cosim.errors import FmuError, RunError
from cosim.fmi.binary.messages import Message, Messages, last_as_suffix
from cosim.fmi.platforms import load_library
from cosim.native.fmi.fmu import CallStruct, FmuStruct
from cosim.native.fmi.process import report_deaths
from cosim.native.library import library as kernels
from cosim.native.memory import place_struct

# ctypes itself has no public way to unload a library.
if sys.platform == "win32":
    from _ctypes import FreeLibrary as _unload
else:
    from _ctypes import dlclose as _unload

Call: TypeAlias = Callable[..., None]

STATUS_NAMES: Final = ("ok", "warning", "discard", "error", "fatal", "pending")
OK: Final = 0
WARNING: Final = 1
DISCARD: Final = 2
ERROR: Final = 3
FATAL: Final = 4
NEW: Final = 1  # a warning that was not fetched yet
REPORTED: Final = 2
_ArrayMemory = c_uint8 * 1


def pointer(array: NDArray[Any]) -> Any:
    """Return a pointer to a contiguous array's memory; quicker than ``array.ctypes``."""
    memory: Any = array
    return _ArrayMemory.from_buffer(memory) if array.size else None


class MessageMark(NamedTuple):
    """What the messages of an FMU up to an instant are known by.

    Parameters
    ----------
    number : int
    warned : mapping of function to (int, float)
        What is known of warnings that it returned, and the time of the first.
    failed : bool
        Whether there was an error.
    """

    number: int
    warned: Mapping[str, tuple[int, float]]
    failed: bool


class Library:
    """The functions of one instance, each checking its status.

    Parameters
    ----------
    path : Path
        The binary.
    prefix : str
        Of its functions.
    name : str
        Names the FMU in messages.
    messages : Messages
        What the FMU logs.
    version : int
        First digit of the FMI version.

    Attributes
    ----------
    instance : c_void_p
        Always this object, as every bound function refers to it; compiled code reads its memory.
    address : int
        Of ``cosim_fmu``, for compiled code.

    Raises
    ------
    FmuError
        If it cannot be loaded, with the loader's reason.
    """

    def __init__(
        self, path: Path, prefix: str, name: str, messages: Messages, *, version: int
    ) -> None:
        self.prefix = prefix
        self.name = name
        self.messages = messages
        self._struct = place_struct(FmuStruct)
        self._struct.version = version
        self._struct.messages = messages.address
        self.address = addressof(self._struct)
        self.instance = c_void_p.from_buffer(self._struct, FmuStruct.instance.offset)
        self.failed = False  # an error or worse: terminate is no longer allowed
        self._calls: dict[str, CallStruct] = {}  # the functions of the instance that were bound
        self._file_name = path.name
        self._forbidden = ""  # why no call is allowed any more
        report_deaths()
        try:
            self._dll: CDLL | None = load_library(path)
        except OSError as error:
            raise self.load_error(str(error)) from error

    def load_error(self, reason: str) -> FmuError:
        """Return an error with the reason why the binary cannot be used."""
        return FmuError(
            f"{self.name}: the binary {self._file_name} cannot be used: {reason}"
            f"{self.messages.last_as_suffix}"
        )

    def check_renewed(self) -> None:
        """Check that there is an instance after another one was freed.

        Raises
        ------
        RunError
            If the FMU refused.
        """
        if not self.instance:
            raise RunError(
                f"{self.name}: refuses to be instantiated a second time"
                f"{self.messages.last_as_suffix}"
            )

    def function(self, name: str, result: Any, *types: Any) -> Any:
        """Return a function of the library.

        Raises
        ------
        FmuError
            If there is none of that name.
        """
        assert self._dll is not None  # nothing is bound after the end
        full_name = self.prefix + name
        try:
            function = self._dll[full_name]
        except AttributeError as error:
            reason = f"it has no function {full_name}, which the standard requires"
            raise self.load_error(reason) from error
        function.argtypes = types
        function.restype = result
        return function

    def status_call(self, name: str, *types: Any) -> Callable[..., int]:
        """Return a function of the instance that returns its status.

        Raises
        ------
        FmuError
            If there is none of that name.
        RunError
            From the returned function: a status above discard, or a call after a fatal one.
        """
        return self._checked(name, DISCARD, types)

    def call(self, name: str, *types: Any) -> Call:
        """Return a function of the instance.

        Raises
        ------
        FmuError
            If there is none of that name.
        RunError
            From the returned function: a status above warning, or a call after a fatal one.
        """
        return self._checked(name, WARNING, types)

    def _checked(self, name: str, worst: int, types: tuple[Any, ...]) -> Callable[..., Any]:
        function = self.function(name, c_int, c_void_p, *types)
        instance = self.instance
        self._calls.setdefault(name, CallStruct(cast(function, c_void_p)))

        def checked(*arguments: Any) -> int:
            if self._forbidden:
                full_name = self.prefix + name
                raise RunError(f"{self.name}: {full_name} cannot be called: {self._forbidden}")
            status: int = function(instance, *arguments)
            if status:
                self.judge(name, status, worst)
            return status

        return checked

    def judge(self, name: str, status: int, worst: int) -> None:
        """Report a warning, once for every function.

        Raises
        ------
        RunError
            For a status above ``worst``.
        """
        if not OK <= status <= worst:
            raise self.record_failure(name, status)
        if status == WARNING:
            self.record_warning(name)

    def record_warning(self, name: str) -> None:
        """Report that a function returned a warning, the first time that it does."""
        kernels.cosim_fmu_record_warning(byref(self._struct), byref(self._calls[name]))

    def _warnings(self) -> Iterator[Message]:
        """Return what functions returned as a warning, each once."""
        for name, call in self._calls.items():
            if call.warned != NEW:
                continue
            call.warned = REPORTED
            last = last_as_suffix(Message.of(call.message)) if call.has_message else ""
            time = None if math.isnan(call.time) else call.time
            text = (
                f"{self.prefix}{name} returned 1 (warning); the first time only is reported{last}"
            )
            yield Message(time, "warning", "", text)

    @property
    def may_go_back(self) -> bool:
        """Whether a state of an earlier time may be restored."""
        return bool(self._struct.may_go_back)

    @may_go_back.setter
    def may_go_back(self, possible: bool) -> None:
        self._struct.may_go_back = possible

    def function_address(self, name: str) -> int:
        """Return the address of a function that was bound itself."""
        address: int = self._calls[name].function
        return address

    def call_address(self, name: str) -> int:
        """Return the address of a function of the instance that was bound, for compiled code."""
        return addressof(self._calls[name])

    def failure_of_compiled_code(self) -> RunError | None:
        """Return the call that failed in compiled code as an error; None: none did.

        It is returned once.
        """
        address = self._struct.failed
        if not address:
            return None
        self._struct.failed = None
        names = {addressof(call): name for name, call in self._calls.items()}
        name = names[address]
        return self.record_failure(name, self._struct.status)

    def drain(self) -> list[Message]:
        """Return the FMU's messages since the last call, and what it returned as a warning."""
        return self.messages.drain() + list(self._warnings())

    def mark_messages(self) -> MessageMark:
        """Return what the messages up to now are known by."""
        warned = {name: (call.warned, call.time) for name, call in self._calls.items()}
        return MessageMark(self.messages.mark(), warned, self.failed)

    def forget_messages(self, mark: MessageMark, *, of_calls: bool) -> None:
        """Forget the messages that came behind a mark, and were not fetched yet.

        ``of_calls``: also what functions returned as a warning or an error since then.
        """
        self.messages.forget(mark.number)
        if not of_calls:
            return
        self.failed = mark.failed or self.forbids_calls
        for name, call in self._calls.items():
            call.warned, call.time = mark.warned.get(name, (0, math.nan))

    def unavailable(self, reason: str) -> Call:
        """Return a function in the place of one that the FMU or its version does not have.

        Raises
        ------
        RunError
            From the returned function, at every call.
        """

        def refused(*_: Any) -> None:
            raise RunError(f"{self.name}: {reason}")

        return refused

    def record_failure(self, name: str, status: int) -> RunError:
        """Return an error with the call, its status and the FMU's last message.

        Which later calls the status forbids is remembered.
        """
        full_name = self.prefix + name
        self.failed |= status >= ERROR
        if status == FATAL:
            self._forbid(f"{full_name} returned 4 (fatal) before")
        known = 0 <= status < len(STATUS_NAMES)
        status_name = STATUS_NAMES[status] if known else "no status of the standard"
        return RunError(
            f"{self.name}: {full_name} returned {status} ({status_name})"
            f"{self.messages.last_as_suffix}"
        )

    def _forbid(self, reason: str) -> None:
        """Allow no call any more."""
        self._forbidden = reason
        self._struct.forbidden = 1

    def check_allowed(self, what: str) -> None:
        """Check that calls are allowed.

        Raises
        ------
        RunError
            If a fatal status forbids them.
        """
        if self._forbidden:
            raise RunError(f"{self.name}: cannot {what}: {self._forbidden}")

    @property
    def forbids_calls(self) -> bool:
        """Whether no call is allowed any more."""
        return bool(self._forbidden)

    def unload(self) -> None:
        """Unload the binary; no call reaches it any more."""
        if self._dll is not None:
            self._forbid(self._forbidden or "the instance was freed")
            unload(self._dll)
            self._dll = None


def unload(library: CDLL) -> None:
    """Unload a binary that was loaded; one that was loaded several times stays for the others."""
    _unload(library._handle)


def is_loaded(name: str) -> bool:
    """Return whether a library of that name is in memory; False where the system cannot say."""
    mode = getattr(os, "RTLD_NOLOAD", None)
    if mode is None:
        return False
    try:
        unload(CDLL(name, mode))
    except OSError:
        return False
    return True
