"""What an FMU changes of the process that it runs in: found after its calls, and put back.

What is looked at is what would go wrong in silence: numbers (the rounding mode, and subnormal
numbers that become zero), the end of the process at the next overflow (floating-point traps), the
decimal point that other FMUs read and write, relative paths, Ctrl-C, and files that are opened in
the place of a closed stdout. The floating-point unit is the thread's own; the rest is shared by all
threads, so that it is looked at from the main thread only: in another one, a change may as well be
the program's own.

Not looked at: the environment variables, which Python has its own copy of, and the umask, which
cannot be read without setting it for all threads.
"""

from __future__ import annotations

import threading
from ctypes import addressof, create_string_buffer
from typing import Final, final

from cosim.native.fmi.process import process_restore, process_save, process_size

ROUNDING: Final = 1
_SUBNORMALS: Final = 2
_TRAPS: Final = 4
_LOCALE: Final = 8
_FOLDER: Final = 16
_SIGNALS: Final = 32
_STREAMS: Final = 64
CHANGES: Final = {
    ROUNDING: "the rounding mode or the precision of floating-point numbers",
    _SUBNORMALS: "how subnormal numbers are computed (flush to zero)",
    _TRAPS: "that floating-point exceptions end the process",
    _LOCALE: "the locale of numbers",
    _FOLDER: "the working directory",
    _SIGNALS: "what Ctrl-C and a request to terminate do",
    _STREAMS: "that stdin, stdout or stderr is open (it was closed; now it is /dev/null)",
}
"""What changed, by the bit of ``process.h``."""


@final
class Process:
    """Remembers the state of the process before a call of an FMU.

    Parameters
    ----------
    called : int or None
        The address of the messages of the FMU that is called between ``save`` and ``restore``;
        None: another one says so, or it is none.
    """

    def __init__(self, called: int | None = None) -> None:
        self._state = create_string_buffer(process_size())
        self._shared = 0
        self._called = called

    @property
    def address(self) -> int:
        """Where compiled code finds what is remembered."""
        return addressof(self._state)

    def save(self) -> None:
        """Remember the state."""
        self._shared = int(threading.current_thread() is threading.main_thread())
        process_save(self._state, self._shared, self._called)

    def restore(self) -> int:
        """Put back what changed since ``save``; return what did, as bits of ``CHANGES``."""
        changes: int = process_restore(self._state, self._shared)
        return changes


def describe_changes(changes: int) -> str:
    """Return what changed, in words."""
    return ", ".join(text for bit, text in CHANGES.items() if changes & bit)
